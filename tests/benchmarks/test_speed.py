"""Speed: every figure is measured, and figures that are composed of costs add up."""

import json
import sys

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, hard_cases
from helpers.variants import VARIANT

from benchmarks import networks, scenes, speed


@pytest.fixture(autouse=True)
def variant(monkeypatch, tmp_path):
    mi.set_variant(VARIANT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.slow  # a minute
def test_every_figure_is_measured(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["speed", "--quick", "--out", str(tmp_path)])
    speed.main()
    result = json.loads((tmp_path / "speed.json").read_text())
    assert result["about"]["machine"]["cores"] > 0 and result["about"]["seconds"] > 0
    assert (tmp_path / "speed.png").stat().st_size > 10_000
    figures = {key: value for key, value in result["values"].items() if key != "costs"}
    for part in ("stage_unculled", "whole_culled_600", "whole_own_culled_128", "culling_rays", "lookup_two_logistics",
                 "map_error_two", "light_error_atlas", "first_cold", "method_raymarch_over_ray_network",
                 "setting_voxels_ray_network", "setting_shipped_neural_transmittance", "setting_paper_raymarch",
                 "camera_light_over_march", "per_light", "picture_many", "memory_many"):
        assert part in figures
    assert len({f["title"] for f in figures.values()}) == len(figures)
    for key, f in figures.items():
        assert np.isfinite([f["median"], f["min"], f["max"]]).all() and f["unit"], key
        assert f["min"] <= f["median"] <= f["max"], key
        assert ("extrapolated" in f) == key.startswith(("stage", "whole"))


def test_volume_of_a_uniform_field():
    """τ at the far edges of n cells of a chord of 2h under σ: exp(−σ · 2h · (k + 1)/n)."""
    o, d = networks.light_rays(5, 20)
    tau = np.array(networks.tabulate(lambda p: mi.Float(0.7) + 0 * p[0], o, d, 16)).reshape(20, 16)
    offset = np.linalg.norm(np.array(o), axis=0)
    chord = 2 * np.sqrt(1 - offset**2)
    np.testing.assert_allclose(tau, np.exp(-0.7 * chord[:, None] * (np.arange(16) + 1) / 16), rtol=1e-5)
    np.testing.assert_allclose((np.array(o) * np.array(d)).sum(0), 0, atol=1e-6)  # rays start on the plane across


def test_paper_field_keeps_its_shape():
    """The networks' queries are part of the kernel and change no value."""
    grid = hard_cases.baked(*fields.blobs([(0.1, 0, 0)], [0.4]), resolution=64).field.grid
    paper = networks.PaperField(grid, networks.random_network((16,)))
    p = tuple(mi.Float(c) for c in np.random.default_rng(1).uniform(-0.5, 0.5, (3, 100)).astype(np.float32))
    np.testing.assert_allclose(paper.density(p), grid.density(p), atol=1e-20)
    for one, other in zip(paper.reflectance(p), grid.reflectance(p), strict=True):
        np.testing.assert_array_equal(np.array(one), np.array(other))


def test_sky_of_one_pixel_per_light():
    image = scenes.sky(50, 10)
    assert image.shape == (10, 50, 3) and image.min() > 0


COSTS = {"camera": 1e-6, "points": 2.0, "query": 3e-6, "volume/192": 192e-6, "volume/256": 256e-6, "map": 1e-6,
         "ours": 1e-7, "shade/volume": 2e-9, "shade/map": 1e-9, "voxels": 7.0, "fraction/192": 0.1,
         "fraction/256": 0.2, "fraction/rays": 0.5}
PIXELS = 360_000


def test_unculled_speed_up_is_a_ratio_of_lines():
    """Per light, tables and shading of all samples add; the ratio at 500 lights is the figure."""
    camera, shade = PIXELS * 192 * 3e-6, PIXELS * 192
    slow = camera + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    fast = camera + 500 * (PIXELS * 1e-6 + shade * 1e-9)
    figures = speed.network_figures([COSTS, COSTS], speed.FULL)
    assert figures["whole_unculled_600"]["median"] == pytest.approx(slow / fast)
    assert networks.whole(COSTS, np.array([0, 500]), "map", False)[1] == pytest.approx([camera, slow])


def test_culled_speed_up_leaves_out_queries_on_both_sides():
    """A volume's samples, a map's rays; the voxels that tell where space is empty are baked on both sides."""
    figures = speed.network_figures([COSTS], speed.FULL)
    shade = PIXELS * 2
    slow = 7 + 0.36 + 500 * (PIXELS * 0.1 * 192e-6 + shade * 2e-9)
    for key, ray in (("culled", 0.5e-6), ("own_culled", 1e-7)):
        fast = 7 + 0.36 + 500 * (PIXELS * ray + shade * 1e-9)
        assert figures[f"whole_{key}_600"]["median"] == pytest.approx(slow / fast)


def test_our_network_beside_an_unculled_volume():
    """It reads a culled march and pays for its voxels; the camera's rays are culled on both sides."""
    shade = PIXELS * 2
    slow = 0.36 + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    fast = 7 + 0.36 + 500 * (PIXELS * 1e-7 + shade * 1e-9)
    assert networks.whole(COSTS, 500, "ours", False) == pytest.approx((fast, slow))


def test_transmittance_stage_culled_and_unculled():
    figures = speed.network_figures([COSTS], speed.FULL)
    assert figures["stage_unculled"]["median"] == pytest.approx(256)
    rays = 500 * PIXELS
    assert figures["stage_culled"]["median"] == pytest.approx((7 + rays * 0.2 * 256e-6) / (7 + rays * 0.5e-6))


def test_fractions_of_a_ball():
    """Rays through a disc of radius 0.9 around an opaque ball of radius r: (r/0.9)² of them meet it."""
    grid = hard_cases.baked(*fields.blobs([(0, 0, 0)], [0.5], log_density=6.0), resolution=64).field.grid
    fractions = networks.culled_fractions(grid, networks.FULL)
    half = float(np.abs(np.array(grid.bounds)).mean())
    assert (0.8 * half / 0.9) ** 2 < fractions["fraction/rays"] < ((half + 0.125) / 0.9) ** 2  # an octant of a brick
    assert 0 < fractions["fraction/256"] < 0.5 * fractions["fraction/rays"]
    assert fractions["fraction/192"] == pytest.approx(fractions["fraction/256"], rel=0.05)

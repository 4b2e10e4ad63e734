"""`mi-ntf bench`: every row is measured, by figures that add up."""

import json

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, hard_cases
from helpers.variants import VARIANT

from benchmarks import bench, bench_culled, bench_figure, bench_image, bench_measure, bench_paper


@pytest.fixture(autouse=True)
def variant(monkeypatch, tmp_path):
    mi.set_variant(VARIANT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.mark.slow  # a minute
def test_every_line_runs(tmp_path, capsys):
    report = bench.bench(quick=True, out=tmp_path)
    bench.print_table(report)
    text = capsys.readouterr().out
    assert json.loads((tmp_path / "bench.json").read_text())["rows"] == report["rows"]
    assert (tmp_path / "bench.png").stat().st_size > 10_000
    asked = [r["asked"] for r in report["rows"] if r["asked"]]
    assert [a for a in ("≥ 230 ×", "≥ 1000 ×", "≥ 92 ×", "≥ 192 ×", "≤ 12 s", "≤ 200 s", "≤ 4 GiB", "≥ 3 ×", "linear")
            if a not in asked] == []
    titles = [r["what"] for r in report["rows"]]
    assert len(set(titles)) == len(titles)
    for part in (", culled on both sides", "unculled on both sides", "what culling leaves", "alone, worst",
                 "cold caches", "raymarch over ray_network", "transmittance_volume over transmittance_map",
                 "voxels, ray_network", "shipped networks, neural_transmittance"):
        assert any(part in title for title in titles), part
    for r in report["rows"]:
        assert np.isfinite(r["measured"]) and r["unit"], r["what"]
        assert r["met"] is not None or not r["asked"]
        assert ("random" in r["weights"]) == ("volume over map" in r["what"] or "paper's size" in r["what"]), r["what"]
    assert "without meaning" in text and "extrapolated" in text


def test_rows_know_whether_they_reach_what_is_asked():
    assert bench_measure.row("a", 93.0, "×", least=92).met and not bench_measure.row("a", 91.0, "×", least=92).met
    assert bench_measure.row("a", 11.0, "s", most=12).met and not bench_measure.row("a", 13.0, "s", most=12).met
    assert bench_measure.row("a", 1.0, "s").met is None and bench_measure.row("a", 1.0, "s", most=12).asked == "≤ 12 s"


def test_volume_of_a_uniform_field():
    """τ at the middles' far edges of n cells of a chord of 2h under σ: exp(−σ · 2h · (k + 1)/n)."""
    o, d = bench_paper.light_rays(5, 20)
    tau = np.array(bench_paper.tabulate(lambda p: mi.Float(0.7) + 0 * p[0], o, d, 16)).reshape(20, 16)
    offset = np.linalg.norm(np.array(o), axis=0)
    chord = 2 * np.sqrt(1 - offset**2)
    np.testing.assert_allclose(tau, np.exp(-0.7 * chord[:, None] * (np.arange(16) + 1) / 16), rtol=1e-5)
    np.testing.assert_allclose((np.array(o) * np.array(d)).sum(0), 0, atol=1e-6)  # rays start on the plane across


def test_paper_field_keeps_its_shape():
    """The networks' queries take part in the kernel, and in no value: of ordinary size, as no trained specular weight
    of e^-60 is."""
    grid = hard_cases.baked(*fields.blobs([(0.1, 0, 0)], [0.4]), resolution=64).field.grid
    paper = bench_paper.PaperField(grid, bench_paper.random_network((16,)))
    p = tuple(mi.Float(c) for c in np.random.default_rng(1).uniform(-0.5, 0.5, (3, 100)).astype(np.float32))
    np.testing.assert_allclose(paper.density(p), grid.density(p), atol=1e-20)
    for ours, theirs in zip(paper.reflectance(p), grid.reflectance(p), strict=True):
        np.testing.assert_array_equal(np.array(ours), np.array(theirs))


def test_sky_of_one_pixel_per_light():
    image = bench_image.sky(50, 10)
    assert image.shape == (10, 50, 3) and image.min() > 0


COSTS = {"camera": 1e-6, "points": 2.0, "query": 3e-6, "volume/192": 192e-6, "volume/256": 256e-6, "map": 1e-6,
         "ours": 1e-7, "shade/volume": 2e-9, "shade/map": 1e-9, "voxels": 7.0, "share/192": 0.1, "share/256": 0.2,
         "share/rays": 0.5}
PIXELS = 360_000


def measured(rows, *words):
    return next(r for r in rows if all(w in r.what for w in words))


def test_unculled_speed_up_is_a_ratio_of_lines():
    """Per light, tables and shading of all samples add; the ratio at 500 lights is the row's."""
    rows = bench_culled.image_rows(COSTS, bench_measure.FULL)
    camera, shade = PIXELS * 192 * 3e-6, PIXELS * 192
    slow = camera + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    fast = camera + 500 * (PIXELS * 1e-6 + shade * 1e-9)
    row = measured(rows, "m = 600²", "unculled on both sides")
    assert row.measured == pytest.approx(slow / fast) and row.asked == "≥ 92 ×"
    d = row.details
    assert d["volume_fixed_seconds"] + 500 * d["volume_lights_seconds"] == pytest.approx(slow)
    assert bench_figure.LIGHTS == 500


def test_culled_speed_up_leaves_out_queries_on_both_sides():
    """A volume's samples, a map's rays; the voxels that say which are baked on both sides."""
    rows = bench_culled.image_rows(COSTS, bench_measure.FULL)
    shade = PIXELS * 2
    slow = 7 + 0.36 + 500 * (PIXELS * 0.1 * 192e-6 + shade * 2e-9)
    for network, ray in (("paper's", 0.5e-6), ("our", 1e-7)):
        row = measured(rows, "m = 600²", ", culled on both sides", network)
        assert row.measured == pytest.approx(slow / (7 + 0.36 + 500 * (PIXELS * ray + shade * 1e-9)))
        assert not row.asked


def test_our_network_beside_an_unculled_volume():
    """It reads a culled march, and pays for its voxels; the camera's rays are culled on both sides."""
    row = measured(bench_culled.image_rows(COSTS, bench_measure.FULL), "m = 600²", "unculled volume, our network")
    shade = PIXELS * 2
    slow = 0.36 + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    assert row.measured == pytest.approx(slow / (7 + 0.36 + 500 * (PIXELS * 1e-7 + shade * 1e-9)))
    assert row.asked == "≥ 192 ×"


def test_transmittance_stage_culled_and_unculled():
    rows = bench_culled.stage_rows(COSTS, bench_measure.FULL)
    assert measured(rows, "unculled on both sides").measured == pytest.approx(256)
    rays = 500 * PIXELS
    culled = (7 + rays * 0.2 * 256e-6) / (7 + rays * 0.5e-6)
    assert measured(rows, ", culled on both sides", "paper's").measured == pytest.approx(culled)
    assert len({r.what for r in rows}) == len(rows) == 4


def test_shares_of_a_ball():
    """Rays through a disc of radius 0.9 around an opaque ball of radius r: (r/0.9)² of them meet it."""
    grid = hard_cases.baked(*fields.blobs([(0, 0, 0)], [0.5], log_density=6.0), resolution=64).field.grid
    shares = bench_paper.culled_shares(grid, bench_measure.FULL)
    half = float(np.abs(np.array(grid.bounds)).mean())
    assert (0.8 * half / 0.9) ** 2 < shares["share/rays"] < ((half + 0.125) / 0.9) ** 2  # an octant of a brick
    assert 0 < shares["share/256"] < 0.5 * shares["share/rays"]
    assert shares["share/192"] == pytest.approx(shares["share/256"], rel=0.05)

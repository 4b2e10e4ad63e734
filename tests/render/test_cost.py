"""The cost model: the rule of `auto` by hand, and where the machine's constants come from."""

import json
from dataclasses import asdict, replace

import mitsuba as mi
import pytest
from helpers import scenes
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.visibility import REGISTRY, transmittance_atlas
from mi_ntf.infer.visibility.method import resolution_for
from mi_ntf.infer.visibility.raymarch import light_steps
from mi_ntf.render.commands import calibration
from mi_ntf.render.cost import model

# Of research/transmittance.md, section 5, "knot": 576 ns a texel, 1.6 ns a step, 4.5 ns a lookup.
KNOT = model.Constants(texel=576 / 384, march=1.6, lookup=4.5, atlas=23.0)
WORK = model.Work(rays=65536, points=300_000, lights=50, method="raymarch", texels=128**2, samples=384)


@pytest.fixture(autouse=True)
def cache(variant, monkeypatch, tmp_path):
    mi_ntf.render.register()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mi-ntf" / "cost.json"


MARCH, LOOKUP, ATLAS = light_steps(384) * 1.6, 4.5, 23.0
"""ns of a point and light."""
MAP = 0.785398 * 16384 * 576
"""ns of a light's map."""


def spent(work, method: str) -> float:
    return model.visibility(replace(work, method=method), KNOT)


def test_what_methods_spend_by_hand():
    """Half of the points face a light: marches, a map for each light, one atlas."""
    pairs = 0.5 * 300_000 * 50
    assert spent(WORK, "raymarch") == pytest.approx(pairs * MARCH)
    assert spent(WORK, "transmittance_map") == pytest.approx(50 * MAP + pairs * LOOKUP, rel=1e-6)
    atlas = 0.785398 * transmittance_atlas.RAYS * 0.5 * 576
    assert spent(WORK, "transmittance_atlas") == pytest.approx(atlas + pairs * ATLAS, rel=1e-6)


def test_two_logistics_are_fitted_and_read_as_two_but_a_network_is_asked_once():
    two = replace(WORK, method="transmittance_map", components=2)
    assert model.making(two, KNOT) == pytest.approx(50 * 2 * MAP, rel=1e-6)
    assert model.per_pair(two, KNOT) == 2 * LOOKUP
    asked = replace(two, source="network")
    assert model.making(asked, KNOT) == model.making(replace(asked, components=1), KNOT)


def test_atlases_cost_more_in_smoke_and_the_network_the_same():
    """1.8 of a map's texel in place of a half, as measured: `cloud` 1.85 s, `statue` 0.36 s, by the network 1.1 and
    0.45 s."""
    atlas, network = replace(WORK, method="transmittance_atlas"), replace(WORK, method="neural_transmittance")
    assert model.making(replace(atlas, opaque=False), KNOT) == pytest.approx(3.6 * model.making(atlas, KNOT))
    asked = 0.785398 * transmittance_atlas.RAYS * KNOT.ray
    assert model.making(network, KNOT) == model.making(replace(atlas, source="network"), KNOT) == pytest.approx(asked)
    assert model.making(replace(network, opaque=False), KNOT) == pytest.approx(asked)


@pytest.mark.parametrize("method, opaque, steps, share", [
    ("transmittance_map", True, 0.785398 * 16384 * 384, 0.06),
    ("transmittance_map", False, 0.785398 * 16384 * 384, 0.27),
    ("transmittance_atlas", True, 0.785398 * transmittance_atlas.RAYS * 0.5 * 384, 0.04),
    ("transmittance_atlas", False, 0.785398 * transmittance_atlas.RAYS * 1.8 * 384, 0.03),
    ("raymarch", True, light_steps(384), 0.25), ("raymarch", False, light_steps(384), 0.9)])
def test_a_march_asks_networks_in_some_of_its_steps(method, opaque, steps, share):
    """Of opaque things in few, in smoke from the point on in nearly all."""
    work = replace(WORK, method=method, opaque=opaque)
    of = model.making if REGISTRY[method].making else model.per_pair
    more = of(replace(work, network=True), KNOT) - of(work, KNOT)
    assert more == pytest.approx((work.lights if method == "transmittance_map" else 1) * share * steps * KNOT.density)


def test_what_no_map_serves_is_marched_beside_maps():
    more = replace(WORK, drawn=2, others=1e6)
    rest = 0.5 * (300_000 * 2 + 1e6)
    assert spent(more, "transmittance_map") - spent(WORK, "transmittance_map") == pytest.approx(rest * MARCH)
    assert spent(more, "transmittance_atlas") - spent(WORK, "transmittance_atlas") == pytest.approx(rest * ATLAS)


def test_volumes_hold_one_and_a_half_entries_a_sample():
    volume = replace(WORK, method="transmittance_volume")
    entries = 0.785398 * 128**2 * 1.5 * 384
    assert model.seconds(volume, KNOT)["maps or volumes"] == pytest.approx(1e-9 * 50 * entries * KNOT.cell, rel=1e-5)


def test_steps_of_a_light_march():
    """Steps of 0.35/192, growing by three tenths of the distance, at last 1/80 long: counted for 384 samples."""
    assert light_steps(384) == 88
    assert light_steps(96) < light_steps(384) < light_steps(1536)


@pytest.mark.parametrize(("work", "best"), [
    (replace(WORK, points=1e3, lights=1), "raymarch"),
    (replace(WORK, points=1e6, lights=1), "transmittance_map"),
    (replace(WORK, points=1e5, lights=500), "transmittance_atlas"),
    (replace(WORK, points=1e8, lights=500), "transmittance_map"),
    (replace(WORK, points=1e6, lights=0, drawn=8), "raymarch"),
    (replace(WORK, points=1e8, lights=0, drawn=8), "transmittance_atlas"),
    (replace(WORK, points=1e6, lights=1, others=1e9), "transmittance_atlas"),
])
def test_auto_takes_the_cheapest(work, best):
    """Few points are marched; many have a map if there are few lights, an atlas if there are many, or drawn ones."""
    method, reason = model.choose(work, KNOT)
    assert method == best
    serve = ["raymarch", "transmittance_atlas", *(["transmittance_map"] if work.lights else [])]
    assert spent(work, best) == min(spent(work, name) for name in serve)
    assert "shading points with" in reason and f"s by {best}, " in reason


@pytest.mark.parametrize("points, best", [(1300, "raymarch"), (1500, "transmittance_map")])
def test_maps_pay_early_where_steps_are_queries(points, best):
    """The paper's regime: a march of network queries, a fourth of its steps, against one query of the ray network. Half
    of the points face the light: 0.5 · 88 · 0.25 = 11 queries a point, 12 868 for the map, and
    a fifth more counts as equal."""
    slow = replace(KNOT, density=5700, ray=5700)
    paper = replace(WORK, points=points, lights=1, network=True, source="network")
    assert model.choose(paper, slow)[0] == best


@pytest.mark.parametrize("method", list(REGISTRY))
def test_every_method_has_a_price(method):
    stages = model.seconds(replace(WORK, method=method), model.Constants())
    assert min(stages.values()) >= 0 and stages["lights"] > 0


def test_constants_are_kept_for_the_machine(cache):
    assert model.measured() is None and model.constants() == model.Constants()
    model.remember(KNOT)
    assert model.measured() == KNOT and model.constants() == KNOT
    ((key, values),) = json.loads(cache.read_text()).items()
    assert VARIANT in key and values == asdict(KNOT)
    cache.write_text(json.dumps({"another machine": values}))
    assert model.measured() is None
    model.remember(KNOT)
    assert set(json.loads(cache.read_text())) == {key, "another machine"}


@pytest.mark.parametrize("content", ["", "[1]", '{"%s": {"march": 1}}', '{"%s": 3}'])
def test_a_damaged_cache_counts_as_none(cache, content):
    cache.parent.mkdir()
    cache.write_text(content.replace("%s", model._name()))
    assert model.constants() == model.Constants()


@pytest.mark.parametrize("prices", [
    {"march": 0}, {"march": -1.0}, {"march": float("nan")}, {"march": float("inf")}, {"march": True}, {"march": "2"},
    {"march": None}, {"march": [1]}, {"march": 10**400}, {"more": 1.0}])
def test_prices_that_make_no_sense_count_as_none(cache, prices):
    model.remember(model.Constants(march=3.0))
    assert model.constants().march == 3.0
    cache.write_text(json.dumps({model._name(): asdict(model.Constants()) | prices}))
    assert model.measured() is None and model.constants() == model.Constants()


@pytest.mark.parametrize("content", [b"", b"\xff\xfe", b"[" * 100_000, b"9" * 10_000, b"{\"a\"", bytes(100)])
def test_prices_that_are_no_json(cache, content):
    cache.parent.mkdir()
    cache.write_bytes(content)
    assert model.constants() == model.Constants()
    model.remember(model.Constants(march=3.0))
    assert model.constants().march == 3.0


class Driver:
    """A CUDA driver that answers `codes` and shows one card."""

    def __init__(self, init=0, get=0, named=0, name="NVIDIA Imaginary 9000"):
        self.cuInit = lambda flags: init
        self.cuDeviceGet = lambda device, index: get

        def write(buffer, size, device):
            buffer.value = name.encode()
            return named

        self.cuDeviceGetName = write


def test_prices_on_a_gpu_are_kept_by_its_name(cache, monkeypatch):
    """Two cards beside the same processor have prices of their own; no driver, or a broken one, is no error."""
    monkeypatch.setattr(model.mi, "variant", lambda: "cuda_ad_rgb")

    def machine(driver):
        def load(name):
            if driver is None:
                raise OSError("libcuda.so.1: cannot open shared object file")
            return driver

        monkeypatch.setattr(model.ctypes, "CDLL", load)
        return model.machine()

    assert "NVIDIA Imaginary 9000" in machine(Driver()) and model.processor() not in machine(Driver())
    assert machine(Driver()) != machine(Driver(name="NVIDIA Imaginary 9001"))
    model.remember(model.Constants(march=0.1))
    machine(Driver())
    assert model.measured() is None
    faulty = [None, object(), Driver(init=100), Driver(get=101), Driver(named=1), Driver(name="")]
    assert {machine(d) for d in faulty} == {machine(None)} and "CUDA device" in machine(None)


def test_a_cache_that_cannot_be_written_is_no_fault(cache):
    cache.parent.write_text("a file where the folder belongs")
    model.remember(KNOT)
    assert model.measured() is None


def test_rendering_does_not_calibrate(tmp_path, cache, monkeypatch):
    def refuse(*args):
        raise MiNtfError("calibrated in a plain render")

    monkeypatch.setattr(calibration, "calibrate", refuse)
    scene = scenes.scene(scenes.write_blobs(tmp_path), {"type": "nrf"}, {"light": scenes.light("point")}, size=4, spp=1)
    assert scenes.render(scene).max() > 0
    assert not cache.exists()


def test_constants_do_not_outlive_what_measured_them(monkeypatch, tmp_path):
    model.remember(KNOT)
    assert model.measured() == KNOT
    other = tmp_path / "another.py"
    other.write_text("# another way to measure")
    monkeypatch.setattr(model, "PROGRAM", other)
    assert model.measured() is None and model.constants() == model.Constants()


def test_medians_alternate_and_leave_the_first_run_out():
    calls = []
    found = calibration.seconds({"a": lambda: calls.append("a"), "b": lambda: calls.append("b")}, 2)
    assert calls == ["a", "b", "a", "b", "a", "b"] and set(found) == {"a", "b"}


def test_rays_of_the_calibration_meet_the_object(tmp_path):
    scene = scenes.scene(scenes.write_blobs(tmp_path), {"type": "nrf"}, {"light": scenes.light("point")}, size=4)
    medium = next(s.interior_medium() for s in scene.shapes())
    points = calibration.seen_points(medium)
    assert 0.3 < calibration._covered(medium.field.grid) < 1  # spheres side by side, in their square
    assert (mi.Float(medium.field.grid.density(points.x)) > 0.1).numpy().mean() > 0.99


@pytest.mark.parametrize(("atlas", "best"), [(1.15, "transmittance_atlas"), (1.25, "transmittance_map")])
def test_of_two_that_are_alike_auto_takes_the_less_biased(monkeypatch, atlas, best):
    seconds = {"raymarch": 5.0, "transmittance_map": 1.0, "transmittance_atlas": atlas}
    monkeypatch.setattr(model, "visibility", lambda work, prices: 1e9 * seconds[work.method])
    assert model.choose(WORK, KNOT)[0] == best


@pytest.mark.parametrize(("lights", "side"), [(0, 384), (1, 384), (4, 384), (8, 271), (16, 192), (512, 192)])
def test_maps_are_as_fine_as_voxels_for_few_lights(lights, side):
    assert resolution_for(lights, 384) == side
    assert REGISTRY["transmittance_volume"].resolution(lights, 384) == 192
    assert resolution_for(1, 64) == 192

"""Curves, sizes of passes, ways and recipes of `mi-ntf tradeoff`, without a study around them."""

import shlex
import time

import mitsuba as mi
import numpy as np
import pytest
from evaluate import small_study
from helpers.programs import run_program
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import budget, recipes
from mi_ntf.evaluate.curves import COLOURS
from mi_ntf.evaluate.exported_mesh import ExportedMesh
from mi_ntf.evaluate.tradeoff import measure, references, ways
from mi_ntf.evaluate.tradeoff.errors import Truth
from mi_ntf.evaluate.tradeoff.ways import Subject, Way
from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.render.timing import once


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    mi.set_variant(VARIANT)
    return small_study.write(tmp_path_factory.mktemp("curves"))


@pytest.fixture(scope="module")
def subject(folder):
    return Subject(folder / "one.xml", {})


TRUTH = Truth(np.full((16, 16, 3), 0.5, np.float32))


class Noisy:
    """Renders pictures of known noise; `build`, `rate`: seconds of the first pass besides, and of a sample."""

    def __init__(self, build=0.0, rate=0.0, noise=0.2, bias=0.0):
        self.build, self.rate, self.noise, self.bias, self.calls = build, rate, noise, bias, []

    def __call__(self, samples, seed):
        build = 0 if self.calls else self.build
        took = max(self.rate * samples, 1e-5) + build
        self.calls.append((samples, seed))
        time.sleep(took)
        noise = self.noise / np.sqrt(samples) * np.random.default_rng(seed).normal(size=TRUTH.image.shape)
        return TRUTH.image * (1 + self.bias) + noise, took, build


def follow(render, share, mesh=None, truth=TRUTH):
    return measure.follow(render, truth, mesh, share, lambda error: None)


def test_passes_double_and_have_seeds_of_their_own():
    render = Noisy(rate=1e-4)
    curve = follow(render, 0.3)
    counts = [samples for samples, _ in render.calls]
    assert counts[:6] == [1, 1, 2, 4, 8, 16] and len({seed for _, seed in render.calls}) == len(counts)
    assert all(seed % 2 == 0 for _, seed in render.calls)  # references have the odd ones
    assert [p["samples"] for p in curve.points] == list(np.cumsum(counts))
    np.testing.assert_allclose([p["seconds"] for p in curve.points], 1e-4 * np.cumsum(counts))
    errors = np.array([p["error"] for p in curve.points]) * np.sqrt(np.cumsum(counts))
    np.testing.assert_allclose(errors, 0.4, rtol=0.15)  # of 768 values
    assert curve.points[0]["noise"] is None and curve.points[-1]["noise"] > 0
    np.testing.assert_allclose(curve.pictures["1"], TRUTH.image, atol=0.2)


def test_a_way_uses_its_share_and_not_much_more():
    start = time.perf_counter()
    follow(Noisy(rate=2e-3), 0.4)
    assert 0.2 < time.perf_counter() - start < 0.5  # its last pass is half of all before it at least
    assert len(follow(Noisy(build=0.5, rate=1e-3), 0.1).points) == 1  # one pass, whatever it takes
    assert len(follow(Noisy(build=0.15, rate=1e-3), 0.1).points) > 2  # a quarter of the share is left for samples
    assert len(follow(Noisy(rate=0.08), 0.1).points) == 1  # no second pass fits, and nothing was built


def test_a_way_ends_where_samples_change_its_error_no_more():
    assert follow(Noisy(bias=0.3, noise=0.1), 9.0).points[-1]["samples"] < 200
    known = Truth(TRUTH.image, variance=(0.05 * 0.5) ** 2)
    assert 32 <= follow(Noisy(), 9.0, truth=known).points[-1]["samples"] <= 128  # 0.4/√64 is the reference's 5 %


@pytest.mark.parametrize(("samples", "fit", "mark", "largest", "wanted"), [
    (8, 99, 0, 99, 8), (8, 5, 0, 99, 5), (8, 3, 0, 99, 0), (8, 99, 5, 99, 5), (8, 99, 3, 99, 8), (8, 99, 9, 99, 8),
    (8, 99, 0, 2, 2), (1, 1.0, 0.6, 99, 1), (8, 4.5, 6, 99, 4)])
def test_the_samples_of_the_next_pass(samples, fit, mark, largest, wanted):
    assert measure.following(samples, fit, mark, largest) == wanted


def test_both_truths_are_measured():
    curve = follow(Noisy(noise=0.01), 0.05, Truth(TRUTH.image * 1.25))
    assert curve.points[-1]["mesh_error"] == pytest.approx(0.2, abs=0.01)
    assert curve.points[-1]["error"] < 0.03


def test_what_is_not_finite_is_refused(subject, monkeypatch):
    monkeypatch.setattr(measure, "once", lambda *a: (np.full((2, 2, 4), np.nan), {}))
    with pytest.raises(MiNtfError, match="pixels that are not finite"):
        measure.Renderer(None, None)(1, 0)


def test_every_method_has_a_colour_of_its_own():
    assert {*REGISTRY, ways.STOCK, ways.MESH} == set(COLOURS) and len(set(COLOURS.values())) == len(COLOURS)


def test_the_plan_begins_with_every_method(subject):
    plan = ways.plan(subject, True)
    first = [way for way in plan if not way.changes]
    assert plan[: len(first)] == first
    assert {way.method for way in first} == {*subject.methods, ways.STOCK, ways.MESH}
    assert "visibility_mlp" not in subject.methods  # the field lacks its network
    assert "transmittance_map" in subject.methods
    assert not any(way.method == ways.MESH for way in ways.plan(subject, False))
    finer = [way.changes[0][0] for way in plan if way.changes]
    assert {"map_resolution", "map_components", "samples"} <= set(finer) and "environment_lights" not in finer
    assert len({way.name for way in plan}) == len(plan)


def test_many_lights_may_be_drawn_and_are_summed_by_maps(folder):
    sky = Subject(folder / "sky.xml", {})
    plan = ways.plan(sky, False)
    drawn = {way.method for way in plan if ("light_samples", ways.SAMPLED) in way.changes}
    assert {"raymarch", "transmittance_atlas"} <= drawn and "transmittance_map" not in drawn
    cells = {way.method: way.changes[0][1] for way in plan if way.changes and way.changes[0][0] == "environment_lights"}
    assert cells["transmittance_map"] == 8 and cells["raymarch"] == 128  # of 32
    some = Subject(folder / "sky.xml", {"drawn": "2"})
    assert Way("transmittance_map").properties(some)["light_samples"] == 0
    assert Way("raymarch").properties(some)["light_samples"] == 2


@pytest.mark.parametrize("way", [Way("transmittance_map", (("map_components", 2),)), Way("raymarch"),
                                 Way(ways.STOCK)], ids=lambda way: way.name)
def test_the_xml_of_a_way_renders_the_same_picture(folder, subject, way):
    text = (folder / "one.xml").read_text()
    begin, end = text.index("<integrator"), text.index("</integrator>") + len("</integrator>")
    ours = recipes.integrator_xml(way.plugin, way.properties(subject))
    (folder / "pasted.xml").write_text(text[:begin] + ours + text[end:])
    pasted = mi.load_file(str(folder / "pasted.xml"))
    render = references.renderer(subject, way, 1)
    ours, *_ = render(2, 5)
    np.testing.assert_array_equal(np.array(once(pasted, pasted.integrator(), 2, 5)[0])[..., :3], ours)


def command(way, subject, samples):
    return recipes.render_command(subject.path, subject.parameters, way.properties(subject), samples)


def test_the_command_of_a_way_runs_and_renders_the_way(folder, subject):
    way = Way("transmittance_map")
    text = command(way, subject, 3)
    assert text.startswith("mi-ntf render ") and "-D visibility=transmittance_map" in text and "-D spp=3" in text
    done = run_program(*shlex.split(text), "-m", VARIANT, cwd=folder)
    assert done.returncode == 0, done.stderr
    found = np.array(mi.Bitmap(str(folder / "picture.exr")))[..., :3]
    ours, *_ = references.renderer(subject, way, 1)(3, 0)
    np.testing.assert_allclose(found, ours, atol=2e-3)  # its film has half precision


def test_a_scene_without_the_names_has_no_command(folder, subject):
    assert command(Way("raymarch", (("samples", 96),)), subject, 4) == ""  # steps are no $name of it
    assert command(Way("raymarch"), Subject(folder / "sky.xml", {}), 4) == ""
    limited = Subject(folder / "one.xml", {"noise": "0.1"})
    assert command(Way("raymarch"), limited, 4) == ""  # would end at a noise


def test_a_changed_environment_reaches_every_render_of_a_study(folder):
    """The ways, the mesh's scene, the key of the study and the command have twice the light of the sky."""
    dim, bright = (Subject(folder / "sky.xml", {}, Environment(scale=scale)) for scale in (1.0, 2.0))
    way = Way("transmittance_map")
    pictures = [references.renderer(subject, way, 1)(1, 0)[0] for subject in (dim, bright)]
    np.testing.assert_allclose(pictures[1], 2 * pictures[0], rtol=1e-3, atol=1e-4)
    traced = [references.captured(subject, folder / "sky.xml", 1, 0.0).image.mean() for subject in (dim, bright)]
    assert traced[1] == pytest.approx(2 * traced[0], rel=0.05)
    assert dim.key() == Subject(folder / "sky.xml", {}).key() != bright.key()
    assert Environment(scale=2.0).words() == ["--env-scale=2.0"] and Environment().words() == []


def test_stock_volpath_agrees_with_the_converged_march(subject):
    """By brightness; each is followed for some seconds, and the march's noise is part of the standard error."""
    marching = references.renderer(subject, references.marched(subject), 1)
    truth, _ = references.converge(marching, 24 * 24, 96, 2.0, lambda text: None)
    curve = follow(references.renderer(subject, Way(ways.STOCK), 1), 3.0, truth=truth)
    gap, sigma = curve.shift
    assert abs(gap) < 4 * sigma and sigma < 0.03
    bias = curve.points[-1]["bias"], curve.points[-1]["bias_uncertainty"]
    assert bias[0] < 3 * bias[1] + 0.05


def test_further_light_of_the_reference_is_traced(folder):
    """Light between patches is biased, and the reference must not share that with the ways that are held against it."""
    subject = Subject(folder / "one.xml", {})
    subject.properties["max_depth"] = 4
    assert references.marched(subject).properties(subject)["bounces"] == "paths"
    assert Way("raymarch").properties(subject)["bounces"] == "auto"
    finer = {way.method for way in ways.plan(subject, False) if ("bounces", "paths") in way.changes}
    assert "transmittance_map" in finer
    marching, between = (references.renderer(subject, way, 1) for way in (references.marched(subject), Way("raymarch")))
    truth, _ = references.converge(marching, 24 * 24, 96, 2.0, lambda text: None)
    stock = follow(references.renderer(subject, Way(ways.STOCK), 1), 4.0, truth=truth)
    assert abs(stock.shift[0]) < 4 * stock.shift[1] and stock.shift[1] < 0.03
    assert between(1, 0)[0].mean() > 0


def test_the_exported_mesh_stands_where_the_field_is(folder):
    """Silhouettes of a turned field and of two fields side by side are the same, and a ball is as bright."""
    for name, least in (("moved", 0.9), ("many", 0.85)):
        subject = Subject(folder / f"{name}.xml", {"res": "64"})
        made = ExportedMesh(subject.scene(1), subject.media, folder)
        stock = {"type": "path", "max_depth": 2, "hide_emitters": True}
        pictures = [np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=16)) for scene, integrator in (
            (made.scene, stock), (subject.scene(1), {"type": "nrf", "hide_emitters": True, "samples": 96}))]
        mesh, field = (picture[..., 3] > 0.5 for picture in pictures)
        assert (mesh & field).sum() > least * (mesh | field).sum()  # measured: 0.94
        part = slice(10, 40), slice(10, 36)  # the largest ball, whose normals are its own
        if name == "moved":
            assert pictures[0][part].mean() == pytest.approx(pictures[1][part].mean(), rel=0.1)
    names = [shlex.split(line)[2:] for line in made.commands.splitlines()]
    assert names == [[f"{small_study.relative(folder)}/seen.safetensors", "-o", f"seen{i}.ply"] for i in ("", 1)]
    assert made.shapes.count("<shape ") == 2 and '<string name="filename" value="seen1.ply"/>' in made.shapes


def test_the_picture_shrinks_until_the_reference_fits(folder):
    subject = Subject(folder / "one.xml", {"res": "256"})
    assert references.choose_shrink(subject, 1e6) == 1 and references.choose_shrink(subject, 1e-3) == 4
    assert references.choose_shrink(Subject(folder / "one.xml", {}), 1e-3) == 1  # small already
    assert subject.pixels(2) == (128, 128)
    film = subject.scene(2).sensors()[0].film()
    assert tuple(film.size()) == (128, 128)


def test_pictures_of_the_mesh_are_taken_from_files_that_fit(folder, subject, tmp_path):
    assert references.shipped(subject.path, {}) is None
    (folder / "reference_point.exr").write_bytes(b"")
    try:
        assert references.shipped(subject.path, {}) == folder / "reference_point.exr"  # by the default of $light
        assert references.shipped(subject.path, {"light": "env"}) is None
    finally:
        (folder / "reference_point.exr").unlink()
    path = tmp_path / "mesh.exr"
    mi.Bitmap(np.kron(np.eye(24), np.ones((2, 2)))[..., None].astype(np.float32) * np.ones(3, np.float32)).write(
        str(path))
    np.testing.assert_allclose(references.captured(subject, path, 1, 1.0).image, np.eye(24)[..., None] * np.ones(3))
    with pytest.raises(MiNtfError, match="has 48×48 pixels, the study's pictures 40×40"):
        references.captured(Subject(folder / "one.xml", {"res": "40"}), path, 1, 1.0)
    traced = references.captured(subject, folder / "one.xml", 1, 0.0)  # any scene will do
    assert traced.image.shape == (24, 24, 3) and 0 < traced.noise < 0.2 and "64 samples" in traced.about


@pytest.mark.parametrize(("text", "found"), [("90s", 90), ("5m", 300), ("1h", 3600), ("1.5m", 90)])
def test_budgets(text, found):
    assert budget.seconds(text) == found


@pytest.mark.parametrize("text", ["5", "m", "-3m", "0s", "5 minutes"])
def test_budgets_that_are_none_are_refused(text):
    with pytest.raises(MiNtfError, match="expected a time of a second or more such as 90s, 5m or 1h"):
        budget.seconds(text)

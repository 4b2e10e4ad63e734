"""Choice of a method under limits of error and time, and by ``auto`` without limits."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.infer.visibility import transmittance_atlas
from mi_ntf.render import log
from mi_ntf.render.scene.settings import Limits
from mi_ntf.render.transport import choosing, pilot

MANY = 1 << 20
"""Frames that share a choice: whatever a pilot takes is worth it."""
FLOOR = {"floor": {"type": "rectangle", "to_world": mi.scalar_rgb.ScalarTransform4f().translate([0.4, -1.5, 0.3])
                   .rotate([1, 0, 0], -90).scale(4)}}


def nrf(**options) -> dict:
    return scenes.nrf(**{"visibility": "auto", "frames": MANY, "environment_lights": 32, "samples": 96, **options})


def clock(monkeypatch, each):
    """Make one sample take `each` seconds of its settings, since small pictures are timed too roughly."""
    plain = pilot.Pilot.look

    def look(self, compose):
        measured = plain(self, compose)
        return pilot.Look(measured.composition, measured.radiance, 0.0, each(measured.composition.settings), 1e-6, 0.0)

    monkeypatch.setattr(pilot.Pilot, "look", look)


def relative(image, truth) -> float:
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


def pictures(loaded, **march):
    """Return pictures by the scene's integrator and by the march, of one seed, and the result of the first."""
    image = scenes.render(loaded, 1)[..., :3]
    truth = np.array(mi.render(loaded, integrator=mi.load_dict(nrf(visibility="raymarch", **march)), seed=1))[..., :3]
    return image, truth, loaded.integrator().achieved


def taken(achieved) -> str:
    return [t["name"] for t in achieved["trials"] if t["taken"]][-1]


@pytest.mark.parametrize("limit", [0.3, 0.06, 1e-6])
@pytest.mark.parametrize("shapes", [None, FLOOR], ids=["alone", "floor"])
def test_the_error_is_kept(blobs, monkeypatch, limit, shapes):
    clock(monkeypatch, lambda s: (2.0 if s.visibility == "raymarch" else 1.0) * s.environment_lights)
    loaded = scenes.scene(blobs, nrf(max_error=limit), {"light": scenes.light("env")}, shapes=shapes, size=32, spp=8)
    image, truth, achieved = pictures(loaded)
    assert relative(image, truth) <= limit
    assert achieved["predicted"]["error"] <= achieved["predicted"]["bound"] <= limit
    if limit == 1e-6:
        assert taken(achieved) == "raymarch"
        np.testing.assert_array_equal(image, truth)  # nothing is left out
    else:
        assert taken(achieved) != "raymarch"


def test_without_max_error_nothing_is_tried(blobs):
    loaded = scenes.scene(blobs, nrf(), {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    assert loaded.integrator().achieved["trials"] == []


def test_small_pictures_are_marched_without_a_pilot(blobs):
    """The pilot would be a large part of small pictures."""
    loaded = scenes.scene(blobs, nrf(max_error=0.5, frames=1), {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    achieved = loaded.integrator().achieved
    assert achieved["visibility"] == "raymarch" and achieved["trials"] == []


def test_a_named_method_stays(blobs):
    """A named method stays whatever its error; omissions may not add to it."""
    loaded = scenes.scene(blobs, nrf(visibility="transmittance_map", map_resolution=8, max_error=1e-3),
                          {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    achieved = loaded.integrator().achieved
    assert achieved["visibility"] == "transmittance_map" and achieved["predicted"]["error"] > 1e-3
    assert achieved["trials"][0]["why"] == "named"
    assert not any(t["taken"] for t in achieved["trials"][1:])


@pytest.mark.parametrize(("omission", "field", "lights", "options"), [
    ("without specular lobes", {"log_density": 3.0, "specular": 0.06, "roughness": 0.9}, "point", {}),
    ("without further bounces", {"log_density": 3.0}, "point", {"max_depth": 4, "bounces": "paths"}),
    ("brightest lights", {"log_density": 3.0}, "lamps", {}),
])
def test_what_hardly_shows_is_left_out(tmp_path, monkeypatch, omission, field, lights, options):
    """An effect is left out if it saves time and the picture's error stays below the limit."""
    cost = {"without specular lobes": lambda s: 1.0 + s.specular, "without further bounces": lambda s: float(
        abs(s.max_depth)), "brightest lights": lambda s: float(s.brightest_lights or 100)}[omission]
    clock(monkeypatch, cost)
    shining = {"sun": scenes.light("point")}
    if lights == "lamps":
        rng = np.random.default_rng(1)
        shining |= {f"l{i}": {"type": "point", "position": [3.4 * c for c in rng.normal(size=3)],
                              "intensity": {"type": "rgb", "value": 0.05}} for i in range(15)}
    path = scenes.write_blobs(tmp_path, **field)
    for limit in (0.3, 1e-4):
        loaded = scenes.scene(path, nrf(visibility="raymarch", max_error=limit, **options), shining, size=24, spp=2,
                              shapes=FLOOR if options else None)
        image, truth, achieved = pictures(loaded, **options)
        left_out = any(t["taken"] and omission in t["name"] for t in achieved["trials"])
        assert left_out == (limit == 0.3)
        assert relative(image, truth) <= limit and (relative(image, truth) > 0) == left_out


@pytest.mark.parametrize("shown", [True, False])
def test_a_field_of_a_few_pixels_is_left_out_or_seen(blobs, monkeypatch, shown):
    """The pilot looks at fields of any size; one as bright as a lamp stays."""
    clock(monkeypatch, lambda s: 1.0 - 0.5 * len(s.without_media))
    center, radius = np.array([-1.6, 0.2, -3.0]), 0.12
    size = radius / scenes.SIMILARITY.radius
    place = mi.ScalarTransform4f().translate((center - size * np.array(scenes.SIMILARITY.center)).tolist()).scale(size)
    far = scenes.ball(blobs, scenes.Similarity(tuple(center), radius), to_world=place)
    lights = {"sun": scenes.light("directional")}
    if shown:
        lights["lamp"] = {"type": "point", "position": [-1.5, 0.3, -2.6], "intensity": {"type": "rgb", "value": 100}}
    loaded = scenes.scene(blobs, nrf(visibility="raymarch", max_error=0.1), lights,
                          shapes={"far": far}, size=64, spp=1)
    image, truth, achieved = pictures(loaded)
    trial = next(t for t in achieved["trials"] if "1 of the fields" in t["name"])
    assert trial["taken"] != shown
    assert relative(image, truth) <= 0.1 and (relative(image, truth) > 0) != shown


@pytest.mark.parametrize("light_samples", [0, 3])
def test_a_sharp_lobe_keeps_lights_that_would_glint(tmp_path, monkeypatch, light_samples):
    """Fewer lights of a sky are judged by many rays without shadows if a lobe is sharp."""
    clock(monkeypatch, lambda s: float(s.environment_lights))
    calls = []
    plain = choosing.Chooser._glints
    monkeypatch.setattr(choosing.Chooser, "_glints", lambda self, fewer: calls.append(
        plain(self, fewer)) or calls[-1])
    path = scenes.write_blobs(tmp_path, log_density=3.0, specular=0.3, roughness=0.5)
    options = {"light_samples": light_samples, "environment_lights": 128}
    loaded = scenes.scene(path, nrf(visibility="raymarch", max_error=0.6, **options), {"light": scenes.light("env")},
                          size=32, spp=2)
    image, truth, _ = pictures(loaded, **options)
    assert relative(image, truth) <= 0.6
    assert [c.bound > 0 for c in calls[:1]] == [True] * (light_samples == 0)


def test_frames_keep_the_choice(blobs, monkeypatch):
    loaded = scenes.scene(blobs, nrf(max_error=0.3), {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    first = loaded.integrator().achieved
    monkeypatch.setattr(pilot.Pilot, "__init__", None)
    mi.render(loaded, seed=1)
    assert loaded.integrator().achieved["trials"] == first["trials"] != []


def test_other_lights_are_another_choice(blobs):
    """The choice is reused for the same settings and number of lights alone."""
    choices = []
    for lights in ({"light": scenes.light("env")}, {"light": scenes.light("point")}):
        loaded = scenes.scene(blobs, nrf(max_error=0.3), lights, size=16, spp=1)
        before = choices[0] if choices else None
        chooser = choosing.Chooser(loaded, loaded.integrator().context.settings, Limits(error=0.3),
                                   loaded.sensors()[0], 1, previous=before)
        choices.append(chooser.choose()[1])
    one, other = choices
    assert one.key != other.key and one.trials != other.trials


def chosen_in(blobs, monkeypatch, budget: float, each):
    clock(monkeypatch, each)
    loaded = scenes.scene(blobs, nrf(time_budget=budget, map_resolution=4), {"light": scenes.light("point")}, size=16,
                          spp=1)
    context = loaded.integrator().context
    return choosing.Chooser(loaded, context.settings, context.limits, loaded.sensors()[0], 1).choose()


@pytest.mark.parametrize(("march", "other", "visibility"), [
    (1e-4, 1e-5, "raymarch"), (50.0, 1e-3, "transmittance_map")])
def test_a_budget_takes_what_errs_least_in_its_time(blobs, monkeypatch, march, other, visibility):
    """The error has noise and bias: a slow march has much noise, a fast one has little."""
    composition, choice = chosen_in(blobs, monkeypatch, 10.0, lambda s: march if s.visibility == "raymarch" else other)
    assert composition.effects.visibility == visibility
    assert choice.predicted["seconds"] == 10.0 and choice.predicted["error"] <= choice.predicted["bound"]


def test_a_budget_that_cannot_be_kept_is_said(blobs, monkeypatch, capfd):
    mi.set_log_level(mi.LogLevel.Warn)
    chosen_in(blobs, monkeypatch, 0.5, lambda s: 50.0)
    assert "one sample a pixel takes about 50 s" in "".join(capfd.readouterr())


@pytest.mark.parametrize(("light", "size", "spp", "frames", "visibility"), [
    ("point", 64, 16, 1, "raymarch"), ("point", 64, 16, 100, "transmittance_atlas"),
    ("env", 64, 32, 1, "transmittance_atlas"), ("env", 8, 1, 1, "raymarch")])
def test_auto_counts_rays(blobs, light, size, spp, frames, visibility):
    """Camera rays × lights × frames against the rays that fill an atlas."""
    loaded = scenes.scene(blobs, nrf(frames=frames), {"light": scenes.light(light)}, size=size, spp=spp)
    chooser = choosing.Chooser(loaded, loaded.integrator().context.settings, Limits(), loaded.sensors()[0], spp)
    lights = 32 if light == "env" else 1
    assert (size * size * spp * lights * frames > transmittance_atlas.RAYS) == (visibility != "raymarch")
    assert chooser.choose()[0].effects.visibility == visibility


def test_the_log_of_a_limited_render_is_one_line_and_its_trials_are_at_level_debug(blobs, monkeypatch):
    """The line has no number that was not measured."""
    lines: dict[str, list[str]] = {"info": [], "debug": []}
    for level, texts in lines.items():
        monkeypatch.setattr(log, level, texts.append)
    integrator = nrf(max_error=0.1, noise_threshold=0.5)
    loaded = scenes.scene(blobs, integrator, {"light": scenes.light("env")}, size=32, spp=2)
    mi.render(loaded)
    [outcome] = [text for text in lines["info"] if "ended by" in text]
    assert len(outcome) < 160 and "error below" in outcome and "noise" in outcome
    assert not any("nan" in text for text in lines["info"])
    trials = loaded.integrator().achieved["trials"]
    assert len(trials) > 1 and not any(trial["name"] in text for trial in trials if not trial["taken"]
                                       for text in lines["info"])
    assert len([text for text in lines["debug"] if "nrf integrator" in text]) >= len(trials)


def test_what_is_left_out_of_a_view_is_in_the_next(blobs, monkeypatch):
    """Frames share the method; what one picture lacks may fill the next, which another camera, or a change, shows."""
    clock(monkeypatch, lambda s: 1.0 - 0.5 * bool(s.without_media))
    aside = mi.ScalarTransform4f().translate([9, 0, 0]).scale(0.3)
    shapes = {"aside": scenes.ball(blobs, to_world=aside) | {"to_world": aside}}
    loaded = scenes.scene(blobs, nrf(max_error=0.2, max_depth=2), {"light": scenes.light("directional")}, size=32,
                          spp=8, shapes=shapes)
    camera = mi.traverse(loaded.sensors()[0])
    before = camera["to_world"]
    seen = []
    for offset in (0, 9):
        camera["to_world"] = mi.Transform4f(mi.ScalarTransform4f().translate([offset, 0, 0])) @ before
        camera.update()
        seen.append(float(scenes.render(loaded)[..., 3].mean()))
        seen.append(loaded.integrator().context.choice.settings.without_media)
    assert seen[1] == (0,) and seen[0] > 0.1 and seen[2] > 0.01 and 0 not in seen[3]

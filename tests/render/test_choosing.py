"""What is chosen under limits of error and time."""

import math
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.render.cost import model
from mi_ntf.render.scene.settings import Limits, Settings
from mi_ntf.render.transport import choosing, estimate, glints, omissions, probing, trials


def nrf(**options) -> dict:
    return {"type": "nrf", "hide_emitters": True, **options}


def relative(image, truth) -> float:
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


@pytest.fixture
def trials_are_free(monkeypatch):
    """As if every picture were large; of the methods those that are built fast."""
    for least in ("LOOK", "TRIAL", "LEFT_OUT"):
        monkeypatch.setattr(choosing, least, 0.0)
    monkeypatch.setattr(choosing, "REGISTRY", {n: REGISTRY[n] for n in ("raymarch", "transmittance_map")})


def prices(monkeypatch, each):
    """Every sample takes `each(settings)` seconds: small pictures are measured too roughly to be told apart."""
    plain = probing.Probes.look

    def look(self, compose):
        found = plain(self, compose)
        return replace(found, built=0.0, each=each(found.composition.settings))

    monkeypatch.setattr(probing.Probes, "look", look)


@pytest.mark.parametrize("limit", [0.3, 0.06, 1e-4])
def test_the_error_is_kept(blobs, trials_are_free, monkeypatch, limit):
    prices(monkeypatch, lambda s: (2.0 if s.visibility == "raymarch" else 1.0) * s.environment_lights / 512)
    loaded = scenes.scene(blobs, nrf(max_error=limit), {"light": scenes.light("env")}, size=32, spp=2)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    march = mi.load_dict(nrf(visibility="raymarch"))
    truth = mi.render(loaded, integrator=march, seed=1).numpy()[..., :3]
    found = loaded.integrator().achieved
    assert relative(image, truth) <= limit
    assert found["predicted"]["error"] <= limit
    assert (limit > 1e-3) == any(t["taken"] and t["error"] for t in found["trials"])
    if limit == 1e-4:
        assert found["visibility"] == "raymarch"
        np.testing.assert_array_equal(image, truth)  # nothing is left out


def test_without_max_error_nothing_is_left_out(blobs, trials_are_free):
    loaded = scenes.scene(blobs, nrf(), {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    assert loaded.integrator().achieved["trials"] == []


def test_a_named_method_stays(blobs, trials_are_free):
    """Whatever its error, and what is left out may not add to it."""
    loaded = scenes.scene(blobs, nrf(visibility="transmittance_map", map_resolution=8, max_error=1e-3),
                          {"light": scenes.light("env")}, size=16, spp=1)
    mi.render(loaded)
    found = loaded.integrator().achieved
    assert found["visibility"] == "transmittance_map" and found["predicted"]["error"] > 1e-3
    assert found["trials"][0]["why"] == "named"
    assert not any(t["taken"] for t in found["trials"][1:])


def test_a_faint_lobe_is_left_out(tmp_path, trials_are_free, monkeypatch):
    """Where the prices say that it saves enough."""
    path = scenes.write_blobs(tmp_path, log_density=3.0, specular=0.06, roughness=0.9)
    plain = estimate.Estimate.seconds
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: plain(self, s) * (1 if s.specular else 0.5))
    prices(monkeypatch, lambda s: 1.0 if s.specular else 0.5)
    loaded = scenes.scene(path, nrf(visibility="raymarch", max_error=0.1), {"light": scenes.light("point")}, size=24)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    found = loaded.integrator().achieved
    assert [t["name"] for t in found["trials"] if t["taken"]][-1] == "raymarch without specular lobes"
    whole = mi.render(loaded, integrator=mi.load_dict(nrf(visibility="raymarch")), seed=1).numpy()[..., :3]
    assert 0 < relative(image, whole) <= 0.1


@pytest.mark.parametrize("roughness, looked", [(0.3, True), (0.75, False)], ids=["sharp lobe", "faint lobe"])
def test_glints_are_looked_for_in_sharp_lobes(tmp_path, trials_are_free, monkeypatch, roughness, looked):
    """Half of the lights make 4.9 % of error there without any shadow; a lobe below a third of a white surface is taken
    to make none."""
    path = scenes.write_blobs(tmp_path, log_density=3.0, specular=0.3, roughness=roughness)
    prices(monkeypatch, lambda s: s.environment_lights / 512)
    loaded = scenes.scene(path, nrf(max_error=0.1), {"light": scenes.light("env")}, size=32, spp=2)
    found = {}
    plain = glints.Glints.error
    monkeypatch.setattr(glints.Glints, "error", lambda self, settings, spp: found.setdefault(
        settings.environment_lights, plain(self, settings, spp)))
    mi.render(loaded, seed=1)
    assert (max(found.values()) > 0.01) == looked and (min(found.values()) == 0) != looked


def test_what_half_of_the_lights_would_err_by_is_foreseen():
    """Errors of independent lights: a bias of 0.9 %, and 1 % · √(1024/n) of n lights; of one known nothing is."""
    errors = [math.hypot(0.009, 0.01 * math.sqrt(1024 / n)) for n in (512, 256, 128)]
    assert omissions.halved(errors[:2]) == pytest.approx(errors[2])
    assert omissions.halved(errors[:1]) == 0.0


def test_half_of_the_lights_is_not_tried_where_it_must_fail(blobs, trials_are_free, monkeypatch):
    prices(monkeypatch, lambda s: s.environment_lights / 512)
    monkeypatch.setattr(trials.Trials, "_error", lambda self, look, caution=0.0: {512: 0.0, 256: 0.1}.get(
        look.composition.settings.environment_lights, 0.0))
    loaded = scenes.scene(blobs, nrf(visibility="raymarch", max_error=0.15), {"light": scenes.light("env")}, size=32,
                          spp=2)
    mi.render(loaded, seed=1)  # 0.1·√3 > 0.15
    assert [t["taken"] for t in loaded.integrator().achieved["trials"] if "half" in t["name"]] == [True]


def test_lights_whose_lack_would_glint_are_kept(blobs, trials_are_free, monkeypatch):
    """Of what else keeps to the error, the fewest lights that do."""
    prices(monkeypatch, lambda s: s.environment_lights / 512)
    monkeypatch.setattr(glints.Glints, "error", lambda self, settings, spp: 1.0 * (settings.environment_lights < 200))
    loaded = scenes.scene(blobs, nrf(visibility="raymarch", max_error=0.3), {"light": scenes.light("env")}, size=32,
                          spp=2)
    mi.render(loaded, seed=1)
    halves = [t for t in loaded.integrator().achieved["trials"] if "half" in t["name"]]
    assert [t["taken"] for t in halves] == [True] + [False] * (len(halves) - 1) and len(halves) > 1
    assert {t["why"] for t in halves[1:]} == {"kept: fewer lights would glint"}


@pytest.fixture
def smoke(tmp_path, trials_are_free, monkeypatch):
    """``(frames, error)`` → a chooser under 512 lights, of the march and the atlas, that has chosen, and its choice."""
    monkeypatch.setattr(choosing, "REGISTRY", {n: REGISTRY[n] for n in ("raymarch", "transmittance_atlas")})
    prices(monkeypatch, lambda s: (10 if s.visibility == "raymarch" else 1) * s.environment_lights / 512)
    path = scenes.write_blobs(tmp_path, log_density=0.5)
    loaded = scenes.scene(path, nrf(), {"light": scenes.light("env")}, size=64, spp=2)

    def chosen(frames: int, error: float):
        settings = Settings.of(loaded.integrator()).but(frames=frames)
        chooser = choosing.Chooser(loaded, settings, Limits(error=error), loaded.sensors()[0], 2, None, whole=True)
        return chooser, chooser.choose()

    return chosen


@pytest.mark.parametrize("frames, pixels", [(1, 204), (560, 820)])
def test_probes_in_smoke_march_to_few_lights(smoke, monkeypatch, frames, pixels):
    """An atlas adds the others: the truth is off by 0.11 %, measured, and errors by 1 % of themselves; also where more
    pixels are looked at afterwards, as many where the march takes as long."""
    prices(monkeypatch, lambda s: 10 if s.visibility == "raymarch" else s.environment_lights / 512)
    few, _ = smoke(frames, 0.02)
    monkeypatch.setattr(trials, "MARCHED", 512)
    all_, _ = smoke(frames, 0.02)
    assert [c.truth.composition.settings.environment_lights for c in (few, all_)] == [128, 512]
    assert len(few.truth.radiance) == len(all_.truth.radiance) == pixels
    assert relative(few.truth.radiance, all_.truth.radiance) < 2e-3
    assert few.trials[0].error == pytest.approx(all_.trials[0].error, rel=0.03)


def test_a_march_that_is_chosen_goes_to_all_lights(smoke):
    """Its probes too, which tell what may be left out."""
    chooser, choice = smoke(1, 1e-4)
    settings = choice.composition.settings
    assert (settings.visibility, settings.environment_lights, choice.predicted["error"]) == ("raymarch", 512, 0)
    assert chooser.truth.composition.settings == settings


def test_dim_lights_are_left_out(blobs, trials_are_free, monkeypatch):
    """Forty of a thousandth of the light of the one beside them; as many steps as keep to the error."""
    prices(monkeypatch, lambda s: 1.0 - s.dimmest)
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: self._count(s) * (s.visibility == "raymarch"))
    rng = np.random.default_rng(1)
    lamps = {f"l{i}": {"type": "point", "position": [3.4 * c for c in rng.normal(size=3)],
                       "intensity": {"type": "rgb", "value": 0.05}} for i in range(40)}
    loaded = scenes.scene(blobs, nrf(visibility="raymarch", max_error=0.05), {"sun": scenes.light("point"), **lamps},
                          size=16, spp=2)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    found = loaded.integrator().achieved
    assert [t["name"] for t in found["trials"] if t["taken"]][-1] == "raymarch without dim lights"
    whole = mi.render(loaded, integrator=mi.load_dict(nrf(visibility="raymarch")), seed=1).numpy()[..., :3]
    assert 0 < relative(image, whole) <= 0.05


@pytest.mark.parametrize("shown", [True, False])
def test_a_field_of_a_few_pixels_is_left_out_or_seen(blobs, trials_are_free, monkeypatch, shown):
    """Probes go to it, however small: where it is as bright as a lamp, it stays."""
    prices(monkeypatch, lambda s: 1.0 - 0.5 * len(s.without))
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: 1.0 - 0.5 * len(s.without))
    center, radius = np.array([-1.6, 0.2, -3.0]), 0.12
    size = radius / scenes.SIMILARITY.radius
    place = mi.ScalarTransform4f().translate((center - size * np.array(scenes.SIMILARITY.center)).tolist()).scale(size)
    far = scenes.ball(blobs, scenes.Similarity(tuple(center), radius), to_world=place)
    lights = {"sun": scenes.light("directional")}
    if shown:
        lights["lamp"] = {"type": "point", "position": [-1.5, 0.3, -2.6], "intensity": {"type": "rgb", "value": 100}}
    loaded = scenes.scene(blobs, nrf(visibility="raymarch", max_error=0.1), lights,
                          shapes={"far": far}, size=64, spp=1)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    whole = mi.render(loaded, integrator=mi.load_dict(nrf(visibility="raymarch")), seed=1).numpy()[..., :3]
    (trial,) = [t for t in loaded.integrator().achieved["trials"] if "small fields" in t["name"]]
    assert trial["taken"] != shown
    assert relative(image, whole) <= 0.1 and (relative(image, whole) > 0) != shown


@pytest.mark.parametrize(("frames", "visibility"), [(1, "raymarch"), (20, "transmittance_map")])
def test_frames_share_what_is_built_and_the_choice(blobs, monkeypatch, frames, visibility):
    """What does not pay for one picture pays for many; pixels are rendered beforehand for the first alone."""
    monkeypatch.setattr(choosing, "REGISTRY", {n: REGISTRY[n] for n in ("raymarch", "transmittance_map")})
    prices(monkeypatch, lambda s: 2.0 if s.visibility == "raymarch" else 1.95)
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: 2.0 if s.visibility == "raymarch" else 1.95)
    loaded = scenes.scene(blobs, nrf(max_error=0.3, frames=frames), {"light": scenes.light("point")}, size=16, spp=1)
    mi.render(loaded)
    first = loaded.integrator().achieved
    assert first["visibility"] == visibility
    monkeypatch.setattr(probing.Probes, "__init__", None)
    mi.render(loaded, seed=1)
    assert loaded.integrator().achieved["trials"] == first["trials"]


@pytest.mark.parametrize(("of_all", "taken"), [(True, "transmittance_map"), (False, "raymarch")])
def test_what_may_keep_to_a_small_limit_is_tried(blobs, trials_are_free, monkeypatch, of_all, taken):
    """Whatever is usual of other scenes; but for maps of one logistic, which are far off on nearly all."""
    monkeypatch.setattr(probing.Probes, "error", lambda *_: 0.0)
    changed = replace(REGISTRY["transmittance_map"], per_field=of_all)
    for module in (choosing, estimate):
        monkeypatch.setattr(module, "REGISTRY", {"raymarch": REGISTRY["raymarch"], "transmittance_map": changed})
    monkeypatch.setattr(choosing, "FINER", {})
    prices(monkeypatch, lambda s: 2.0 if s.visibility == "raymarch" else 1.0)
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: 2.0 if s.visibility == "raymarch" else 1.0)
    loaded = scenes.scene(blobs, nrf(max_error=0.005), {"light": scenes.light("point")}, size=16, spp=1)
    mi.render(loaded)
    assert loaded.integrator().achieved["visibility"] == taken


@pytest.mark.parametrize(("gain", "spp", "more", "taken"), [
    (0.2, 1, 2, "transmittance_map"), (0.97, 1, 1, "raymarch"), (0.97, 128, 4, "transmittance_map")])
def test_chance_is_asked_again_where_much_is_at_stake(blobs, trials_are_free, monkeypatch, gain, spp, more, taken):
    """A method that few pixels refuse by their margin alone, and twice as many do not; of many samples more pixels are
    looked at anyway."""
    counts = []

    def error(self, found, truth, spp, caution=0.5, off=None):
        counts.append(self.count)
        return 0.0 if found is truth else 0.08 + 0.04 * caution * (counts[0] / self.count) ** 3

    monkeypatch.setattr(probing.Probes, "error", error)
    of_all = replace(REGISTRY["transmittance_map"], per_field=True)
    monkeypatch.setattr(choosing, "REGISTRY", {"raymarch": REGISTRY["raymarch"], "transmittance_map": of_all})
    prices(monkeypatch, lambda s: 2.0 if s.visibility == "raymarch" else 2.0 * gain)
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: spp * (1.0 + (s.visibility == "raymarch")))
    loaded = scenes.scene(blobs, nrf(max_error=0.1), {"light": scenes.light("point")}, size=128, spp=spp)
    mi.render(loaded)
    assert loaded.integrator().achieved["visibility"] == taken
    assert max(counts) / min(counts) == pytest.approx(more, rel=0.02)


@pytest.mark.parametrize(("moves", "maps"), [((), (1, 2, 3, 4)), ((0,), ()), ((1,), (1,))])
def test_lights_that_stand_still_share_their_maps(blobs, trials_are_free, monkeypatch, moves, maps):
    """A map that is made anew for each frame is dearer than the march, one that is made once is not. `moves`: frames
    after which a light moves; `maps`: frames with maps, none once anything has moved."""
    def each(settings):
        return 2.0 if settings.visibility == "raymarch" else 1.0 if settings.still else 3.0

    prices(monkeypatch, each)
    monkeypatch.setattr(estimate.Estimate, "seconds", lambda self, s: each(s))
    loaded = scenes.scene(blobs, nrf(max_error=0.3, frames=20), {"light": scenes.light("point")}, size=16, spp=1)
    params, taken = mi.traverse(loaded), []
    for frame in range(5):
        mi.render(loaded, seed=frame)
        taken.append(loaded.integrator().achieved["visibility"])
        if frame in moves:
            params["light.position"] += mi.Point3f(0.01, 0, 0)
            params.update()
    assert taken == ["transmittance_map" if frame in maps else "raymarch" for frame in range(5)]


def test_time_for_the_march(blobs):
    """Where it fits it has no error; where not even one sample does, that is said."""
    lights = {"light": scenes.light("env")}
    loaded = scenes.scene(blobs, nrf(time_budget=30), lights, size=16, spp=1)
    chooser = choosing.Chooser(loaded, choosing.Settings.of(loaded.integrator()), loaded.integrator().limits,
                               loaded.sensors()[0], 1, None)
    assert chooser.choose().composition.effects.visibility == "raymarch"


@pytest.mark.parametrize(("gain", "tried"), [(0.6, False), (0.01, True)])
def test_a_trial_of_much_of_the_time_must_promise_much(blobs, monkeypatch, gain, tried):
    """Of 100 s, a map of 30: what makes the error a little smaller in the rest is not worth it."""
    prices(monkeypatch, lambda s: 1.0 if s.visibility == "raymarch" else gain)
    monkeypatch.setattr(choosing, "REGISTRY", {n: REGISTRY[n] for n in ("raymarch", "transmittance_map")})
    monkeypatch.setattr(estimate.Estimate, "built", lambda self, s: 30.0)
    monkeypatch.setattr(estimate.Estimate, "each", lambda self, s: 1.0 if s.visibility == "raymarch" else gain)
    loaded = scenes.scene(blobs, nrf(time_budget=100), {"light": scenes.light("point")}, size=16, spp=1)
    chooser = choosing.Chooser(loaded, choosing.Settings.of(loaded.integrator()), loaded.integrator().limits,
                               loaded.sensors()[0], 1, None)
    chooser.choose()
    assert (len(chooser.trials) > 1) == tried


def test_what_is_too_slow_is_given_up(blobs, monkeypatch):
    """Not even one sample by the march fits into the time; a map that takes most of it leaves room for some."""
    prices(monkeypatch, lambda s: 50.0 if s.visibility == "raymarch" else 1.0)
    monkeypatch.setattr(choosing, "REGISTRY", {n: REGISTRY[n] for n in ("raymarch", "transmittance_map")})
    monkeypatch.setattr(estimate.Estimate, "built", lambda self, s: 8.0)
    monkeypatch.setattr(estimate.Estimate, "each", lambda self, s: 0.01)
    loaded = scenes.scene(blobs, nrf(time_budget=10), {"light": scenes.light("point")}, size=16, spp=1)
    chooser = choosing.Chooser(loaded, choosing.Settings.of(loaded.integrator()), loaded.integrator().limits,
                               loaded.sensors()[0], 1, None)
    assert chooser.choose().composition.effects.visibility == "transmittance_map"


def test_a_budget_that_cannot_be_kept_is_said(blobs, monkeypatch, capfd):
    monkeypatch.setattr(model, "seconds", lambda *_: {"all": 50.0})
    loaded = scenes.scene(blobs, nrf(time_budget=0.5), {"light": scenes.light("point")}, size=8, spp=1)
    mi.set_log_level(mi.LogLevel.Warn)
    image = mi.render(loaded).numpy()
    assert "one sample a pixel takes about 50 s" in "".join(capfd.readouterr())
    assert image[..., :3].mean() > 0  # all the same

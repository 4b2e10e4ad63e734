"""What is chosen under limits of error and time."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.render.cost import model
from mi_ntf.render.transport import choosing


def nrf(**options) -> dict:
    return {"type": "nrf", "hide_emitters": True, **options}


def relative(image, truth) -> float:
    return float(np.sqrt(((image - truth) ** 2).mean() / (truth**2).mean()))


@pytest.fixture
def trials_are_free(monkeypatch):
    """As if every picture were large."""
    monkeypatch.setattr(choosing, "TRIAL", 0.0)


@pytest.mark.parametrize("limit", [0.3, 0.06, 1e-4])
def test_the_error_is_kept(blobs, trials_are_free, limit):
    loaded = scenes.scene(blobs, nrf(max_error=limit), {"light": scenes.light("env")}, size=32, spp=2)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    march = mi.load_dict(nrf(visibility="raymarch"))
    truth = mi.render(loaded, integrator=march, seed=1).numpy()[..., :3]
    found = loaded.integrator().achieved
    assert relative(image, truth) <= limit
    assert found["predicted"]["error"] <= 0.9 * limit
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
    plain = choosing.Chooser._seconds
    monkeypatch.setattr(choosing.Chooser, "_seconds",
                        lambda self, composition, s: plain(self, composition, s) * (1 if s.specular else 0.8))
    loaded = scenes.scene(path, nrf(visibility="raymarch", max_error=0.1), {"light": scenes.light("point")}, size=24)
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    found = loaded.integrator().achieved
    assert [t["name"] for t in found["trials"] if t["taken"]][-1] == "raymarch without specular lobes"
    whole = mi.render(loaded, integrator=mi.load_dict(nrf(visibility="raymarch")), seed=1).numpy()[..., :3]
    assert 0 < relative(image, whole) <= 0.1


def test_time_for_the_march(blobs):
    """Where it fits it has no error; where not even one sample does, that is said."""
    lights = {"light": scenes.light("env")}
    loaded = scenes.scene(blobs, nrf(time_budget=1e4), lights, size=16, spp=1)
    chooser = choosing.Chooser(loaded, choosing.Settings.of(loaded.integrator()), loaded.integrator().limits,
                               loaded.sensors()[0], 1, None)
    assert chooser.choose().composition.effects.visibility == "raymarch"


def test_a_budget_that_cannot_be_kept_is_said(blobs, monkeypatch, capfd):
    monkeypatch.setattr(model, "seconds", lambda *_: {"all": 50.0})
    loaded = scenes.scene(blobs, nrf(time_budget=0.5), {"light": scenes.light("point")}, size=8, spp=1)
    mi.set_log_level(mi.LogLevel.Warn)
    image = mi.render(loaded).numpy()
    assert "one sample a pixel takes about 50 s" in "".join(capfd.readouterr())
    assert image[..., :3].mean() > 0  # all the same

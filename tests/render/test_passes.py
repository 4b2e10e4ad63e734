"""Numbers of samples under limits of noise and time."""

import functools
import math

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from benchmarks import scenes as shipped
from mi_ntf.render.scene.settings import Limits
from mi_ntf.render.transport import passes


def nrf(**options) -> dict:
    return {"type": "nrf", "visibility": "raymarch", "hide_emitters": True, **options}


@pytest.mark.parametrize("weights", [(8, 8), (2, 14), (12, 4)])
def test_noise_is_that_of_the_mean(weights):
    """The noise does not depend on how samples are divided, within the accuracy of 64² pixels."""
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 1, (64, 64, 3))
    one, other = (truth + 0.3 / math.sqrt(n) * rng.normal(size=truth.shape) for n in weights)
    whole = (weights[0] * one + weights[1] * other) / 16
    expected = np.abs(whole - truth).sum() / np.sqrt(truth.sum(-1)).sum()
    assert passes.noise(one, other, weights) == pytest.approx(expected, rel=0.02)


def test_black_pictures_have_no_noise():
    assert passes.noise(np.zeros((4, 4, 3)), np.zeros((4, 4, 3)), (1, 1)) == 0


class Machine:
    """Clock of a machine on which a sample takes `each` seconds.

    The first pass takes `compiling` seconds more, and noise falls by √n from `noise`.
    """

    def __init__(self, limits, each=0.1, compiling=2.0, noise=0.5):
        self.now, self.each, self.compiling, self.noise = 0.0, each, compiling, noise
        self.passes = passes.Passes(limits, lambda: self.now)

    def run(self):
        samples = self.passes.first(16, 1)
        while samples:
            self.now += samples * self.each + (0 if self.passes.passes else self.compiling)
            n = self.passes.count + samples
            self.passes.done(samples, self.noise / math.sqrt(n) if self.passes.passes else math.nan)
            samples = self.passes.next()
        return self.passes


def test_noise_ends_it():
    end = Machine(Limits(noise=0.02)).run()
    assert end.ended == "noise" and end.noise <= 0.02
    assert 625 <= end.count <= 625 * 9 / 8  # (0.5/0.02)², and the least that a pass adds


@pytest.mark.parametrize("each", [1e-4, 0.02, 0.7])
def test_time_is_kept_and_used(each):
    end = Machine(Limits(seconds=20), each=each).run()
    assert end.ended in ("time", "samples") and end.seconds <= 20
    assert end.seconds >= 18 or end.count == passes.MOST


def test_the_choice_is_no_pass():
    """The choice takes time of the budget, but a further pass need not last as long."""
    machine = Machine(Limits(seconds=20), each=0.5, compiling=0.0)
    machine.now = 12.0  # spent on the choice
    end = machine.run()
    assert 18 <= end.seconds <= 20 and end.count >= 12


def test_the_first_limit_wins():
    assert Machine(Limits(noise=0.2, seconds=20)).run().ended == "noise"
    assert Machine(Limits(noise=0.002, seconds=20)).run().ended == "time"


def test_one_pass_when_there_is_no_time():
    """A picture has at least one sample per pixel, even if that exceeds the time."""
    end = Machine(Limits(seconds=1), each=5).run()
    assert (end.count, end.ended) == (1, "time")


def test_noise_threshold_is_reached(blobs):
    """The noise is measured against a picture of many more samples."""
    loaded = scenes.scene(blobs, nrf(noise_threshold=0.03), {"light": scenes.light("point")}, size=24)
    integrator = loaded.integrator()
    image = mi.render(loaded, seed=1).numpy()[..., :3]
    end = integrator.achieved
    assert end["ended"] == "noise" and end["noise"] <= 0.03 and end["passes"] > 2
    plain = mi.load_dict(nrf())
    truth = np.mean([mi.render(loaded, integrator=plain, seed=s, spp=1024).numpy()[..., :3] for s in (2, 3)], axis=0)
    off = np.abs(image - truth).sum() / np.sqrt(np.maximum(truth.sum(-1), 0)).sum()
    assert 0.03 / 1.3 < off < 0.03 * 1.3


@functools.cache
def smoke():
    """Return a scene and its picture of 128 samples, whose noise is far below the limits."""
    loaded = shipped.scene("cloud", "point", 48, 4)
    return loaded, shipped.picture(loaded, shipped.integrator(visibility="raymarch"), 100, 128)[0]


@pytest.mark.parametrize(("threshold", "samples"), [(0.1, (2, 2)), (0.01, (4, 16))])
def test_noise_of_smoke_is_reached(threshold, samples):
    """The noise is within a factor of 1.3 of the limit, or there are two samples, the least that can tell noise."""
    loaded, truth = smoke()
    nrf = shipped.integrator(visibility="raymarch", noise_threshold=threshold)
    image = shipped.picture(loaded, nrf, 1)[0]
    assert samples[0] <= nrf.achieved["spp"] <= samples[1]
    np.testing.assert_array_equal(loaded.sensors()[0].film().develop().numpy()[..., :3], image.astype(np.float32))
    off = np.abs(image - truth).sum() / np.sqrt(np.maximum(truth.sum(-1), 0)).sum()
    assert off < 1.3 * threshold and (off > threshold / 1.3 or nrf.achieved["spp"] == 2)


def test_more_passes_are_the_same_picture(blobs):
    """Depth, alpha and light of passes agree with one pass of as many samples, and the film holds them."""
    loaded = scenes.scene(blobs, nrf(noise_threshold=0.01, aovs="depth,opacity"), {"light": scenes.light("point")},
                          size=16,
                          film_options={"rfilter": {"type": "gaussian"}})
    passed = mi.render(loaded, seed=1).numpy()
    np.testing.assert_array_equal(loaded.sensors()[0].film().develop().numpy(), passed)
    count = loaded.integrator().achieved["spp"]
    plain = mi.load_dict(nrf(aovs="depth,opacity"))
    whole = mi.render(loaded, integrator=plain, seed=2, spp=count).numpy()
    assert passed.shape == whole.shape
    for channel in (*range(4), 5):  # light, alpha, opacity
        assert passed[..., channel].mean() == pytest.approx(whole[..., channel].mean(), rel=0.01)
    full = whole[..., 5] > 0.5
    np.testing.assert_allclose(passed[full][:, 4], whole[full][:, 4], rtol=0.02)


def test_the_clock_waits_for_a_pass(blobs, monkeypatch):
    """A pass ends with its kernels, whose time would count for the next pass otherwise."""
    events, sync, done = [], dr.sync_thread, passes.Passes.done
    monkeypatch.setattr(dr, "sync_thread", lambda: (events.append("wait"), sync()))
    monkeypatch.setattr(passes.Passes, "done", lambda self, *about: (events.append("read"), done(self, *about)))
    mi.render(scenes.scene(blobs, nrf(noise_threshold=0.05), {"light": scenes.light("point")}, size=8))
    reads = [i for i, event in enumerate(events) if event == "read"]
    assert len(reads) > 2 and all(events[i - 1] == "wait" for i in reads)


def test_without_limits_samples_are_one_pass(blobs):
    loaded = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=8)
    mi.render(loaded, spp=16)
    assert (loaded.integrator().achieved["passes"], loaded.integrator().achieved["spp"]) == (1, 16)

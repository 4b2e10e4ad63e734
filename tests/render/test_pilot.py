"""Places of the pilot's rays, errors with their bounds, and random numbers that all candidates share."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.render import timing
from mi_ntf.render.scene.media import find_media
from mi_ntf.render.transport import pilot
from mi_ntf.render.transport.composition import Composition

FLOOR = {"type": "rectangle", "to_world": mi.scalar_rgb.ScalarTransform4f().translate([0.4, -1.5, 0.3])
         .rotate([1, 0, 0], -90).scale(4)}
LAMP = {"type": "sphere", "center": [3.4, 3.0, 2.5], "radius": 0.8, "emitter": {"type": "area", "radiance": 20.0}}
LEAF = {"type": "rectangle", "to_world": mi.scalar_rgb.ScalarTransform4f().translate([0.9, 0.2, 2.0]).scale(0.7),
        "bsdf": {"type": "mask", "opacity": {"type": "checkerboard", "color0": 0.2, "color1": 0.9},
                 "nested": {"type": "twosided", "bsdf": {"type": "diffuse"}}}}


def look_of(loaded, **changed):
    """Return a function of changes of the settings that gives the pilot's look, and the pilot."""
    sensor = loaded.sensors()[0]
    one = pilot.Pilot(sensor, find_media(loaded))
    settings = loaded.integrator().context.settings

    def look(**changed):
        return one.look(lambda: Composition(loaded, replace(settings, **changed), sensor, 4))

    return look, one


def test_weights_make_means_of_the_picture(rng):
    """Weighted means estimate means over the picture for any boxes, here of an indicator, by a z-test."""
    boxes = [(np.array([0.1, 0.2]), np.array([0.3, 0.25])), (np.array([0.2, 0.1]), np.array([0.9, 0.8]))]
    places, weight = pilot._places(4096, boxes)
    assert weight.sum() == pytest.approx(1, abs=0.02)
    inside = ((places >= 0.15) & (places <= 0.4)).all(0)
    spread = np.sqrt((weight**2).sum() * inside.mean())
    assert abs(weight @ inside - 0.25**2) < 4 * spread
    assert (weight[inside].min(), weight.max()) != (weight.max(), weight.max())  # more places within boxes


def some_looks(rng, one, bias: float, noise: float):
    """Return a look and a truth that differ by a `bias` common to both samples and a `noise` of each."""
    truth = rng.uniform(0.5, 1.5, (len(one.weight), 1, 3)) * np.ones((1, pilot.SAMPLES, 1))
    shape = (len(one.weight), 1, 1)
    off = bias * rng.normal(size=shape) + noise * rng.normal(size=(len(one.weight), pilot.SAMPLES, 1))
    power = np.sqrt((truth**2).mean())
    return (pilot.Look(None, a, 0.0, 1.0, 0.0, 0.0) for a in (truth + power * off, truth))


@pytest.fixture
def one(blobs):
    loaded = scenes.scene(blobs, scenes.nrf(), {"light": scenes.light("point")}, size=64, spp=4)
    return pilot.Pilot(loaded.sensors()[0], find_media(loaded))


@pytest.mark.parametrize(("bias", "noise", "samples"), [(0.02, 0.0, 4), (0.02, 0.1, 16), (0.0, 0.05, 4)])
def test_errors_are_those_of_pictures(rng, one, bias, noise, samples):
    """The estimate has the bias and the picture's noise; the bound is above in nearly all of 200 pilots."""
    expected = np.hypot(bias, noise / np.sqrt(samples))
    errors = [one.error(*some_looks(rng, one, bias, noise), samples) for _ in range(200)]
    squares = np.array([e.estimate**2 for e in errors])
    # The mean of squares has a spread of its own; estimates below 0 are cut, at most half of them without a bias.
    assert squares.mean() == pytest.approx(expected**2, abs=4 * squares.std() / np.sqrt(200) + 0.02 * expected**2)
    assert np.mean([e.bound >= expected for e in errors]) > 0.95
    assert np.median([e.bound for e in errors]) < 1.5 * expected


def test_a_black_truth_has_no_error(one):
    dark = pilot.Look(None, np.zeros((len(one.weight), pilot.SAMPLES, 3)), 0, 0, 0, 0)
    assert one.error(dark, dark, 4) == (0.0, 0.0) and one.noise(dark) == 0.0 and one.samples_for(0.1, dark) == 1.0


def test_noise_is_that_of_a_picture(blobs):
    """The noise of one sample per pixel agrees with the spread of eight pictures, within their accuracy."""
    loaded = scenes.scene(blobs, scenes.nrf(light_samples=1), {"light": scenes.light("env")}, size=48, spp=1)
    look, one = look_of(loaded)
    pictures = np.stack([scenes.render(loaded, seed)[..., :3] for seed in range(8)])
    expected = np.sqrt(pictures.var(0, ddof=1).mean() / (pictures.mean(0) ** 2).mean())
    assert one.noise(look()) == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("options", [
    {"max_depth": 2}, {"max_depth": 4, "bounces": "paths"}, {"max_depth": 4, "bounces": "paths", "light_samples": 3}])
def test_equal_settings_differ_by_nothing(blobs, options):
    """The scene has a floor, a sampled lamp, a leaf that lets light through, and further bounces."""
    loaded = scenes.scene(blobs, scenes.nrf(**options), {"lamp": LAMP, "sky": scenes.light("env")},
                          shapes={"floor": FLOOR, "leaf": LEAF}, size=32, spp=4)
    look, one = look_of(loaded)
    first, second = look(), look()
    np.testing.assert_array_equal(first.radiance, second.radiance)
    assert first.radiance.var(1).max() > 0  # there is noise
    assert one.error(second, first, 4) == (0.0, 0.0)


def test_what_is_left_out_changes_no_other_numbers(blobs):
    """Rays that do not meet a removed field keep their random numbers.

    These are the numbers of surfaces, bounces and sampled lights. The field is small, but rays march through it, and
    its points come first in the arrays.
    """
    small = scenes.Similarity((-0.7, 1.2, 0.3), 0.3)
    size = small.radius / scenes.SIMILARITY.radius
    place = mi.ScalarTransform4f().translate(
        (np.array(small.center) - size * np.array(scenes.SIMILARITY.center)).tolist()).scale(size)
    loaded = scenes.scene(blobs, scenes.nrf(max_depth=3, bounces="paths", light_samples=2),
                          {"lamp": LAMP}, shapes={"floor": FLOOR, "other": scenes.ball(blobs, small, to_world=place)},
                          size=48, spp=2)
    media = find_media(loaded)
    number = min(range(2), key=lambda i: media[i].frame.length)
    look, _ = look_of(loaded)
    whole, without = look().radiance, look(without_media=(number,)).radiance
    same = (whole == without).all((1, 2))
    lit = whole.max((1, 2)) > 0
    # The small field hides, shades and lights some of what is seen, not most of it.
    assert (same & lit).sum() > 0.5 * lit.sum() and not same.all()


def test_what_is_built_is_told_from_what_grows(blobs):
    loaded = scenes.scene(blobs, scenes.nrf("transmittance_map"), {"light": scenes.light("point")}, size=32, spp=4)
    look, _ = look_of(loaded)
    look()
    maps, march = look(), look(visibility="raymarch")
    assert maps.built > 0 and march.built == 0 and march.each > 0 and maps.each > 0


def test_evaluated_loops_have_prices(blobs):
    """Times are measured with evaluated loops, too, which a launcher's flag sets."""
    loaded = scenes.scene(blobs, scenes.nrf("transmittance_map"), {"light": scenes.light("point")}, size=16, spp=1)
    look, _ = look_of(loaded)
    with dr.scoped_set_flag(dr.JitFlag.SymbolicLoops, False):
        measured = look()
    assert measured.built > 0 and measured.each > 0


def test_seconds_of_work():
    """Building is counted separately, kernels are summed, and the caller's flag of the kernel history is restored."""
    def work():
        with timing.building():
            dr.eval(dr.arange(mi.Float, 1 << 20) + 1)
        x = dr.sin(dr.arange(mi.Float, 1 << 20))
        dr.eval(x)
        return x

    def nested():
        dr.eval(dr.cos(dr.arange(mi.Float, 1 << 20)))
        part = timing.measure(work)[1]
        return part, dr.eval(dr.tan(dr.arange(mi.Float, 1 << 20)))

    (part, _), whole = timing.measure(nested)
    assert whole.kernels > part.kernels > 0 and whole.building == part.building > 0  # a part counts for the whole
    assert whole.compiling > part.compiling >= 0
    before = dr.flag(dr.JitFlag.KernelHistory)
    result, seconds = timing.measure(work)
    assert dr.width(result) == 1 << 20 and dr.flag(dr.JitFlag.KernelHistory) == before
    assert seconds.building > 0 and seconds.kernels > 0
    with timing.building():  # nothing is measured: nothing happens
        pass

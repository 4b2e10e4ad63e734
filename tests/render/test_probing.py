"""Pixels rendered beforehand: where they are, and what they tell of error and noise."""

from dataclasses import replace
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.variants import VARIANT

from mi_ntf.render.transport import probing, trials


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


def test_weights_are_shares_of_the_picture(rng):
    """A box that is a hundredth of it has a hundredth of the weight, whatever the places outside."""
    box = np.array([0.3, 0.4]), np.array([0.4, 0.5])
    places, weights = probing._places(rng, 1000, [box], 1 / 256)
    inside = ((places >= box[0][:, None]) & (places <= box[1][:, None])).all(0)
    assert weights[inside].sum() == pytest.approx(0.01, rel=1e-9) and inside.sum() > probing.WITHIN
    assert weights.sum() == pytest.approx(1, abs=2e-3)  # 1000 groups find the hundredth within so much
    assert ((places >= 0) & (places < 1)).all()
    beside = places.reshape(2, -1, probing.GROUP)
    steps = np.diff(beside[0], axis=1)
    assert np.isclose(steps, 1 / 256).mean() > 0.99 and (np.ptp(beside[1], axis=1) == 0).all()


@pytest.mark.parametrize(("name", "expected"), [("box", 1), ("gaussian", np.pi)])
def test_a_filter_takes_the_mean_of_pixels(name, expected):
    """(∫f)² / ∫f² over the plane; of a Gaussian of half a pixel 4πσ² (cut off, and lowered to 0, at its radius)."""
    assert probing._pixels_of(mi.load_dict({"type": name})) == pytest.approx(expected, rel=0.05)


def looks(rng, probes, bias, noise, drawn):
    """(found, truth): a picture of power 1 and one that is `bias` too bright, each with `noise` of its own."""
    shape = probes.count, probing.SAMPLES, 3
    truth = np.ones(shape) + noise * rng.normal(size=shape)
    found = np.full(shape, 1 + bias) + noise * rng.normal(size=shape)
    lights = SimpleNamespace(lights=SimpleNamespace(sampled=[0] if drawn else []))
    seen = np.full(probes.count, True)
    return (probing.Look(lights, radiance, seen, 0.0, 0.0) for radiance in (found, truth))


def of_camera(pixels):
    film = {**scenes.film(256), "rfilter": {"type": "box"}}
    return probing.Probes(mi.load_dict({"type": "perspective", "fov": 30.0, "film": film}), [], pixels)


@pytest.fixture
def probes():
    return of_camera(1024)


def test_noise_of_drawn_lights_is_no_error(rng, probes):
    found, truth = looks(rng, probes, 0.05, 0.1, True)
    assert probes.error(found, truth, 4) == pytest.approx(0.05, rel=0.1)


@pytest.mark.parametrize("spp", [2, 16])
def test_noise_of_a_method_is_that_of_its_samples(rng, probes, spp):
    """√(bias² + 2 noise²/spp); of channels that are alike in bias, not in noise."""
    found, truth = looks(rng, probes, 0.05, 0.1, False)
    assert probes.error(found, truth, spp) == pytest.approx(np.sqrt(0.05**2 + 2 * 0.1**2 / spp), rel=0.1)


def test_noise_of_one_sample(rng, probes):
    _, truth = looks(rng, probes, 0.0, 0.3, False)
    power = 1 + 0.3**2 / probing.SAMPLES
    assert probes.noise(truth) == pytest.approx(0.3 / np.sqrt(power), rel=0.05)


@pytest.fixture
def everywhere():
    return of_camera(16384)


def test_neighbours_are_traced_together(everywhere):
    """From one group of pixels to the next it is a fiftieth of the side; in the order of the sequence, half."""
    d = np.array(everywhere._ray.d)[:2].T.reshape(-1, probing.GROUP * probing.SAMPLES, 2).mean(1)
    apart = np.linalg.norm(np.diff(d, axis=0), axis=1) / np.ptp(d, axis=0).max()
    assert np.median(apart) < 0.03


@pytest.fixture
def shown(everywhere):
    """A disc a quarter as large as the picture, dark at the rim and sixteen times brighter in the middle."""
    place = np.array(everywhere._ray.d)[:2].T.reshape(everywhere.count, probing.SAMPLES, 2).mean(1)
    apart = np.linalg.norm(place / np.tan(np.radians(15)), axis=1) * np.sqrt(np.pi)  # of a square of side 2
    light = np.where(apart < 1, 4 - 3 * apart, 0.0)
    radiance = np.broadcast_to(light[:, None, None], (everywhere.count, probing.SAMPLES, 3))
    return probing.Look(SimpleNamespace(), radiance, light > 0, 0.0, 0.0)


def test_some_pixels_tell_of_all(everywhere, shown):
    """As many of them see something as of the picture, most where there is light; their weights sum to what they would
    be of all. Twice as many hold these, in the same order first."""
    some = everywhere.some(shown, everywhere.count // 4)
    others, both = some.more()
    assert both.count == some.count + others.count == pytest.approx(2 * some.count, rel=0.03)
    np.testing.assert_array_equal(both._index[: len(some._index)], some._index)
    rest = both.after(some)
    np.testing.assert_array_equal(rest._index, others._index)
    np.testing.assert_array_equal(rest.weight, both.weight[some.count :])
    for part, rel in ((some, 0.1), (both, 0.07)):  # 1.5/√groups that see something
        pixels = (part._index[:, None] * probing.GROUP + np.arange(probing.GROUP)).ravel()
        light = shown.radiance[pixels, 0, 0]
        square = everywhere.weight @ shown.radiance[:, 0, 0] ** 2
        assert part.weight @ light**2 == pytest.approx(square, rel=rel)
        assert part.weight.sum() == pytest.approx(1, rel=rel)
        assert (light > 0).mean() == pytest.approx(0.25, rel=0.1)
        assert light[light > 0].mean() > 1.15 * shown.radiance[shown.seen].mean()
        assert part.samples == pytest.approx(
            probing.SCATTERED * part.count * probing.SAMPLES / 256**2, rel=0.1)


def test_rays_of_some_pixels_are_theirs(everywhere, shown):
    some = everywhere.some(shown, 64)
    d = np.array(everywhere._ray.d).T.reshape(-1, probing.GROUP * probing.SAMPLES, 3)
    np.testing.assert_array_equal(np.array(some._ray.d).T.reshape(-1, *d.shape[1:]), d[some._index])


@pytest.mark.parametrize("bright", [True, False])
def test_nothing_seen(everywhere, shown, bright):
    """Where nothing or everything is black, any pixels do."""
    black = replace(shown, radiance=np.zeros_like(shown.radiance), seen=shown.seen & bright)
    some = everywhere.some(black, probing.LEAST)
    assert some.weight.sum() == pytest.approx(1, rel=0.1)
    assert some.count == pytest.approx(probing.LEAST * (1.75 if bright else 1), rel=0.1)


def test_more_of_something_small(everywhere, shown):
    """Of what takes a thirtieth of the picture, more pixels are looked at than its share, and then twice as many."""
    few = shown.seen & (np.arange(everywhere.count) // probing.GROUP % 8 == 0)
    some = everywhere.some(replace(shown, seen=few), 512)
    of_groups = few.reshape(-1, probing.GROUP).any(1)
    hits = [of_groups[part._index].sum() for part in (some, *some.more())]
    assert hits == [probing.LEAST // probing.GROUP] * 2 + [2 * probing.LEAST // probing.GROUP]


def test_the_march_sees_all_that_it_has_not(everywhere, shown, monkeypatch):
    """Also what came in two steps: everywhere a method shows 1 more than the march, which shows a pixel's number."""
    def look(self, _):
        pixels = (self._index[:, None] * probing.GROUP + np.arange(probing.GROUP)).ravel()
        light = np.broadcast_to(pixels[:, None, None], (self.count, probing.SAMPLES, 3))
        return probing.Look(SimpleNamespace(), light, pixels > 0, 0.0, 0.0)

    monkeypatch.setattr(probing.Probes, "look", look)
    few = everywhere.some(shown, 512)
    found, both = object.__new__(trials.Trials), few.more()[1].more()[1]
    march, found.probes, whole = few.look(None), both, both.look(None)
    found.truth = replace(whole, radiance=whole.radiance + 1)
    found._march_rest(probing.Off(few, np.ones_like(march.radiance), march), both.after(few))
    assert found._off.probes is both and both.count > 3 * few.count
    np.testing.assert_array_equal(found._off.by, np.ones_like(whole.radiance))


@pytest.mark.parametrize("share", [0.5, 1.0])
def test_few_that_are_marched_tell_what_the_truth_errs_by(rng, everywhere, shown, share):
    """√mean (a + l)², a known of a third of the probes and l of all: both by themselves are half as large, where they
    are alike (`share` 1) their squares add up to four times, where they are of each pixel's own to twice that."""
    few = everywhere.some(shown, 2048).first(1 / 3)
    others, both = few.more(3)
    assert few.count == pytest.approx(both.count / 3, rel=0.03) and others.count + few.count == both.count
    shape = (both.count, 1, 1)
    common, own_of_truth, own = (0.05 * rng.normal(size=shape) for _ in range(3))
    a, off = (np.sqrt(share) * common + np.sqrt(1 - share) * each for each in (own_of_truth, own))
    truth = np.ones((both.count, probing.SAMPLES, 3))
    lights = SimpleNamespace(lights=SimpleNamespace(sampled=[]))
    base, found = (probing.Look(lights, truth * (1 + by), shown.seen, 0.0, 0.0) for by in (a, a + off))
    expected = 0.05 * np.sqrt(2 + 2 * share)
    error = both.error(found, base, 4, 0.0, probing.Off(few, (truth * a)[: few.count], base))
    power = np.sqrt(float(both.weight @ (1 + a.ravel()) ** 2))
    assert error * power == pytest.approx(expected * np.sqrt(both.weight.sum()), rel=0.12)  # 2/√(few groups)
    assert both.error(base, base, 4, 0.0, probing.Off(few, (truth * a)[: few.count], base)) * power == pytest.approx(
        0.05, rel=0.12)

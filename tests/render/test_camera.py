"""Films, filters and sensors that users may choose, against neutral ones."""

import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.stats
from helpers import scenes, ztest
from helpers.scenes import nrf

from mi_ntf.render.scene.camera import Camera, Reconstruction

LIGHT = {"light": scenes.light("point")}
SPECTRUM_TO_LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
RGB_TO_XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])


def with_film(field, integrator, spp=4, size=16, seed=0, **film):
    """Return the image of the object by a film with these options."""
    loaded = scenes.scene(field, integrator, LIGHT, size=size, spp=spp, film_options=film)
    return scenes.render(loaded, seed)


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_map", "none"])
@pytest.mark.parametrize("pixel_format", ["rgb", "luminance", "xyz", "rgba", "luminance_alpha", "xyza"])
def test_pixel_formats_of_a_box_filter(blobs, pixel_format, visibility):
    neutral = with_film(blobs, nrf(visibility))
    image = with_film(blobs, nrf(visibility), pixel_format=pixel_format)
    rgb, alpha = neutral[..., :3], neutral[..., 3:]
    base = pixel_format.removesuffix("_alpha").removesuffix("a")
    truth = {"rgb": rgb, "luminance": rgb @ SPECTRUM_TO_LUMINANCE[:, None], "xyz": rgb @ RGB_TO_XYZ.T}[base]
    truth = truth if pixel_format == base else np.concatenate([truth, alpha], -1)
    np.testing.assert_allclose(image, truth, rtol=2e-5, atol=1e-6)  # Mitsuba's matrices have six digits


@pytest.mark.parametrize("rfilter", ["tent", "gaussian", "mitchell", "catmullrom", "lanczos"])
@pytest.mark.parametrize("border", [False, True])
def test_reconstruction_equals_the_films_own(blobs, rfilter, border, monkeypatch):
    """Mitsuba's ImageBlock reconstructs the same samples to the same picture, in several chunks."""
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 500)
    options = {"rfilter": {"type": rfilter}, "sample_border": border, "pixel_format": "rgba"}
    loaded = scenes.scene(blobs, nrf("none", samples=64), LIGHT, size=16, spp=4, film_options=options)
    ours = scenes.render(loaded)
    put = []

    def by_mitsuba(self, first, position, values):
        values = [mi.Float(0) if v is None else mi.Float(v) for v in values]
        self.block.put(position, values)
        put.append(first)

    monkeypatch.setattr("mi_ntf.render.scene.camera.Reconstruction.add", by_mitsuba)
    theirs = scenes.render(loaded)
    assert len(put) > 2
    np.testing.assert_allclose(ours, theirs, rtol=2e-5, atol=2e-6)  # orders of float32 sums


@pytest.mark.parametrize("rfilter", ["box", "gaussian"])
@pytest.mark.parametrize(
    "options",
    [{}, {"visibility": "transmittance_map"}, {"max_depth": 4}, {"light_samples": 2}, {"aovs": "depth,visibility"},
     {"aovs": "normal,visibility,visibility_lights"}],
    ids=str,
)
def test_one_seed_one_image(blobs, rfilter, options):
    """Eight renders in one process have the same bits, since no sum depends on the order of threads."""
    film = {"rfilter": {"type": rfilter}}
    loaded = scenes.scene(blobs, nrf(**{"visibility": "raymarch", **options}), LIGHT, size=24, spp=4, film_options=film)
    first = scenes.render(loaded, 7)
    for _ in range(7):
        np.testing.assert_array_equal(scenes.render(loaded, 7), first)


POINTS = "radiancemeter", "distant at a point"
SENSORS = (*POINTS, "irradiancemeter", "thinlens", "orthographic", "batch", "off centre")


def sensors(spp: int) -> dict:
    """Return sensors of every kind: name → part of a scene. Sensors of one pixel see bright matter."""
    to_world, centre = mi.ScalarTransform4f(), np.array(scenes.SIMILARITY.center)
    left = centre - [0.4, 0, 0]
    look = to_world.look_at(origin=list(left + np.array([1.2, 1.5, 5])), target=list(left), up=[0, 1, 0])
    sampler = {"type": "independent", "sample_count": spp}

    def sensor(kind, width=1, height=1, **options):
        size = {"width": width, "height": height}
        return {"type": kind, "film": {**scenes.film(1), **size, "pixel_format": "rgb"}, "sampler": sampler, **options}

    lens = {"aperture_radius": 0.1, "focus_distance": 5.0, "fov": 28}
    view = {"type": "perspective", "to_world": look, "fov": 28}
    above = list(centre + np.array([0, 2, 0]))
    plate = to_world.translate(above).rotate([1, 0, 0], 90).scale(0.5)  # looks down on the lit side
    return {
        "radiancemeter": {"sensor": sensor("radiancemeter", to_world=look)},
        "distant at a point": {"sensor": sensor("distant", direction=[0, -0.3, -1], target=list(left))},
        "irradiancemeter": {"plate": {"type": "rectangle", "to_world": plate, "sensor": sensor("irradiancemeter")}},
        "thinlens": {"sensor": sensor("thinlens", 8, 8, to_world=look, **lens)},
        "orthographic": {"sensor": sensor("orthographic", 8, 8, to_world=look)},
        "batch": {"sensor": sensor("batch", 16, 8, a=view, b={**view, "fov": 14})},
        "off centre": {"sensor": sensor("perspective", 16, 8, to_world=look, principal_point_offset_x=0.2)},
    }


@pytest.mark.parametrize("name", SENSORS)
def test_sensors_agree_with_volpath(blobs, name):
    """The radiance of each sensor's film, six seeds, equals volpath's by Welch's test and within 6 %."""

    def means(integrator, spp):
        loaded = mi.load_dict({"type": "scene", "integrator": integrator, **sensors(spp)[name], **LIGHT,
                               "ball": scenes.ball(blobs)})
        return np.array([scenes.render(loaded, seed).mean((0, 1)) for seed in range(6)])

    spp, theirs = {"irradiancemeter": (4096, 16384), **dict.fromkeys(POINTS, (256, 4096))}.get(name, (16, 256))
    ours, theirs = means(nrf(), spp), means({"type": "volpath", "max_depth": 2, "hide_emitters": True}, theirs)
    assert (ztest.p_values(ours, theirs) > 1e-3).all()
    # Six means of each: 2 % of standard error at most.
    np.testing.assert_allclose(ours.mean(0), theirs.mean(0), rtol=0.06)


def test_frozen_functions_are_refused(blobs):
    """A render in dr.freeze raises an exception, since its sizes are not known beforehand; later renders work."""
    loaded = scenes.scene(blobs, nrf(), LIGHT, size=8, spp=2)
    before = scenes.render(loaded)

    @dr.freeze
    def frozen(seed):
        return mi.render(loaded, seed=seed)

    with pytest.raises(RuntimeError) as caught:
        frozen(mi.UInt32(0))
    error, texts = caught.value, []
    while error is not None:
        texts.append(str(error))
        error = error.__cause__
    assert "dr.freeze cannot record a render" in " ".join(texts)
    np.testing.assert_array_equal(scenes.render(loaded), before)


def test_samples_of_a_pixel_spread_evenly(blobs):
    """Every stretch of a few sixteenths of [0, 1) holds one of 16 points; the same for 4096.

    Single points are uniform, and independent of each other and of where in its pixel a ray starts.
    """
    loaded = scenes.scene(blobs, nrf(), LIGHT, size=256, spp=1)

    def quadrature(spp, count):
        camera = Camera(loaded.sensors()[0], spp)
        *_, place, numbers = camera.rays(0, count, mi.UInt32(5))
        return *(u.numpy() for u in numbers), place.x.numpy() % 1, place.y.numpy() % 1

    for spp, count in (16, 900), (4096, 4):
        for u in quadrature(spp, count)[:2]:
            values = np.sort(u.reshape(count, spp))
            assert values.min() >= 0 and values.max() < 1
            gaps = np.diff(np.concatenate([values, values[:, :1] + 1], 1))
            assert gaps.max() < 3.5 / spp  # points at random leave 3.4 or 8.9 on average
    for a, b in itertools.combinations(quadrature(1, 256**2), 2):
        counts = np.histogram2d(a, b, bins=16, range=[[0, 1], [0, 1]])[0]
        assert scipy.stats.chisquare(counts.ravel()).pvalue > 1e-3


def test_samples_of_a_pixel_know_of_each_other(blobs):
    """Along identical rays the variance of 16 samples is less than half of a sixteenth."""
    view = sensors(1)["radiancemeter"]
    loaded = mi.load_dict({"type": "scene", "integrator": nrf(), **view, **LIGHT, "ball": scenes.ball(blobs)})

    def variance(spp):
        return np.array([scenes.render(loaded, seed, spp)[..., :3] for seed in range(60)]).var(0).mean()

    assert variance(16) < 0.5 / 16 * variance(1)


def test_a_pixel_sums_a_million_samples():
    """The sum is exact to float32; a plain float32 sum of 10⁶ times 0.1 is 1 % too large."""
    spp = 10**6
    camera = Camera(mi.load_dict({"type": "perspective", "film": scenes.film(1)}), spp)
    camera.film.prepare([])
    block = camera.film.create_block()
    Reconstruction(block, camera).add(0, mi.Point2f(dr.full(mi.Float, 0.5, spp), 0.5),
                                      [dr.full(mi.Float, value, spp) for value in (0.1, 1 / 3)])
    result = np.array(block.tensor()).ravel()[:2] / spp
    np.testing.assert_allclose(result, np.float32([0.1, 1 / 3]), rtol=1e-6)

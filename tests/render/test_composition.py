"""Several fields, surfaces and depths in one scene, against stock ``volpath`` and closed forms."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes, ztest

from benchmarks import scenes as shipped
from mi_ntf.core import field_file, microfacet, ops
from mi_ntf.core.architecture import Similarity
from mi_ntf.evaluate.metrics import relative_rmse
from mi_ntf.render.lights import scene_lights
from mi_ntf.render.scene.media import find_media
from mi_ntf.render.transport import composition

SEEDS = 4
TURN = [-1.7, -0.75, 1.4]  # clear of the large sphere: where spheres overlap, volpath loses a medium


def nrf(visibility="raymarch", **options):
    return {"type": "nrf", "visibility": visibility, **options}


def room(field, floor=None, lamp=False) -> dict:
    """Return shapes beside the object of `scenes.scene`.

    They are the object once more, half as large and rotated, and optionally a floor with a ball, and a lamp.
    """
    to_world, centre = mi.ScalarTransform4f, list(scenes.SIMILARITY.center)
    place = to_world().translate(TURN).rotate([0, 1, 0], 120)
    shapes = {
        "small": {
            "type": "sphere",
            "to_world": place @ to_world().scale(0.5).translate(centre).scale(scenes.SIMILARITY.radius),
            "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(field), "to_world": place, "scale": 0.5},
        }
    }
    if floor:
        shapes["floor"] = {
            "type": "rectangle",
            "to_world": to_world().translate([centre[0], -1.5, centre[2]]).rotate([1, 0, 0], -90).scale(6),
            "bsdf": floor,
        }
        shapes["pebble"] = {"type": "sphere", "center": [1.5, 0.4, 2.2], "radius": 0.4}
    if lamp:
        shapes["lamp"] = {
            "type": "rectangle",
            "to_world": to_world().look_at([2.5, 3.5, 1.5], centre, [0, 0, 1]).scale(0.7),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [20, 18, 15]}},
        }
    return shapes


DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}}
METAL = {"type": "roughconductor", "alpha": 0.2}


@pytest.mark.parametrize(
    ("light", "floor", "lamp", "depth"),
    [
        ("point", DIFFUSE, False, 2),
        (None, METAL, True, 2),  # light that a BSDF-sampled ray meets behind a field arrives dimmed
        pytest.param("directional", METAL, False, 4, marks=pytest.mark.slow),
        pytest.param("env", METAL, False, 2, marks=pytest.mark.slow),
        pytest.param(None, DIFFUSE, True, -1, marks=pytest.mark.slow),
    ],
)
def test_agrees_with_volpath(blobs, light, floor, lamp, depth):
    """Test shadows and bounces of two fields of one file, a floor and a ball.

    The z-test is per 4×4 block. Means of 8×8 blocks of direct light agree within 3 %, four times volpath's noise. The
    mean of all bounces agrees within 2 %.
    """
    options = {"light_samples": 2} if light in (None, "env") else {}
    lights = {"light": scenes.light(light)} if light else {}

    def renders(integrator, spp):
        loaded = scenes.scene(
            blobs, {**integrator, "max_depth": depth}, lights, spp=spp, size=24, shapes=room(blobs, floor, lamp)
        )
        return [scenes.render(loaded, seed) for seed in range(SEEDS)]

    ours, theirs = renders(nrf(samples=1024, **options), 64), renders({"type": "volpath"}, 512)
    ztest.check([i[..., :3] for i in ours], [i[..., :3] for i in theirs], f"room {light} {depth}", block=4)
    ours, theirs = np.mean(ours, 0), np.mean(theirs, 0)
    assert depth != 2 or ztest.block_difference(ours[..., :3], theirs[..., :3], 8, floor=0.3).max() < 0.03
    np.testing.assert_allclose(ours.mean((0, 1)), theirs.mean((0, 1)), rtol=0.02)


# Uniform balls that overlap, of unequal size, seen along −z: every transmittance is a chord. Centre, radius, σ times
# radius of each.
TWO = [((-0.4, 0.0, 0.0), 1.0, 0.8), ((0.7, 0.3, 0.4), 1.5, 1.2)]
TEN = [((0.09 * i * np.cos(2.4 * i), 0.09 * i * np.sin(2.4 * i), 0.12 * i - 0.54), 1.2 - 0.06 * i, 0.15 + 0.02 * i)
       for i in range(10)]
TOWARDS = np.array([0.6, 0.64, 0.48])


def chord(p, d, centre, radius, length=np.inf):
    """Return the length of the part of the rays p + t d, 0 < t < `length`, inside a ball."""
    rel = p - centre
    b = rel @ d
    h = np.sqrt(np.maximum(b * b - (rel * rel).sum(-1) + radius**2, 0))
    return np.clip(-b + h, 0, length) - np.clip(-b - h, 0, length)


@cache
def overlap_by_quadrature(balls: tuple, size: int, steps: int = 1500):
    """Return single scattering by a midpoint rule along size² parallel view rays through [-2, 2]², x to the right.

    The light has irradiance 1 and comes from `TOWARDS`. Only points with matter are looked at.
    """
    balls = [(np.array(centre), radius, sigma / radius) for centre, radius, sigma in balls]
    c = (np.arange(size) + 0.5) * 4 / size - 2
    view, (x, y) = np.array([0.0, 0.0, -1.0]), (v.ravel() for v in np.meshgrid(c, -c))
    total, passed = np.zeros((len(x), 3)), np.zeros(len(x))
    dt = 5.0 / steps
    for k in range(steps):
        rays = np.stack([x, y, np.full(len(x), 2.5 - (k + 0.5) * dt)], -1)
        within = np.array([((rays - c) ** 2).sum(-1) < r * r for c, r, _ in balls])
        matter = np.flatnonzero(within.any(0))
        p, sigma = rays[matter], np.where(within[:, matter], [[s] for _, _, s in balls], 0)
        light = sum(s * chord(p, TOWARDS, c, r) for c, r, s in balls)
        weight = np.exp(-passed[matter] - 0.5 * sigma.sum(0) * dt - light) * dt
        for (centre, _, s), own in zip(balls, within[:, matter], strict=True):
            n = (p[own] - centre) / np.linalg.norm(p[own] - centre, axis=-1, keepdims=True)
            wi, wo = (tuple(np.full(len(n), c) for c in v) for v in (TOWARDS, -view))
            diffuse, gloss = microfacet.scattering(ops, wi, wo, tuple(np.moveaxis(n, -1, 0)), 0.5)
            value = [0.8 * k * diffuse + 0.2 * gloss for k in (0.6, 0.5, 0.4)]
            total[matter[own]] += np.stack(value, -1) * (s * weight[own])[:, None]
        passed[matter] += sigma.sum(0) * dt
    return total.reshape(size, size, 3), 1 - np.exp(-passed).reshape(size, size)


@pytest.mark.parametrize(("balls", "visibility"), [(TWO, "raymarch"), (TWO, "transmittance_map"), (TEN, "raymarch")],
                         ids=["two marched", "two mapped", "ten"])
def test_overlapping_fields_against_quadrature(tmp_path, balls, visibility):
    """Densities add for the view, transmittances multiply for the light."""
    media = {}
    for i, (centre, length, sigma) in enumerate(balls):
        path = tmp_path / f"{i}.safetensors"
        field_file.save(path, *fields.uniform(sigma, similarity=Similarity(tuple(centre), length)), np.float32)
        media[f"ball_{i}"] = {
            "type": "sphere",
            "center": list(centre),
            "radius": length,
            "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(path), "resolution": 96},
        }
    view = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]).scale(2)
    loaded = mi.load_dict({
        "type": "scene",
        "integrator": nrf(visibility),
        "sensor": {"type": "orthographic", "to_world": view, "film": scenes.film(16),
                   "sampler": {"type": "multijitter", "sample_count": 64}},
        "sun": {"type": "directional", "direction": list(-TOWARDS)},
        **media,
    })  # fmt: skip
    image = scenes.render(loaded)
    # Pixels by their own 4×4 quadrature points.
    light, alpha = overlap_by_quadrature(tuple(balls), 64)
    light, alpha = (v.reshape(16, 4, 16, 4, -1).mean((1, 3)) for v in (light, alpha))
    np.testing.assert_allclose(image[..., 3:], alpha, atol=0.04)  # voxels of a field's 1/48 at the rims
    # A field's voxels of 1/48 at the rims; that one logistic is no exponential makes most of the map's error.
    tolerance = 0.02 if visibility == "raymarch" else 0.15
    assert np.sqrt(((image[..., :3] - light) ** 2).mean() / (light**2).mean()) < tolerance


def test_shapes_that_shine_and_what_hides_them(blobs):
    """The picture shows the lamp with its radiance; `hide_emitters` removes the lamp but not its light."""
    shapes = {"lamp": {"type": "sphere", "center": [0.4, -0.2, 3.0], "radius": 0.3,
                       "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [7, 6, 5]}}}}  # fmt: skip
    options = {"size": 16, "spp": 64, "shapes": shapes}
    shown, hidden, dark = (
        scenes.render(scenes.scene(blobs, nrf(light_samples=4, **extra), {}, **options))
        for extra in ({}, {"hide_emitters": True}, {"max_depth": 1})
    )
    lamp = (shown[..., :3] > 4.9).all(-1)
    assert lamp.any()
    np.testing.assert_allclose(shown[lamp], [[7, 6, 5, 1]] * lamp.sum(), rtol=1e-5)
    np.testing.assert_allclose(dark[lamp], shown[lamp], rtol=1e-5)
    assert (hidden[..., :3] < 4).all() and (dark[~lamp][:, :3] == 0).any()
    lit = (dark[..., :3] == 0).all(-1) & (shown[..., 3] > 0.9)
    assert shown[lit][:, :3].mean() == pytest.approx(hidden[lit][:, :3].mean(), rel=0.05)
    assert shown[lit][:, :3].mean() > 0.01


def test_a_shape_hides_the_field_behind_it(blobs):
    """Matter behind a black wall through the middle of the object is invisible for any step size."""
    centre = scenes.SIMILARITY.center
    wall = {"wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate(list(centre)).scale(9),
                     "bsdf": {"type": "diffuse", "reflectance": 0.0}}}  # fmt: skip
    lights = {"light": scenes.light("point")}

    def render(**options):
        return scenes.render(scenes.scene(blobs, nrf(**options), lights, size=16, spp=256, shapes=wall))

    fine, coarse = render(samples=2048), render(samples=96)
    assert (fine[..., 3] == 1).all()
    assert coarse[..., :3].mean() == pytest.approx(fine[..., :3].mean(), rel=0.02)


@pytest.mark.parametrize("floor", [None, DIFFUSE])
def test_chunks_that_meet_nothing(blobs, monkeypatch, floor):
    """Chunks are rows of pixels, the first of which see no matter."""
    lights = {"light": scenes.light("directional")}
    scene = scenes.scene(blobs, nrf(max_depth=3), lights, size=16, spp=16, shapes=room(blobs, floor))
    whole = scenes.render(scene, 0)
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 256)
    rows = scenes.render(scene, 0)
    assert (rows[0, :, :3] == 0).all()
    np.testing.assert_allclose(rows.mean((0, 1)), whole.mean((0, 1)), rtol=0.05)  # other samples


@pytest.mark.parametrize("bsdf", [{"type": "dielectric"}, {"type": "diffuse"}, {"type": "thindielectric"}, None])
def test_a_bound_that_is_a_surface_is_refused(blobs, bsdf):
    """A bound of glass is refused, since volpath would refract there."""
    loaded = scenes.scene(None, nrf(), {"light": scenes.light("point")}, size=8, spp=1, shapes={
        "ball": {k: v for k, v in (scenes.ball(blobs) | {"bsdf": bsdf}).items() if v}})  # fmt: skip
    with pytest.raises(Exception) as caught:
        scenes.render(loaded)
    assert "medium is no surface" in str(caught.value.__cause__ or caught.value)


def test_a_sun_among_many_lights_is_marched_to(monkeypatch):
    """Under a sky whose sun is most of its light, the atlas gives the march's picture.

    The error is 0.2 %; without marched suns it is 3 %, around the sun's shadow. Leaving out dim lights does not change
    the suns.
    """
    loaded = shipped.scene("statue", "sky", 48, 4)

    def picture(visibility):
        return shipped.picture(loaded, shipped.integrator(visibility=visibility, environment_lights=128))[0]

    truth = picture("raymarch")
    assert relative_rmse(picture("transmittance_atlas"), truth) < 0.004
    light = scene_lights.Lights(loaded, find_media(loaded), brightest=300)
    assert light.suns().sum() == 1 and len(light.suns()) == len(light.rows.power) == 300  # of 470
    assert light.rows.power[light.suns()].sum() > 0.5 * light.rows.power.sum()
    monkeypatch.setattr(scene_lights.Lights, "suns", lambda self: np.zeros(1, bool))
    assert relative_rmse(picture("transmittance_atlas"), truth) > 0.015


def test_suns_of_the_table_and_of_sampled_lights():
    """Rows of the table are known to be suns; sampled lights say it themselves."""
    loaded = shipped.scene("statue", "sky", 16, 1)
    settings = shipped.integrator(visibility="transmittance_atlas").context.settings
    whole = composition.Composition(loaded, settings, loaded.sensors()[0], 1)
    [part], expected = whole.parts, whole.lights.suns()
    assert expected.any() and (part.for_run.suns == expected).all()
    with whole.with_all_lights():
        assert (whole.parts[0].for_run.suns == expected).all()
    assert whole.parts == [part]
    assert part.for_sampled.suns is None and not hasattr(part.for_sampled.looked_up, "suns")


@pytest.mark.parametrize(("count", "bright", "expected"), [(64, 1, 1), (64, 6, 4), (15, 1, 0), (64, 0, 0)])
def test_suns_are_few_of_many(count, bright, expected):
    """Suns have a tenth of all light each, and there is at most one for sixteen lights."""
    lights = {f"light_{i}": {"type": "directional", "direction": [0.0, np.sin(i), np.cos(i)],
                             "irradiance": 50.0 + i if i < bright else 0.2} for i in range(count)}
    suns = scene_lights.Lights(mi.load_dict({"type": "scene", **lights})).suns()
    assert suns.sum() == expected and len(suns) == count
    if expected:
        power = scene_lights.Lights(mi.load_dict({"type": "scene", **lights})).rows.power[:, 0]
        assert power[suns].min() >= np.sort(power)[-expected]

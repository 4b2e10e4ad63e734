"""Emitters as lights of the field: every kind of Mitsuba's against stock `volpath`, rows against Mitsuba's own
sampling, orientation, and the noise of resampling."""

from functools import cache
from unittest import mock

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import emitters, scenes, ztest

from mi_ntf.core.architecture import Similarity
from mi_ntf.infer import shade
from mi_ntf.infer.lights import LightTable
from mi_ntf.render.lights import emitter_samples, scene_lights
from mi_ntf.render.scene.frame import Frame

SEEDS = 4
MIDDLE = list(scenes.SIMILARITY.center)


def emitter(kind: str) -> dict:
    return emitters.emitter(kind, MIDDLE, scenes.SIMILARITY.radius)


def renders(field, integrator: dict, light: dict, spp: int) -> list[np.ndarray]:
    loaded = scenes.scene(field, integrator, light, size=12, spp=spp, sampler="multijitter")
    return [scenes.render(loaded, seed)[..., :3] for seed in range(SEEDS)]


def by_volpath(field, light: dict) -> list[np.ndarray]:
    return renders(field, {"type": "volpath", "max_depth": 2, "hide_emitters": True}, light, 1024)


def check_against_volpath(field, light: dict, label: str, theirs=None, **options):
    """z-test of 3×3 block means at 12×12, and means of 6×6 blocks within 3 %, three to five times volpath's noise in
    them. `theirs`: the pictures :func:`by_volpath`, if they are known."""
    # A few lights serve for skies as smooth as these: measured 2 % of a block's light, of which volpath's noise is 1 %.
    ours = {"type": "nrf", "visibility": "raymarch", "samples": 512, "hide_emitters": True, "environment_lights": 72}
    ours |= options
    images = renders(field, ours, light, 16), theirs or by_volpath(field, light)
    ztest.check(*images, label, block=3)
    means = [np.mean(group, 0) for group in images]
    if means[1].any():
        # Of the brightest block, where a block is darker than 0.3 of it: relative errors of black mean nothing.
        difference = ztest.block_difference(*means, 6, floor=0.3)
        assert difference.max() < 0.03, f"{label}: block means differ by {np.round(difference, 4).tolist()}"
    return means[0].mean()


@pytest.mark.parametrize(
    "kind",
    ["point", "spot", "textured", "directional", "constant", "envmap", "sunsky", "area", "projector"],
)
def test_every_emitter_equals_volpath(blobs, kind):
    """All lights at every point, those of no finite set drawn: the picture that Mitsuba's path tracer converges to."""
    assert check_against_volpath(blobs, {"light": emitter(kind)}, kind) > 0.01


def test_directionalarea_is_as_dark_as_under_volpath(blobs):
    """Mitsuba's direct lighting never finds it; only particle tracers do."""
    assert check_against_volpath(blobs, {"light": emitter("directionalarea")}, "directionalarea") == 0


def mixed() -> dict:
    return {kind: emitter(kind) for kind in ("spot", "area", "constant")}


@pytest.fixture(scope="module")
def mixed_by_volpath(blobs):
    """Function that returns the pictures by volpath of the mixed lights, rendered once."""
    return cache(lambda: by_volpath(blobs, mixed()))


@pytest.mark.parametrize("options", [{}, {"light_samples": 3}])
def test_several_at_once(blobs, mixed_by_volpath, options):
    """A scene that mixes rows with drawn lights, summed and sampled."""
    check_against_volpath(blobs, mixed(), "mixed", mixed_by_volpath(), **options)


def identity() -> Frame:
    return Frame(Similarity(), np.eye(4), 1.0)


def points(n: int, copies: int, rng) -> shade.Points:
    """`n` shading points, each `copies` times over: anywhere in the unit sphere, rough and glossy."""

    def tile(v):
        return mi.Float(np.tile(v.astype(np.float32), copies))

    def unit():
        v = rng.normal(size=(3, n))
        return v / np.linalg.norm(v, axis=0)

    x, normal = rng.uniform(-0.5, 0.5, (3, n)), unit()
    towards = normal + 0.8 * unit()
    wo = towards / np.linalg.norm(towards, axis=0)
    roughness, specular = rng.uniform(0.3, 0.9, n), rng.uniform(0, 0.4, (3, n))
    albedo = rng.uniform(0.2, 0.8, (3, n))
    x, wo, normal, albedo, specular = (tuple(tile(c) for c in v) for v in (x, wo, normal, albedo, specular))
    return shade.Points(x, wo, shade.Reflectance(normal, albedo, tile(roughness), specular, tile(0 * roughness)))


SEED = 2654435769
"""As renders have it, a hash: the draws of small consecutive seeds are alike (Mitsuba's TEA has four rounds)."""


def sampled(emitters: list, at, count: int, candidates: int = emitter_samples.CANDIDATES):
    with mock.patch.object(emitter_samples, "CANDIDATES", candidates):
        return emitter_samples.EmitterSamples(
            emitters, [1.0] * len(emitters), identity(), at, dr.opaque(mi.UInt32, SEED), count)


@pytest.mark.parametrize("kinds", [("envmap",), ("constant", "directional", "spot")])
def test_resampled_lights_are_unbiased_and_quieter(kinds, rng):
    """Against the sum over all rows, unshadowed: means of 2000 draws at 64 points; and the noise of plain sampling."""
    made = [mi.load_dict(emitter(kind)) for kind in kinds]
    n, copies = 64, 2000
    rows = scene_lights.rows(list(zip(made, kinds, strict=True)), 8192)
    state = rng.bit_generator.state
    truth = np.array(shade.reflect(points(n, 1, rng), rows.table(identity()), None))
    spread = {}
    for candidates in (8, 2, 1):
        rng.bit_generator.state = state
        at = points(n, copies, rng)
        values = np.array(shade.reflect(at, sampled(made, at, 2, candidates), None)).reshape(3, copies, n)
        deviation = values.std(axis=1)
        z = (values.mean(axis=1) - truth) / (deviation / copies**0.5 + 2e-3 * truth.mean())  # rows are not points
        assert np.abs(z).max() < 4.5 and np.abs(z.mean()) < 0.5, candidates
        spread[candidates] = np.sqrt((deviation**2).mean() / (truth**2).mean())
    print(kinds, "noise of 2 lights, resampled and plain:", spread[8], spread[1])
    assert spread[8] < 0.6 * spread[1] and spread[8] < spread[2] < spread[1]


@pytest.mark.parametrize("candidates", [1, 4])
def test_sampled_suns_are_marked(candidates, rng):
    """Directions on the disc of the sun are, no others; nor those of a sky without one; a directional light beside it
    is, on its own it is not."""
    plain, lamp = (mi.load_dict(emitter(kind)) for kind in ("envmap", "directional"))
    sky = mi.load_dict({**emitter("sunsky"), "sky_scale": 1.0, "sun_aperture": 0.5358})
    n, index, axis = 4096, dr.zeros(mi.UInt32, 4096), np.array([0.6, 0.5, 0.7]) / np.sqrt(1.1)
    at = points(1, n, rng)

    def marked(emitters):
        light = sampled(emitters, at, 1, candidates).sample(index, at.x, mi.Bool(True))
        return np.array(light.wi), np.broadcast_to(np.array(light.sun), n)

    wi, sun = marked([sky])
    np.testing.assert_array_equal(sun, np.degrees(np.arccos(np.minimum(axis @ wi, 1))) < 0.27)
    assert 0.2 < sun.mean() < 0.99
    assert not marked([plain])[1].any() and not marked([lamp])[1].any()
    wi, sun = marked([plain, lamp])
    way = np.array(sampled([lamp], at, 1, 1).sample(index, at.x, mi.Bool(True)).wi)[:, :1]
    np.testing.assert_array_equal(sun, np.abs(wi - way).max(0) < 1e-6)


@pytest.mark.parametrize(("where", "far"), [((0, 0, 1.5), True), ((0, 0, 1.2), False), ((0, 0, 0.5), False)])
def test_lamps_outside_of_a_field_are_known(where, far, rng):
    """A ball of radius 0.3 outside of the unit sphere, across it and inside: alone and beside an environment."""
    lamp = mi.load_dict({"type": "sphere", "center": where, "radius": 0.3, "light": {"type": "area"}})
    lamps, at = [lamp.emitter()], points(1, 1, rng)
    assert sampled(lamps, at, 1).far is far
    assert sampled([*lamps, mi.load_dict(emitter("constant"))], at, 1).far is far
    assert not sampled([mi.load_dict(emitter("spot"))], at, 1).far  # places of others are not known


def test_directions_of_any_length_are_unit_vectors():
    """Alone and beside a point light, to the bit."""
    where = np.array([[0.6, 0.64, 0.48], [0, 0, 4]])
    x = tuple(mi.Float([0.1, 0.2]) for _ in range(3))

    def toward(scale, rows):
        table = LightTable(np.array([[scale], [1.0]])[:rows] * where[:rows], np.ones((rows, 3)),
                           np.array([False, True])[:rows], 1.0, mi)
        assert table.far
        return np.array(table.sample(dr.zeros(mi.UInt32, 2), x, True).wi)

    np.testing.assert_allclose(toward(3.0, 1), np.tile(where[0][:, None], 2), rtol=1e-6)
    np.testing.assert_array_equal(toward(3.0, 1), toward(3.0, 2))


def towards(emitter, p: np.ndarray, u=(0.5, 0.5)):
    """Mitsuba's own sample of `emitter` at scene points (3, n): direction, weight (3, n), distance (n,)."""
    it = dr.zeros(mi.Interaction3f, p.shape[1])
    it.p = mi.Point3f(*p.astype(np.float32))
    ds, weight = emitter.sample_direction(it, mi.Point2f(*u), True)
    return tuple(np.broadcast_to(np.array(v), (*np.shape(v)[:-1], p.shape[1])) for v in (ds.d, weight, ds.dist))


@pytest.mark.parametrize("kind", ["point", "spot", "directional"])
def test_rows_of_single_lights_are_mitsubas_in_any_placement(kind, rng):
    """Direction, irradiance and distance, from points of a field that is rotated, scaled and moved."""
    place = mi.ScalarTransform4f().translate([1, 0.5, -1]).rotate([0.48, 0.8, 0.36], 70)
    frame = Frame(scenes.SIMILARITY, np.array(place.matrix, np.float64), 0.7)
    x = rng.uniform(-0.9, 0.9, (3, 400))
    field_x = tuple(mi.Float(c.astype(np.float32)) for c in x)
    loaded = mi.load_dict(emitter(kind))
    table = scene_lights.rows([(loaded, kind)], 1).table(frame)
    light = table.sample(dr.zeros(mi.UInt32, 400), field_x, True)
    d, weight, dist = towards(loaded, np.array(frame.point_to_world(field_x)))
    np.testing.assert_allclose(np.array(frame.direction_to_world(light.wi)), d, atol=2e-6)
    # The spot's ramp between 4° and 16° divides float32 angles by 0.2.
    np.testing.assert_allclose(np.array(light.irradiance), weight, rtol=1e-4, atol=1e-5 * weight.max())
    assert weight.min() < 0.5 * weight.max() or kind == "directional"
    if kind != "directional":
        np.testing.assert_allclose(np.array(light.distance) * frame.length, dist, rtol=1e-5)


def one_texel() -> dict:
    image = np.zeros((16, 32, 3), np.float32)
    image[5, 9] = (100, 50, 20)
    return {"type": "envmap", "bitmap": mi.Bitmap(image), "scale": 2.5}


@pytest.mark.parametrize("kind", ["texel", "envmap", "sunsky", "constant"])
def test_environment_rows_shine_from_where_mitsuba_shines(kind):
    """Total and vector irradiance, ∫ L dω and ∫ L ω dω, of the rows and by Mitsuba's own importance sampling."""
    turned = mi.ScalarTransform4f().rotate([0.48, 0.8, -0.36], 50)
    description = {**(one_texel() if kind == "texel" else emitter(kind))}
    if kind in ("texel", "envmap"):
        description["to_world"] = turned
    if kind == "sunsky":
        description["sun_aperture"] = 0.5358
    loaded = mi.load_dict(description)
    rows = scene_lights.rows([(loaded, "envmap" if kind == "texel" else kind)], 512)
    side = 512
    u = (np.arange(side) + 0.5) / side
    u, v = (mi.Float(c.ravel().astype(np.float32)) for c in np.meshgrid(u, u))
    d, weight, _ = towards(loaded, np.zeros((3, side * side)), (u, v))
    total, vector = weight.mean(axis=1), (weight[:, None] * d).mean(axis=2)
    # A regular grid of 2¹⁸ samples; Mitsuba's eval is bilinear between texels, rows average 4 × 4 points of it.
    np.testing.assert_allclose(rows.power.sum(axis=0), total, rtol=0.02)
    np.testing.assert_allclose(rows.power.T @ rows.where, vector, atol=0.02 * total.max())
    assert len(rows.power) <= 512

"""Light on the skin that faces it: the mean signed error of τ at the points that a camera sees, from overhead to
grazing light, against marches in float64 NumPy through the density in closed form.

The skins are two voxels of 192³ wide and turn from an exponential rise to a constant, as learned ones do. A skin of one
voxel is not itself after baking: its edge is rounded, and τ is 0.013 too high for every method alike.
"""

from functools import cache
from unittest import mock

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, hard_cases
from helpers.jit import arrays

from mi_ntf.core import field_file
from mi_ntf.infer import march, tuning
from mi_ntf.infer.bundle import Strand

KINDS = ("plane", "sphere", "bumps")
COSINES = (1.0, 0.7, 0.5, 0.3, 0.2, 0.1, 0.05)
QUICK = (1.0, 0.3, 0.1)
METHODS = ("raymarch", "transmittance_volume", "transmittance_map", "transmittance_map, 2 logistics",
           "transmittance_atlas")
BOUND = 0.01
ATLAS = 0.037
"""Its directions are 6° apart, and three places stand for a skin: 1.5 times what is measured."""


@cache
def matter(kind: str):
    skin = fields.skin(kind, log_density=4.0, scale=0.02)
    return skin, hard_cases.baked(skin.header, skin.tensors)


def surface(kind: str, cosine: float, count: int, rng):
    """Points on the surface, their normals, and the light's direction, at that angle to the sphere's normals there and
    to the planes'."""
    sine = np.sqrt(1 - cosine**2)
    if kind == "sphere":
        light = np.array([0.48, 0.6, 0.64])
        across = np.array([[0, 0.64, -0.6], [-0.7696, 0.288, 0.3072]])
        across /= np.linalg.norm(across, axis=1, keepdims=True)
        around = rng.uniform(0, 2 * np.pi, (count, 1))
        normal = cosine * light + sine * (np.cos(around) * across[0] + np.sin(around) * across[1])
        return 0.5 * normal, normal, light
    light = np.array([0.8 * sine, 0.6 * sine, cosine])
    x, y = rng.uniform(-0.35, 0.35, (2, count))
    height = 0.0 if kind == "plane" else 0.08
    slopes = 9 * height * np.sin(9 * x) * np.cos(9 * y), 9 * height * np.cos(9 * x) * np.sin(9 * y)
    normal = np.stack([*slopes, np.ones(count)], 1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return np.stack([x, y, height * np.cos(9 * x) * np.cos(9 * y)], 1), normal, light


@cache
def truth(kind: str, cosine: float):
    """``(light, points, τ)`` of the points that cameras within some 60° of the normal see on the lit side."""
    skin, rng = matter(kind)[0], np.random.default_rng(3)
    places, normals, light = surface(kind, cosine, 3000, rng)
    view = normals + 0.6 * rng.normal(size=normals.shape)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    kept = ((view * normals).sum(1) > 0.3) & (normals @ light > 0.02)
    x = fields.seen_points(skin, places[kept], view[kept], rng)
    along = x @ light
    length = np.sqrt(along**2 - (x * x).sum(1) + 1) - along
    return light, x, np.exp(-skin.depth(x, np.broadcast_to(light, x.shape), length))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("cosine", [c if c in QUICK else pytest.param(c, marks=pytest.mark.slow) for c in COSINES])
@pytest.mark.parametrize("kind", KINDS)
def test_skin_by_angle(kind, cosine, method, check):
    light, x, tau = truth(kind, cosine)
    found = hard_cases.transmittance(method, matter(kind)[1], (light, False), x)
    bound = ATLAS if method == "transmittance_atlas" else BOUND
    check(f"skin of {kind}, light at cosine {cosine}", method, "mean signed error of τ", (found - tau).mean(), bound)


LEARNED = {
    ("statue", "raymarch"): BOUND,
    ("statue", "transmittance_map"): 0.018,
    ("statue", "transmittance_map, 2 logistics"): 0.0101,
    ("statue", "transmittance_map, network"): 0.0165,
    ("statue", "ray_network"): 0.008,
    ("statue", "visibility_mlp"): 0.0435,
    ("knot", "raymarch"): BOUND,
    ("knot", "transmittance_map"): 0.0165,
    ("knot", "transmittance_map, 2 logistics"): 0.0084,
    ("knot", "transmittance_map, network"): 0.0125,
    ("knot", "ray_network"): 0.0077,
    ("knot", "visibility_mlp"): 0.0445,
}
"""On learned fields what is measured is stated: these are at most 1.5 times it; `visibility_mlp` is right in the mean
by chance alone, and keeps the bounds that it had. Maps of 192² texels blur what is finer."""


@cache
def shipped(name: str):
    """``(field, lights, points, τ)``: points that a camera sees of a shipped scene's field, and τ for four lights, all
    four a point, by a float64 march through the baked voxels."""
    medium = hard_cases.baked(*field_file.load(hard_cases.SCENES / name / "field.safetensors"))
    rng, count = np.random.default_rng(1), 1500
    view = np.array([-0.3, 0.25, 0.92]) / np.linalg.norm([-0.3, 0.25, 0.92])
    o = rng.uniform(-0.7, 0.7, (count, 3))
    o += (3 - o @ view)[:, None] * view
    d = arrays(np.tile(-view, (count, 1)))
    strand = Strand(medium.source, arrays(o), d, mi.Float(2 / 384))
    random = [mi.Float(rng.random(count)) for _ in range(2)]
    with mock.patch.object(tuning, "SAMPLE_FRACTION", 1e-4):  # points in the faint depths of skins, too
        samples = march.camera_samples([strand], mi.Float(np.full(count, 1e9)), *random)
    ray = np.array(samples.ray, np.int64)
    cell = np.floor((np.array(samples.t) - np.array(samples.bundle.begin)[ray]) * (384 / 2)).astype(np.int64)
    order = rng.permutation(len(ray))
    _, first = np.unique((ray * 1024 + cell)[order], return_index=True)  # one sample of each cell
    kept = rng.permutation(order[first])[:1200]
    x = np.array(samples.place(0, samples.ray, samples.t)[0], np.float64).T[kept]
    normals = np.array(medium.source.reflectance(arrays(x))[0]).T
    lights = rng.normal(size=(4, 3))
    lights /= np.linalg.norm(lights, axis=1, keepdims=True) * np.sign(lights @ view)[:, None]
    return medium, lights, x, [(normals @ d > 0, hard_cases.marched(medium.source, x, d)) for d in lights]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "method"), LEARNED)
def test_learned_skin(name, method, check):
    medium, lights, x, taus = shipped(name)
    errors = [(hard_cases.transmittance(method, medium, (light, False), x) - tau)[lit]
              for light, (lit, tau) in zip(lights, taus, strict=True)]
    check(f"lit skin of {name}", method, "mean signed error of τ", np.concatenate(errors).mean(), LEARNED[name, method])

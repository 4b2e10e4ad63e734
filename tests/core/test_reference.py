"""The NumPy networks against scalar loops that follow the conventions word by word."""

import math

import numpy as np
import pytest

from mi_ntf.core import logistic, mixture, ops, reference, spheres
from mi_ntf.core.architecture import MAX_LOG_DENSITY, MIN_LOG_DENSITY, Architecture, Encoding, Network
from mi_ntf.core.microfacet import MIN_ROUGHNESS

ARCH = Architecture(
    density=Network(Encoding("planes", (5, 8), 3), (6,)),
    reflectance=Network(Encoding("frequency", octaves=3), (7, 5)),
    transmittance=Network(Encoding("frequency", octaves=2), (8,), components=2),
)


@pytest.fixture(scope="module")
def tensors():
    rng = np.random.default_rng(8)
    return {k: rng.normal(size=s) for k, s in ARCH.skeleton().items()}


@pytest.fixture(scope="module")
def points():
    return np.vstack([np.random.default_rng(9).uniform(-1, 1, (20, 3)), np.eye(3), -np.eye(3), np.ones((1, 3))])


def _texel_mix(plane, u, v):
    """Bilinear by summing every texel under a tent, border repeated."""
    r = len(plane)
    total = 0.0
    for j in range(-1, r + 1):
        for i in range(-1, r + 1):
            weight = max(0, 1 - abs(u * r - 0.5 - i)) * max(0, 1 - abs(v * r - 0.5 - j))
            total = total + weight * plane[min(max(j, 0), r - 1)][min(max(i, 0), r - 1)]
    return total


def _planes(tensors, name, x):
    features, i = [], 0
    while f"{name}.planes.{i}" in tensors:
        xy, xz, yz = tensors[f"{name}.planes.{i}"]
        u, v, w = ((c + 1) / 2 for c in x)
        features += list(_texel_mix(xy, u, v) * _texel_mix(xz, u, w) * _texel_mix(yz, v, w))
        i += 1
    return features


def _layers(tensors, name, x):
    i = 0
    while f"{name}.layers.{i}.weight" in tensors:
        if i:
            x = [max(v, 0) for v in x]
        weight, bias = tensors[f"{name}.layers.{i}.weight"], tensors[f"{name}.layers.{i}.bias"]
        x = [b + sum(w * v for w, v in zip(row, x, strict=True)) for row, b in zip(weight, bias, strict=True)]
        i += 1
    return x


def test_density(tensors, points):
    expected = [math.exp(min(max(_layers(tensors, "density", _planes(tensors, "density", x))[0], MIN_LOG_DENSITY),
                             MAX_LOG_DENSITY)) for x in points]
    np.testing.assert_allclose(reference.density(ARCH, tensors, points), expected, rtol=1e-12)


def test_density_is_clipped(tensors, points):
    for bias, value in [(1e4, MAX_LOG_DENSITY), (-1e4, MIN_LOG_DENSITY)]:
        np.testing.assert_allclose(
            reference.density(ARCH, tensors | {"density.layers.1.bias": np.array([bias])}, points), math.exp(value))


def test_reflectance(tensors, points):
    result = reference.reflectance(ARCH, tensors, points)
    for x, actual in zip(points, result, strict=True):
        features = list(x)
        for k in range(3):
            features += [f(2**k * math.pi * c) for f in (math.sin, math.cos) for c in x]
        raw = _layers(tensors, "reflectance", features)
        length = math.sqrt(sum(v * v for v in raw[:3]))
        rest = [1 / (1 + math.exp(-v)) for v in raw[3:]]
        rest[3] = MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * rest[3]
        np.testing.assert_allclose(actual, [v / length for v in raw[:3]] + rest, rtol=1e-11)


def test_ray_mixture(tensors):
    rng = np.random.default_rng(10)
    o, d = rng.uniform(-0.5, 0.5, (12, 3)), rng.normal(size=(12, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o[0] = 5 * np.cross(d[0], [1, 0, 0])  # a miss
    hit, actual = reference.ray_mixture(ARCH, tensors, o, d)
    assert hit.tolist() == [False] + [True] * 11
    for i in range(1, 12):
        m = o[i] - (o[i] @ d[i]) * d[i]
        h = math.sqrt(1 - m @ m)
        ends = [*(m - h * d[i]), *(m + h * d[i])]
        features = list(ends)
        for k in range(2):
            features += [f(2**k * math.pi * c) for f in (math.sin, math.cos) for c in ends]
        *raw, logit = _layers(tensors, "transmittance", features)
        a = [math.exp(logistic.MAX_LOG_SLOPE * math.tanh(r / logistic.MAX_LOG_SLOPE)) for r in raw[::2]]
        b = [logistic.MAX_CENTRE * h * math.tanh(r) for r in raw[1::2]]
        w = [1, math.exp(6 * math.tanh(logit / 6))]
        top = sum(wk / (1 + math.exp(-ak * (h - bk))) for wk, ak, bk in zip(w, a, b, strict=True))
        for k in range(2):
            np.testing.assert_allclose([v[i] for v in actual[k]], [w[k] / top, a[k], b[k]], rtol=1e-10, atol=1e-14)
        single = tuple(tuple(v[i] for v in part) for part in actual)
        assert mixture.transmittance(ops, h, single) == pytest.approx(1)
    assert np.isfinite([v[0] for part in actual for v in part]).all()
    assert abs(actual[0][2][0]) <= logistic.MAX_CENTRE * spheres.MIN_HALF_CHORD

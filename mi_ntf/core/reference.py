"""The networks in NumPy float64: the oracle of tests for the PyTorch and Dr.Jit twins.

The twins share these conventions. Points are (n, 3) in field coordinates, inside [−1, 1]³. A plane of resolution r has
its texel centres at u = (i + ½)/r with u = (x + 1)/2; the first named coordinate runs along the last spatial axis;
beyond the outermost centres the border texel is repeated. Layers compute W x + b; every layer but the last is followed
by ReLU.
"""

import numpy as np

from . import depth_profile, logistic, mixture, ops, spheres
from .architecture import MAX_LOG_DENSITY, MIN_LOG_DENSITY, NO_VISIBILITY, Architecture, Encoding
from .errors import MiNtfError
from .microfacet import MIN_ROUGHNESS
from .ops import Array, Tensors

PLANES = ((0, 1), (0, 2), (1, 2))
"""Axes of each feature plane."""


def bilinear(plane: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the values (n, channels) of a plane (rows v, columns u, channels) at u, v in [0, 1]."""
    r = plane.shape[0]
    x, y = np.clip(u * r - 0.5, 0, r - 1), np.clip(v * r - 0.5, 0, r - 1)
    i, j = np.minimum(x.astype(int), r - 2), np.minimum(y.astype(int), r - 2)
    fx, fy = (x - i)[:, None], (y - j)[:, None]
    result: np.ndarray = ((1 - fy) * ((1 - fx) * plane[j, i] + fx * plane[j, i + 1])
                          + fy * ((1 - fx) * plane[j + 1, i] + fx * plane[j + 1, i + 1]))
    return result


def encode(encoding: Encoding, tensors: Tensors, name: str, x: np.ndarray) -> np.ndarray:
    """Return the features (n, encoding.width) of the points `x` (n, 3)."""
    if encoding.kind == "frequency":
        angles = [np.pi * 2.0**k * x for k in range(encoding.octaves)]
        return np.concatenate([x, *(f(a) for a in angles for f in (np.sin, np.cos))], axis=1)
    u = (x + 1) / 2
    levels = []
    for i in range(len(encoding.resolutions)):
        planes = tensors[f"{name}.planes.{i}"].astype(np.float64)
        features = [bilinear(p, u[:, a], u[:, b]) for p, (a, b) in zip(planes, PLANES, strict=True)]
        levels.append(np.prod(features, axis=0))
    return np.concatenate(levels, axis=1)


def perceptron(tensors: Tensors, name: str, x: np.ndarray) -> np.ndarray:
    """Apply the layers ``name.layers.*`` to `x` (n, inputs)."""
    count = sum(k.startswith(f"{name}.layers.") and k.endswith("weight") for k in tensors)
    for i in range(count):
        w, b = (tensors[f"{name}.layers.{i}.{p}"].astype(np.float64) for p in ("weight", "bias"))
        x = x @ w.T + b
        if i + 1 < count:
            x = np.maximum(x, 0)
    return x


def density(arch: Architecture, tensors: Tensors, x: np.ndarray) -> np.ndarray:
    """Return σ (n,), 1/(unit-sphere radius)."""
    raw = perceptron(tensors, "density", encode(arch.density.encoding, tensors, "density", x))[:, 0]
    sigma: np.ndarray = np.exp(np.clip(raw, MIN_LOG_DENSITY, MAX_LOG_DENSITY))
    return sigma


def reflectance(arch: Architecture, tensors: Tensors, x: np.ndarray) -> np.ndarray:
    """Return unit normal, albedo, roughness and specular weight, (n, 7 + ``arch.specular_channels``).

    The albedo lies in [0, 1], the roughness in [MIN_ROUGHNESS, 1], the weight in [``arch.least_specular``, 1]. Smoke
    has the normal 0, the roughness 1 and the weight 0.
    """
    raw = perceptron(tensors, "reflectance", encode(arch.reflectance.encoding, tensors, "reflectance", x))
    if arch.phase is not None:
        rest = np.tile([1.0] + [0.0] * arch.specular_channels, (len(raw), 1))
        return np.concatenate([np.zeros((len(raw), 3)), logistic.sigmoid(ops, raw[:, 3:6]), rest], axis=1)
    normal = np.stack(ops.normalize(ops, tuple(raw[:, :3].T)), axis=1)
    rest = logistic.sigmoid(ops, raw[:, 3:])
    for columns, least in ((slice(3, 4), MIN_ROUGHNESS), (slice(4, None), arch.least_specular)):
        rest[:, columns] = least + (1 - least) * rest[:, columns]
    return np.concatenate([normal, rest], axis=1)


def visibility(arch: Architecture, tensors: Tensors, x: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the baseline's τ (n,) from the points `x` (n, 3) along the unit directions `d` towards the light."""
    if arch.visibility is None:
        raise MiNtfError(NO_VISIBILITY)
    features = encode(arch.visibility.encoding, tensors, "visibility", np.concatenate([x, d], axis=1))
    tau: np.ndarray = logistic.sigmoid(ops, perceptron(tensors, "visibility", features)[:, 0])
    return tau


def ray_mixture(arch: Architecture, tensors: Tensors, o: np.ndarray, d: np.ndarray,
                places: Array = None, total: Array = None) -> tuple[np.ndarray, mixture.Mixture]:
    """Return ``(hit, mixture)`` of the rays through `o` (n, 3) along the unit directions `d` towards the light.

    `places` (levels, n), `total` (n,): inputs of the encoding `depth`, see :func:`depth_profile.frame`.
    """
    net = arch.transmittance
    hit, m, h = spheres.chord(ops, tuple(o.T), tuple(d.T))
    count = 2 * net.components
    if net.encoding.kind == "depth":
        raw = perceptron(tensors, "transmittance", np.stack(depth_profile.features(ops, places, total, h), axis=1)).T
        pairs = depth_profile.components(ops, raw[:count], places, total, h)
    else:
        ends = np.concatenate([np.stack(p, axis=1) for p in spheres.end_points(m, tuple(d.T), h)], axis=1)
        raw = perceptron(tensors, "transmittance", encode(net.encoding, tensors, "transmittance", ends)).T
        pairs = [logistic.parameters(ops, raw[i], raw[i + 1], h) for i in range(0, count, 2)]
    return hit, mixture.from_outputs(ops, pairs, list(raw[count:]), h)

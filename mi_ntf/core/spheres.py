"""Rays as ordered pairs of points on the unit sphere (Shafiei et al. 2021, section 3.1).

Symbols, used everywhere in this project:

    x, o     points, in field coordinates (the object lies inside the unit sphere at the origin)
    d        unit direction; ω' (`d` of a light ray) points *towards the light*
    p1, p2   entry ω¹ and exit ω² of the line on the unit sphere, so that d = (p2 − p1)/|p2 − p1|
    m        midpoint o' of the chord; it is perpendicular to d
    h        half chord, in (0, 1]; the chord covers t' ∈ [−h, h]
    t        t' = ⟨x, d⟩, the signed distance from m along d

Each is a 3-vector (points, directions) or a scalar array; `ops` is the namespace of elementary functions
(:mod:`mi_ntf.core.ops`).
"""

import numpy as np

from .ops import Array, Ops, Vector, dot

MIN_HALF_CHORD = 0.05
"""Half of the shortest chord that counts. Shorter ones graze the sphere, where the similarity's margin leaves no matter
and float32 loses the end points: their transmittance is 1 by definition. A uniform ray has such a chord with
probability h² = 0.25 %."""


def chord(ops: Ops, o: Vector, d: Vector) -> tuple[Array, tuple[Array, ...], Array]:
    """Return ``(hit, m, h)`` of the chord that the line through `o` along the unit vector `d` cuts from the sphere.

    `hit` is True where the half chord is longer than ``MIN_HALF_CHORD``; `h` is at least that, so that gradients are
    finite elsewhere. disc = b² − (|o|² − 1) with b = ⟨o, d⟩ loses all digits far from the sphere, so it is taken from
    the midpoint, disc = 1 − |o − b d|².
    """
    b = dot(o, d)
    m = tuple(oi - b * di for oi, di in zip(o, d, strict=True))
    # A second projection removes the rounding error of the first when |o| is large.
    c = dot(m, d)
    m = tuple(mi - c * di for mi, di in zip(m, d, strict=True))
    disc = 1 - dot(m, m)
    hit = disc > MIN_HALF_CHORD**2
    h = ops.sqrt(ops.maximum(disc, MIN_HALF_CHORD**2))
    return hit, m, h


def end_points(m: Vector, d: Vector, h: Array) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
    """Return entry and exit ``(p1, p2)`` of the chord with midpoint `m`, unit direction `d` and half length `h`."""
    p1 = tuple(mi - h * di for mi, di in zip(m, d, strict=True))
    p2 = tuple(mi + h * di for mi, di in zip(m, d, strict=True))
    return p1, p2


def coordinate(x: Vector, d: Vector) -> Array:
    """Return t' = ⟨x, ω'⟩, the place of `x` on its ray; the midpoint is perpendicular to ω', so no origin is needed."""
    return dot(x, d)


def fibonacci(count: int, start: float = 0.0) -> np.ndarray:
    """Return `count` evenly spread unit vectors, a Fibonacci lattice down z that is turned by `start` golden angles."""
    i = np.arange(count)
    z, phi = 1 - (i + 0.5) * 2 / count, (i + start) * np.pi * (3 - 5**0.5)
    across = np.sqrt(1 - z * z)
    return np.stack([across * np.cos(phi), across * np.sin(phi), z], axis=1)

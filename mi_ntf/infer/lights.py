"""Lights in field coordinates: the table of discrete lights, and the interface that it shares with sampled lights."""

from collections.abc import Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import drjit as dr
import numpy as np

from . import ops
from .backend import floats
from .types import Float, Mask, UInt32, Vector


@dataclass(frozen=True)
class LightSample:
    """A light seen from a point."""

    wi: Vector
    """Unit vector towards the light, field coordinates."""
    irradiance: Vector
    """Irradiance of a surface that faces the light, linear RGB."""
    distance: Float
    """Distance of the light in field units, literally infinite where all lights are directional."""
    sun: Mask | None = None
    """True for sampled lights whose shadow is marched; None for rows of a table."""


class LightSource(Protocol):
    """A number of lights that shine on points.

    ``far``: all lie outside of the unit sphere and stay there; ``moving``: a light's place carries gradients.
    """

    count: int
    far: bool
    moving: bool

    def sample(self, index: UInt32, x: Vector, active: Mask) -> LightSample:
        """Return light `index` seen from `x`."""


class LightTable:
    """Point and directional lights, one row each.

    Parameters
    ----------
    where
        (n, 3): position of a point light; direction towards a directional one, of any length.
    power
        (n, 3): radiant intensity of a point light (W/sr), irradiance of a directional light (W/m²), linear RGB.
    is_point
        (n,) bool.
    scale
        Scene units per field unit, since irradiance falls with the distance in the scene.
    cones
        (n, 5), or None if no light has a cone: unit axis away from a spot light; the angles from it, radians, at which
        its light begins to fall, linearly, and at which it ends. Angles above π: no cone.
    """

    def __init__(
        self,
        where: np.ndarray,
        power: np.ndarray,
        is_point: np.ndarray,
        scale: float,
        dj: ModuleType,
        cones: np.ndarray | None = None,
    ):
        self.where, self.is_point = np.asarray(where, np.float64), np.asarray(is_point, bool)
        self.count = len(self.where)
        self.first, self.total = 0, self.count  # of a part: row of its first light in the whole table, and its size
        self.dj = dj
        self._arguments = where, power, is_point, scale, dj, cones
        flag = self.is_point[:, None]
        length = np.linalg.norm(self.where, axis=1, keepdims=True)
        self.where = np.where(flag, self.where, self.where / np.maximum(length, 1e-300))
        rows = np.concatenate([self.where, flag, np.reshape(power, (-1, 3)), 0 * flag], axis=1)
        self._rows = floats(rows, dj)
        self._scale = dr.opaque(dj.Float, scale)
        self.moving = False
        self._parallel = not self.is_point.any()
        self.far = bool((np.linalg.norm(self.where[self.is_point], axis=1) > 1).all())
        self._cones: list[Float] | None = None if cones is None else [floats(c, dj) for c in np.transpose(cones)]

    def part(self, first: int, last: int) -> "LightTable":
        """Return the lights `first` … `last` − 1 as a part of this table."""
        part = self.chosen(slice(first, last))
        part.first, part.total = self.first + first, self.total
        return part

    def chosen(self, rows: slice | np.ndarray) -> "LightTable":
        """Return the lights `rows`, a slice or indices, as an independent table."""
        where, power, is_point, scale, dj, cones = self._arguments
        return LightTable(where[rows], power[rows], is_point[rows], scale, dj, None if cones is None else cones[rows])

    def attach(self, where: Vector, power: Vector, axes: Vector | None = None) -> None:
        """Attach gradients to `where`, `power` and, if there are cones, their `axes`; values stay.

        The vectors have components of one number for each light.
        """
        self.moving = dr.grad_enabled(where) or dr.grad_enabled(axes)
        self._parallel = self._parallel and not self.moving
        self.far = self.far and not self.moving
        if axes is not None and self._cones is not None:
            self._cones[:3] = [ops.replace_grad(c, axis) for c, axis in zip(self._cones, axes, strict=False)]
        rows = self.dj.Float(self._rows)
        first = 8 * dr.arange(self.dj.UInt32, self.count)
        for offset, column in zip((0, 1, 2, 4, 5, 6), (*where, *power), strict=True):
            dr.scatter(rows, column, first + offset)
        self._rows = ops.replace_grad(self._rows, rows)

    def sample(self, index: UInt32, x: Vector, active: Mask) -> LightSample:
        """Return light `index` seen from the field points `x`."""
        # Two fetches of four numbers: several times faster than seven of one.
        first = 2 * self.dj.UInt32(index)
        where = dr.gather(self.dj.Array4f, self._rows, first, active)
        power = dr.gather(self.dj.Array4f, self._rows, first + 1, active)
        flag, power = where[3], self.dj.Array3f(power[0], power[1], power[2])
        if self._parallel:
            return LightSample((where[0], where[1], where[2]), tuple(power), self.dj.Float(dr.inf))
        d = self.dj.Array3f(where[0], where[1], where[2]) - flag * self.dj.Array3f(*x)
        r2 = dr.maximum(dr.dot(d, d), 1e-8)
        inverse = dr.rsqrt(r2)
        point = flag > 0
        irradiance = power * dr.select(point, dr.rcp(r2 * self._scale * self._scale), 1)
        wi = d * inverse
        if not self.moving:  # bit by bit the direction of tables without point lights
            wi = dr.select(point, wi, d)
        if self._cones is not None:
            irradiance *= self._falloff(self._cones, index, wi, active)
        return LightSample(tuple(wi), tuple(irradiance), dr.select(point, r2 * inverse, dr.inf))

    def _falloff(self, cones: Sequence[Float], index: UInt32, wi: Vector, active: Mask) -> Float:
        """Return the fraction of its intensity that light `index` sends against `wi`."""
        *axis, begin, end = (dr.gather(self.dj.Float, c, index, active) for c in cones)
        angle = dr.safe_acos(-dr.dot(self.dj.Array3f(*axis), wi))
        return dr.clip((end - angle) / dr.maximum(end - begin, 1e-6), 0, 1)

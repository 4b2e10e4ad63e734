"""A table of discrete lights in field coordinates: what the exhaustive light sum loops over."""

from types import ModuleType

import drjit as dr
import numpy as np


class LightTable:
    """Point and directional lights, one row each.

    where     (n, 3): position of a point light; unit vector towards a directional light
    power     (n, 3): radiant intensity of a point light (W/sr), irradiance of a directional light (W/m²), linear RGB
    is_point  (n,) bool
    scale     scene units per field unit, since irradiance falls with the distance in the scene
    cones     (n, 5) or None where no light has one: unit axis away from a spot light; the angles from it, radians, at
              which its light begins to fall, linearly, and at which it ends. Wider than π: no cone
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
        self.dj = dj
        self._where = dj.Float(self.where.astype(np.float32).ravel())
        self._power = dj.Float(np.asarray(power, np.float32).ravel())
        self._flag = dj.Float(self.is_point.astype(np.float32))
        self._scale = dr.opaque(dj.Float, scale)
        columns = [] if cones is None else np.array(np.transpose(cones), np.float32, order="C")
        self._cones = [dj.Float(c) for c in columns] or None

    def sample(self, index, x, active):
        """Light `index` seen from `x`: ``(wi, irradiance, distance)``.

        `wi`: unit 3-tuple towards the light; `irradiance`: 3-tuple on a surface that faces it; `distance`: field units.
        """
        where = dr.gather(self.dj.Array3f, self._where, index, active)
        power = dr.gather(self.dj.Array3f, self._power, index, active)
        flag = dr.gather(self.dj.Float, self._flag, index, active)
        d = where - flag * self.dj.Array3f(*x)
        r2 = dr.maximum(dr.dot(d, d), 1e-8)
        inverse = dr.rsqrt(r2)
        point = flag > 0
        irradiance = power * dr.select(point, dr.rcp(r2 * self._scale * self._scale), 1)
        wi = d * inverse
        if self._cones is not None:
            irradiance *= self._falloff(index, wi, active)
        return tuple(wi), tuple(irradiance), dr.select(point, r2 * inverse, dr.inf)

    def _falloff(self, index, wi, active):
        """The share of its intensity that light `index` sends against `wi`."""
        *axis, begin, end = (dr.gather(self.dj.Float, c, index, active) for c in self._cones)
        angle = dr.safe_acos(-dr.dot(self.dj.Array3f(*axis), wi))
        return dr.clip((end - angle) / dr.maximum(end - begin, 1e-6), 0, 1)

"""Irradiance of patches (:mod:`mi_ntf.core.radiosity`) at any point near the skin and any normal."""

from types import ModuleType

import drjit as dr
import numpy as np

from ..core.radiosity import CELLS
from .types import Float, Vector


class Irradiance:
    """Irradiance between patches: trilinear between cells, an ambient cube between faces (McTaggart 2004).

    `values` (n, 3): irradiance of the patches of a `table` (6, z, y, x). Faces are weighted by the squares of the
    normal's components.
    """

    def __init__(self, table: np.ndarray, values: np.ndarray, dj: ModuleType):
        self.dj = dj
        # Faces one behind the other along z. Cells far from the skin read row −1.
        rows = np.concatenate([values, np.zeros((1, 3))])[table.reshape(6 * CELLS, CELLS, CELLS)]
        self._texture = dj.Texture3f(
            dj.TensorXf(np.ascontiguousarray(np.pad(rows, [(0, 0)] * 3 + [(0, 1)]), np.float32)),
            use_accel=False, wrap_mode=dr.WrapMode.Clamp,
        )  # fmt: skip

    def __call__(self, p: Vector, normal: Vector) -> list[Float]:
        """Return the three channels at the field points `p`."""
        u, v, w = (0.5 * c + 0.5 for c in p)
        # Not beyond the middle of the outermost cells, where the next face begins.
        w = dr.clip(w, 0.5 / CELLS, 1 - 0.5 / CELLS)
        total: list[Float] = [0, 0, 0]
        for axis, n in enumerate(normal):
            f = dr.select(n < 0, 2 * axis + 1, 2 * axis)
            value = self._texture.eval(self.dj.Array3f(u, v, (w + f) * (1 / 6)))
            total = [t + n * n * c for t, c in zip(total, value[:3], strict=True)]
        return total

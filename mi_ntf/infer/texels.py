"""Numbered rows of numbers in a Dr.Jit texture, the storage of transmittance maps and atlases."""

from types import ModuleType

import drjit as dr
import numpy as np

from .types import Array, Float, Mask, UInt32

DTYPES = (np.float32, np.float16)
"""Types of numbers in full and in half precision."""
COLUMNS = 4096
"""Texels of a texture's line; CUDA's limits are 131072 texels and 65536 lines."""


class Texels:
    """Rows of `channels` numbers, read one at a time without interpolation.

    Parameters
    ----------
    numbers
        The rows one after the other: a NumPy array, which is copied, or a float32 Dr.Jit array of :func:`blank`, which
        is used in place unless `half` is set.
    half
        Store float16 numbers, else float32.
    """

    def __init__(self, numbers: Array, count: int, channels: int, dj: ModuleType, half: bool = False):
        self.dj, self.count, self.channels, self.dtype = dj, count, channels, np.dtype(DTYPES[half])
        types = (dj.Float16, dj.TensorXf16, dj.Texture2f16) if half else (dj.Float, dj.TensorXf, dj.Texture2f)
        array, tensor, texture = types
        lines = _lines(count)
        if isinstance(numbers, np.ndarray):
            padded = np.zeros(lines * COLUMNS * channels, self.dtype)
            padded[: count * channels] = numbers
            numbers = padded
        numbers = array(numbers)
        dr.eval(numbers)  # or the first picture would round them
        values = tensor(numbers, shape=(lines, COLUMNS, channels))
        self.texture = texture(values, filter_mode=dr.FilterMode.Nearest, wrap_mode=dr.WrapMode.Clamp)
        self._line = dr.opaque(dj.Float, 1 / lines)

    def row(self, number: UInt32, active: Mask) -> list[Float]:
        """Return the numbers of row `number`, float32; 0 where not `active`."""
        u, v = self.dj.Float(number % COLUMNS), self.dj.Float(number // COLUMNS)
        values = self.texture.eval(self.dj.Array2f((u + 0.5) * (1 / COLUMNS), (v + 0.5) * self._line), active)
        return [self.dj.Float(value) for value in values]

    def numbers(self) -> np.ndarray:
        """Return the numbers of all rows."""
        values: np.ndarray = self.texture.value().numpy()[: self.count * self.channels]
        return values

    @property
    def nbytes(self) -> int:
        """Size of all rows in bytes."""
        return self.dtype.itemsize * self.count * self.channels


def blank(count: int, channels: int, dj: ModuleType) -> Float:
    """Return zeros for `count` rows."""
    return dr.zeros(dj.Float, _lines(count) * COLUMNS * channels)


def _lines(count: int) -> int:
    return -(-count // COLUMNS)

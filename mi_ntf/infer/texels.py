"""Numbered rows of numbers in a Dr.Jit texture: what transmittance maps and atlases hold."""

from types import ModuleType

import drjit as dr
import numpy as np

DTYPES = (np.float32, np.float16)
"""Of numbers in full and in half precision."""
COLUMNS = 4096
"""Texels of a texture's line; CUDA takes 131072 at most, and 65536 lines."""


class Texels:
    """`count` rows of `channels` numbers, float32 or, with `half`, float16, read one at a time and as they are: what
    lies between two is the reader's to know. `numbers`: rows one after the other; a float32 Dr.Jit array that
    :func:`blank` made is taken as it is unless it must be rounded, one of NumPy is copied."""

    def __init__(self, numbers, count: int, channels: int, dj: ModuleType, half: bool = False):
        self.dj, self.count, self.channels, self.dtype = dj, count, channels, np.dtype(DTYPES[half])
        kinds = (dj.Float16, dj.TensorXf16, dj.Texture2f16) if half else (dj.Float, dj.TensorXf, dj.Texture2f)
        array, tensor, texture = kinds
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

    def row(self, number, active):
        """The numbers of row `number`, float32; 0 where not `active`."""
        u, v = self.dj.Float(number % COLUMNS), self.dj.Float(number // COLUMNS)
        found = self.texture.eval(self.dj.Array2f((u + 0.5) * (1 / COLUMNS), (v + 0.5) * self._line), active)
        return [self.dj.Float(value) for value in found]

    def numbers(self) -> np.ndarray:
        """All of them."""
        return self.texture.value().numpy()[: self.count * self.channels]

    @property
    def nbytes(self) -> int:
        """Of all rows."""
        return self.dtype.itemsize * self.count * self.channels


def blank(count: int, channels: int, dj: ModuleType):
    """Zeros for `count` rows."""
    return dr.zeros(dj.Float, _lines(count) * COLUMNS * channels)


def _lines(count: int) -> int:
    return -(-count // COLUMNS)

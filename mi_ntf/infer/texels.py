"""Numbered rows of numbers in a Dr.Jit texture: what transmittance maps and atlases hold."""

from types import ModuleType

import drjit as dr
import numpy as np

COLUMNS = 4096
"""Texels of a texture's line; CUDA takes 131072 at most, and 65536 lines."""


class Texels:
    """`count` rows of `channels` float32 numbers, read one at a time and as they are: what lies between two
    is the reader's to know. `numbers`: rows one after the other; a Dr.Jit array that :func:`blank` made is taken as it
    is, one of NumPy is copied."""

    def __init__(self, numbers, count: int, channels: int, dj: ModuleType):
        self.dj, self.count, self.channels = dj, count, channels
        lines = _lines(count)
        if isinstance(numbers, np.ndarray):
            padded = np.zeros(lines * COLUMNS * channels, np.float32)
            padded[: count * channels] = numbers
            numbers = dj.Float(padded)
        tensor = dj.TensorXf(numbers, shape=(lines, COLUMNS, channels))
        self.texture = dj.Texture2f(tensor, filter_mode=dr.FilterMode.Nearest, wrap_mode=dr.WrapMode.Clamp)
        self._line = dr.opaque(dj.Float, 1 / lines)

    def row(self, number, active):
        """The numbers of row `number`; 0 where not `active`."""
        u, v = self.dj.Float(number % COLUMNS), self.dj.Float(number // COLUMNS)
        return self.texture.eval(self.dj.Array2f((u + 0.5) * (1 / COLUMNS), (v + 0.5) * self._line), active)

    def numbers(self) -> np.ndarray:
        """All of them, float32."""
        return self.texture.value().numpy()[: self.count * self.channels]

    @property
    def nbytes(self) -> int:
        """Of all rows."""
        return 4 * self.count * self.channels


def blank(count: int, channels: int, dj: ModuleType):
    """Zeros for `count` rows."""
    return dr.zeros(dj.Float, _lines(count) * COLUMNS * channels)


def _lines(count: int) -> int:
    return -(-count // COLUMNS)

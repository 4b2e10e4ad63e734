"""Voxels that photographs change: multiplicative updates, which converge without step lengths to choose."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ..infer.types import Array, Float
from ..infer.voxel_parameters import Lattice

MEMORY = 0.8
"""Decay of a voxel's accumulated light, each time that a photograph shows it."""
PRIOR = 0.5
"""Weight of the field as it was, in photographs that show a voxel as well as the mean voxel is shown."""
LARGEST = 0.3
"""Largest relative change by one step."""
LEAST = 0.01
"""Value below which changes are absolute, so that black voxels can become brighter."""
HIGHEST = {"albedo": 1.0, "specular": 1.0, "emission": np.inf}
"""Upper bounds by parameter. The light of a picture is proportional to each of these parameters."""


class Voxels:
    """Values of one parameter at the voxels of a `lattice`.

    Their light in a picture is linear in the values a: p = J a. Errors e of pictures change the values by the factors
    1 − Jᵀ e / Σ Jᵀ p, as in the algebraic reconstruction of tomography (Andersen and Kak 1984). The sum over past
    pictures is the light that a voxel has contributed, so the mean of many noisy errors counts. Both back-projections
    are smoothed over neighbours, since a photograph shows each voxel by few samples.
    """

    def __init__(self, name: str, tensor: Array, lattice: Lattice) -> None:
        self.name, self._shape = name, tensor.shape
        self._channels = tensor.shape[4] if len(tensor.shape) == 5 else 1
        self.values: Float = dr.detach(tensor.array)
        self._light: Float = dr.zeros(mi.Float, dr.width(self.values))
        self._neighbours = _neighbours(lattice)
        self._attached: Array = self.tensor()

    def tensor(self) -> Array:
        """Return the values as a tensor of their own."""
        return mi.TensorXf(self.values, self._shape)

    def attach(self) -> Array:
        """Return the values as a tensor that collects gradients."""
        self._attached = mi.TensorXf(self.values + dr.opaque(mi.Float, 0), self._shape)
        dr.enable_grad(self._attached)
        return self._attached

    def projected(self) -> Float:
        """Return the gradients that the attached values have collected, smoothed, and forget them."""
        gradient = dr.detach(dr.grad(self._attached).array)
        dr.clear_grad(self._attached)
        result = self._smoothed(dr.select(dr.isfinite(gradient), gradient, 0))
        dr.eval(result)
        return result

    def step(self, error: Float, light: Float, rate: float) -> None:
        """Change the values by the projections of a picture's error and of its light, `rate` times as far."""
        shown = light > 0
        self._light = dr.select(shown, MEMORY * self._light + light, self._light)
        count = dr.maximum(dr.sum(dr.select(shown, mi.Float(1), mi.Float(0))), 1)
        mean = dr.sum(dr.select(shown, light, 0)) / count
        change = dr.opaque(mi.Float, rate) * error / (self._light + PRIOR * mean + 1e-30)
        change = dr.select(shown, dr.clip(change, -LARGEST, LARGEST), 0)
        self.values = dr.clip(self.values - dr.maximum(self.values, LEAST) * change, 0, HIGHEST[self.name])
        dr.eval(self.values, self._light)

    def state(self) -> dict[str, np.ndarray]:
        """Return all numbers that change."""
        return {"values": self.values.numpy(), "light": self._light.numpy()}

    def resume(self, state: dict[str, np.ndarray]) -> None:
        """Take over a :meth:`state`."""
        self.values, self._light = mi.Float(state["values"]), mi.Float(state["light"])

    def _smoothed(self, values: Float) -> Float:
        """Return means of `values`: a half of each voxel's own and a twelfth of each neighbour's."""
        channels = self._channels
        index = dr.arange(mi.UInt32, dr.width(values))
        voxel, channel = index // channels, index % channels
        dr.eval(values)
        total = 0.5 * values
        for neighbour in self._neighbours:
            other = dr.gather(mi.UInt32, neighbour, voxel)
            total += dr.gather(mi.Float, values, other * channels + channel) / 12
        return total


def _neighbours(lattice: Lattice) -> list[mi.UInt32]:
    """Return the numbers of each voxel's six neighbours, or its own where a block is missing."""
    x, y, z = lattice.blocks.voxels()
    own = dr.arange(mi.UInt32, dr.width(x))
    result = []
    for axis in range(3):
        for step in (-1, 1):
            place = [mi.Int(c) + (step if a == axis else 0) for a, c in enumerate((x, y, z))]
            number, owned = lattice.blocks.number(*(mi.UInt32(dr.maximum(c, 0)) for c in place))
            result.append(dr.select(owned, number, own))
    dr.eval(result)
    return result

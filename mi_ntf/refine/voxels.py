"""Voxels that photographs change, by the errors of pictures projected back onto them."""

from __future__ import annotations

from abc import ABC, abstractmethod

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.microfacet import MIN_ROUGHNESS
from ..infer.tuning import EARLIER_GRADIENTS, STEP_LENGTHS
from ..infer.types import Array, Float
from ..infer.voxel_parameters import Lattice

MEMORY = 0.8
"""Decay of a voxel's accumulated light, each time that a photograph shows it."""
PRIOR = 0.5
"""Weight of the field as it was, in photographs that show a voxel as well as the mean voxel is shown."""
RANGES = {"albedo": (0.0, 1.0), "specular": (0.0, 1.0), "emission": (0.0, np.inf), "roughness": (MIN_ROUGHNESS, 1.0),
          "density": (-np.inf, np.inf), "log_density": (-np.inf, np.inf)}
"""Bounds of the values by parameter; for both densities those of ln σ."""
LINEAR = ("albedo", "specular", "emission")
"""Parameters to which the light of a picture is proportional."""
LARGEST = 0.3
"""Largest relative change by one step."""
LEAST = 0.01
"""Value below which changes are absolute, so that black voxels can become brighter."""
DARKEST = 1e-20
"""Density below which a voxel holds nothing, and stays so."""


class Voxels(ABC):
    """Values of one parameter at the voxels of a `lattice`, which the errors of pictures change.

    Projections onto the voxels are smoothed over neighbours, since a photograph shows each voxel by few samples.
    """

    def __init__(self, name: str, tensor: Array, lattice: Lattice) -> None:
        self.name, self._shape = name, tensor.shape
        self._channels = tensor.shape[4] if len(tensor.shape) == 5 else 1
        self.values: Float = dr.detach(tensor.array)
        self._sum: Float = dr.zeros(mi.Float, dr.width(self.values))
        self._neighbours = _neighbours(lattice)
        self._attached: Array = self.values

    def tensor(self) -> Array:
        """Return the parameter as a tensor of its own."""
        return mi.TensorXf(self._parameter(self.values), self._shape)

    def attach(self) -> Array:
        """Return the parameter as a tensor that passes gradients on to the values."""
        self._attached = self.values + dr.opaque(mi.Float, 0)
        dr.enable_grad(self._attached)
        return mi.TensorXf(self._parameter(self._attached), self._shape)

    def _parameter(self, values: Float) -> Float:
        """Return the parameter with these values."""
        return values

    def projected(self) -> Float:
        """Return the gradients that the attached values have collected, smoothed, and forget them."""
        gradient = dr.detach(dr.grad(self._attached))
        dr.clear_grad(self._attached)
        result = self._smoothed(dr.select(dr.isfinite(gradient), gradient, 0))
        dr.eval(result)
        return result

    @abstractmethod
    def step(self, error: Float, light: Float, rate: float) -> None:
        """Change the values by the projections of a picture's error and of its light, `rate` times as far."""

    def state(self) -> dict[str, np.ndarray]:
        """Return all numbers that change."""
        return {"values": self.values.numpy(), "sum": self._sum.numpy()}

    def resume(self, state: dict[str, np.ndarray]) -> None:
        """Take over a :meth:`state`."""
        self.values, self._sum = mi.Float(state["values"]), mi.Float(state["sum"])

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


class Linear(Voxels):
    """Values whose light in a picture is linear in them, p = J a.

    Errors e of pictures change the values by the factors 1 − Jᵀ e / Σ Jᵀ p, as in the algebraic reconstruction of
    tomography (Andersen and Kak 1984), which needs no step lengths. The sum over past pictures is the light that a
    voxel has contributed, so the mean of many noisy errors counts.
    """

    def step(self, error: Float, light: Float, rate: float) -> None:
        """Change the values, see :meth:`Voxels.step`."""
        shown = light > 0
        self._sum = dr.select(shown, MEMORY * self._sum + light, self._sum)
        change = dr.opaque(mi.Float, rate) * error / (self._sum + PRIOR * _mean(light) + 1e-30)
        change = dr.select(shown, dr.clip(change, -LARGEST, LARGEST), 0)
        self.values = dr.clip(self.values - dr.maximum(self.values, LEAST) * change, *RANGES[self.name])
        dr.eval(self.values, self._sum)


class Descended(Voxels):
    """Values by gradient descent.

    The step of a voxel is its gradient over the root of the sum of its squared gradients so far (AdaGrad, Duchi et al.
    2011), so steps shorten. The values are ln σ for a ``density``.
    """

    def __init__(self, name: str, tensor: Array, lattice: Lattice) -> None:
        super().__init__(name, tensor, lattice)
        if name == "density":
            self.values = dr.log(dr.maximum(self.values, DARKEST))

    def _parameter(self, values: Float) -> Float:
        if self.name == "density":
            return dr.select(values > np.log(DARKEST), dr.exp(values), 0)
        return values

    def step(self, error: Float, light: Float, rate: float) -> None:
        """Change the values, see :meth:`Voxels.step`; `light` is not used."""
        squared = dr.square(error)
        if not dr.any(self._sum > 0):  # the first step
            self._sum += EARLIER_GRADIENTS * _mean(squared) + 1e-30
        self._sum += squared
        step = dr.opaque(mi.Float, rate * STEP_LENGTHS[self.name]) * error * dr.rsqrt(self._sum)
        self.values = dr.clip(self.values - step, *RANGES[self.name])
        dr.eval(self.values, self._sum)


def _mean(values: Float) -> Float:
    """Return the mean of the values that are positive."""
    positive = dr.select(values > 0, values, 0)
    return dr.sum(positive) / dr.maximum(dr.sum(dr.select(values > 0, mi.Float(1), mi.Float(0))), 1)


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

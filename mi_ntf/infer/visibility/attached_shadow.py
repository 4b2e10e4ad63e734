"""Transmittances with derivatives by the density of their field."""

from collections.abc import Callable

import drjit as dr

from ..types import Float, Mask, UInt32, Vector
from .raymarch import MAX_OPTICAL_DEPTH, RayMarch, drawn_depth


class AttachedDepth:
    """Optical depth of rays through a field, with the gradients of its density.

    Parameters
    ----------
    march
        March through the field.
    log_density
        Function of field points to ln σ, attached.

    Notes
    -----
    The optical depth D = ∫ σ dt changes by ∫ σ d(ln σ) dt, which is D times the mean of d(ln σ) over the matter on the
    ray. One place on the ray, drawn in proportion to σ by the march that measures D, estimates the mean without bias.
    So the loops over lights and samples need no differentiable loop within.
    """

    def __init__(self, march: RayMarch, log_density: Callable[[Vector], Float]):
        self.march, self._log_density = march, log_density

    def relative_change(self, x: Vector) -> Float:
        """Return 0 with the gradients of ln σ at `x`."""
        log_density = self._log_density(x)
        return log_density - dr.detach(log_density)

    def along(self, x: Vector, wi: Vector, distance: Float, active: Mask) -> tuple[Float, Float]:
        """Return ``(D, dD)`` of the rays from `x`: the optical depth, detached, and 0 with its gradients.

        Rays that are blocked have no gradients.
        """
        x, wi = tuple(dr.detach(c) for c in x), tuple(dr.detach(c) for c in wi)
        depth, t = drawn_depth(self.march.volume, x, wi, dr.detach(distance), self.march.steps, active)
        change = self.relative_change(tuple(a + t * b for a, b in zip(x, wi, strict=True)))
        return depth, dr.select(active & (depth < MAX_OPTICAL_DEPTH) & (depth > 0), depth * change, 0)


class AttachedShadow:
    """Visibility by a march, whose transmittance carries the gradients of the optical `depth`: dτ = −τ dD."""

    def __init__(self, depth: AttachedDepth):
        self._depth = depth

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the transmittance of rays, attached. `x` may lie outside the sphere."""
        depth, change = self._depth.along(x, wi, distance, active)
        tau: Float = dr.select(depth < MAX_OPTICAL_DEPTH, dr.exp(-depth), 0)
        if dr.grad_enabled(x, wi, distance):
            tau = self._depth.march.tau(x, wi, distance, index, active)
        return tau * (1 - change)

"""Transmittances with derivatives by the density of their field."""

from collections.abc import Callable

import drjit as dr

from ..types import Float, Mask, UInt32, Vector, Visibility
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
        self._march, self._log_density = march, log_density

    def relative_change(self, x: Vector) -> Float:
        """Return 0 with the gradients of ln σ at `x`."""
        log_density = self._log_density(x)
        return log_density - dr.detach(log_density)

    def along(self, x: Vector, wi: Vector, distance: Float, active: Mask) -> tuple[Float, Float]:
        """Return ``(D, dD)`` of the rays from `x`: the optical depth, detached, and 0 with its gradients.

        Rays that are blocked have no gradients.
        """
        x, wi = tuple(dr.detach(c) for c in x), tuple(dr.detach(c) for c in wi)
        depth, t = drawn_depth(self._march.volume, x, wi, dr.detach(distance), self._march.steps, active)
        change = self.relative_change(tuple(a + t * b for a, b in zip(x, wi, strict=True)))
        return depth, dr.select(active & (depth < MAX_OPTICAL_DEPTH) & (depth > 0), depth * change, 0)


class AttachedShadow:
    """The visibility `looked_up`, whose transmittance carries the gradients of the optical `depth`: dτ = −e^(−D) dD."""

    def __init__(self, looked_up: Visibility, depth: AttachedDepth):
        self.looked_up, self._depth = looked_up, depth

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the transmittance of the method, attached."""
        if isinstance(self.looked_up, RayMarch) and not dr.grad_enabled(x, wi, distance):
            return self.attach(None, x, wi, distance, active)
        return self.attach(self.looked_up.tau(x, wi, distance, index, active, sun), x, wi, distance, active)

    def attach(self, tau: Float | None, x: Vector, wi: Vector, distance: Float, active: Mask) -> Float:
        """Return the transmittance `tau` of rays, None for that of the march, with the gradients of the density."""
        depth, change = self._depth.along(x, wi, distance, active)
        marched = dr.select(depth < MAX_OPTICAL_DEPTH, dr.exp(-depth), 0)
        return (marched if tau is None else tau) - marched * change

"""Shadows with derivatives by the density of their field."""

from collections.abc import Callable

import drjit as dr

from ..types import Float, Mask, UInt32, Vector, Visibility
from .raymarch import MAX_OPTICAL_DEPTH, RayMarch, drawn_depth


class AttachedShadow:
    """The visibility `looked_up`, whose transmittance carries the gradients of the density along the ray.

    Parameters
    ----------
    looked_up
        Visibility method of the field.
    march
        March through the field, for the derivative alone.
    log_density
        Function of field points to ln σ, attached.

    Notes
    -----
    dτ = −τ ∫ σ d(ln σ) dt. The integral is the optical depth D times the mean of d(ln σ) over the matter on the ray.
    One place on the ray, drawn in proportion to σ by the march that measures D, estimates the mean without bias. So
    the loop over lights needs no differentiable loop within.
    """

    def __init__(self, looked_up: Visibility, march: RayMarch, log_density: Callable[[Vector], Float]):
        self.looked_up, self._march, self._log_density = looked_up, march, log_density

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask, sun: Mask = None) -> Float:
        """Return the transmittance of the method, attached."""
        if isinstance(self.looked_up, RayMarch) and not dr.grad_enabled(x, wi, distance):
            return self.attach(None, x, wi, distance, active)
        return self.attach(self.looked_up.tau(x, wi, distance, index, active, sun), x, wi, distance, active)

    def attach(self, tau: Float | None, x: Vector, wi: Vector, distance: Float, active: Mask) -> Float:
        """Return the transmittance `tau` of rays, None for that of the march, with the gradients of the density."""
        x, wi = tuple(dr.detach(c) for c in x), tuple(dr.detach(c) for c in wi)
        depth, t = drawn_depth(self._march.volume, x, wi, dr.detach(distance), self._march.steps, active)
        lit = depth < MAX_OPTICAL_DEPTH
        if tau is None:
            tau = dr.select(lit, dr.exp(-depth), 0)
        log_density = self._log_density(tuple(a + t * b for a, b in zip(x, wi, strict=True)))
        change = dr.select(active & lit & (depth > 0), depth * (log_density - dr.detach(log_density)), 0)
        return tau * (1 - change)


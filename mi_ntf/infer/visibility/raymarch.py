"""``raymarch``: one march per point and light, the reference (method.md, section 7)."""

import drjit as dr

from ..march import optical_depth


class RayMarch:
    """`steps`: see :func:`mi_ntf.infer.march.optical_depth`."""

    def __init__(self, density, grid, steps):
        self.density, self.grid, self.steps = density, grid, steps

    def tau(self, x, wi, distance, index, active):
        """exp(−∫σ) from `x` to the light."""
        return dr.exp(-optical_depth(self.density, self.grid, x, wi, distance, self.steps, active))


def default_steps(step: float, gradients: bool = False) -> tuple[float, float, float]:
    """(shortest, longest, growth) from the camera march's cell length: finer beside the point, which lies in the skin
    that makes the depth, a fifth of the distance further off, and never longer than half an occupancy cell, which would
    jump over thin parts. Below 2/384, all shrink with `step`: the march converges.

    `gradients`: for derivatives, which see the slopes of a skin: 28 % off with steps of 1/64, 2 % with 1/512.
    """
    longest = 1 / 512 if gradients else max(step, min(3 * step, 1 / 64))
    return 0.375 * step, longest, min(0.2, 38.4 * step)

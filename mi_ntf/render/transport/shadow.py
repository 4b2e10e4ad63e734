"""What dims a light on its way to points of a field: that field, others, surfaces."""

import drjit as dr

from ...infer.visibility import outside


class Shadow:
    """All that dims a light on its way to points of one field: that field (`own`, a visibility method in the
    coordinates of `frame`), the others (pairs of frame and method) and `surfaces`; `far`: the light lies outside of
    that field's sphere, which might as well be infinitely far away for it. A visibility method itself."""

    def __init__(self, frame, own, others: list, surfaces, far: bool = False):
        self.frame, self.own, self.others, self.surfaces, self.far = frame, own, others, surfaces, far

    def tau(self, x, wi, distance, index, active):
        """Return the product of their transmittances, in [0, 1]; a colour where surfaces may have one."""
        tau = self.own.tau(x, wi, type(distance)(dr.inf) if self.far else distance, index, active)
        p, d = self.frame.point_to_world(x), self.frame.direction_to_world(wi)
        length = distance * self.frame.length
        for frame, other in self.others:
            tau = tau * between(frame, other, p, d, length, index, active & (tau > 0))
        if self.surfaces:
            tau = tau * self.surfaces.transmission(p, d, length, active & (tau > 0))
        return tau


class Known:
    """A visibility method that knows its answer: that of a light at the camera, which light and view share."""

    def __init__(self, tau):
        self._tau = tau

    def tau(self, x, wi, distance, index, active):
        return self._tau


def between(frame, method, p, d, length, index, active):
    """A field's transmittance between scene points, by a visibility `method` in the coordinates of `frame`."""
    x, wi = frame.point_to_field(p), frame.direction_to_field(d)
    return outside.tau(method, x, wi, length / frame.length, index, active)

"""Transmittance from a light to points of a field, through that field, other fields and surfaces."""

import drjit as dr

from ...infer.visibility import outside


class Shadow:
    """Product of all transmittances on the way from a light to points of one field; a visibility method itself.

    own       visibility method of that field, in the coordinates of `frame`
    others    pairs of frame and visibility method of the other fields
    surfaces  :class:`mi_ntf.render.transport.surfaces.Surfaces`, or None
    far       the light lies outside of the field's sphere, so for this field it may count as infinitely far away
    """

    def __init__(self, frame, own, others: list, surfaces, far: bool = False):
        self.frame, self.own, self.others, self.surfaces, self.far = frame, own, others, surfaces, far

    def tau(self, x, wi, distance, index, active):
        """Return the product of their transmittances, in [0, 1]; a colour where surfaces may have one."""
        tau = self.own.tau(x, wi, type(distance)(dr.inf) if self.far else distance, index, active)
        p, d = self.frame.point_to_world(x), self.frame.direction_to_world(wi)
        length = distance * self.frame.length
        for frame, other in self.others:
            tau = tau * between(frame, other, p, d, length, index, active & (tau != 0))
        if self.surfaces:
            tau = tau * self.surfaces.transmission(p, d, length, active & (tau != 0))
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

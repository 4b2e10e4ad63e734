"""Reflected light at shading points: points × lights in one kernel."""

import drjit as dr

from ..core import microfacet
from . import ops


def reflect(points, lights, visibility):
    """Σ over lights of irradiance · τ · f, f the phase function of :func:`mi_ntf.core.microfacet.scattering`: the h(x,
    ω_o) of method.md, section 1.

    points      :class:`Points`
    lights      has ``count`` and ``sample(index, x, active) → (wi, irradiance, distance)``
    visibility  has ``tau`` (:mod:`mi_ntf.infer.visibility`); None: no shadow. The light then does not pass the skin
                either, so a point reflects as a surface does, ρ ⟨n,ω_i⟩⁺

    Returns radiance per point, a 3-tuple. The loop over lights is symbolic: compile time and memory do not depend on
    their number.
    """
    floats = type(points.x[0])
    uint = dr.uint32_array_t(floats)
    count = dr.opaque(uint, lights.count)

    def body(i, r, g, b):
        wi, irradiance, distance = lights.sample(i, points.x, True)
        model = microfacet.scattering if visibility else microfacet.lobes
        diffuse, specular = model(ops, wi, points.wo, points.normal, points.roughness)
        lit = diffuse > 0
        tau = dr.select(lit, visibility.tau(points.x, wi, distance, i, lit), 0) if visibility else 1
        d = (1 - points.specular) * diffuse * tau
        s = points.specular * specular * tau
        r = r + irradiance[0] * (points.albedo[0] * d + s)
        g = g + irradiance[1] * (points.albedo[1] * d + s)
        b = b + irradiance[2] * (points.albedo[2] * d + s)
        return i + 1, r, g, b

    zero = dr.zeros(floats, dr.width(points.x[0]))
    _, r, g, b = dr.while_loop(
        state=(dr.zeros(uint, dr.width(zero)), zero, zero, zero),
        cond=lambda i, r, g, b: i < count,
        body=body,
        label="lights",
    )
    return r, g, b


class Points:
    """Shading points: position, direction to the viewer, reflectance. 3-tuples and scalars, all of one width."""

    def __init__(self, x, wo, reflectance):
        self.x, self.wo = x, wo
        self.normal, self.albedo, self.roughness, self.specular = reflectance

"""Reflected light at shading points: points × lights in one kernel."""

from typing import Any, NamedTuple

import drjit as dr

from ..core import fresnel, microfacet
from ..core.ops import dot
from . import ops

EDGE = 0.02
"""Cosines over which derivatives spread the jump of the phase function between light from below and from above."""


def reflect(points, lights, visibility, specular=True, gradients=False, skin=True):
    """Σ over lights of irradiance · τ · f, f the phase function of :func:`mi_ntf.core.microfacet.scattering`: the h(x,
    ω_o) of method.md, section 1.

    points      :class:`Points`
    lights      has ``count`` and ``sample(index, x, active) → (wi, irradiance, distance)``, and the number that
                `visibility` knows the light by, where that is not its index
    visibility  has ``tau`` (:mod:`mi_ntf.infer.visibility`), a number or a colour; None: no shadow. The light then does
                not pass the skin either, so a point reflects as a surface does, ρ ⟨n,ω_i⟩⁺
    specular    whether the field has a specular lobe; without, all its albedo is diffuse
    skin        whether the points lie in a skin; otherwise on a surface, as without shadow
    gradients   whether a parameter is attached: the loop can then be differentiated in reverse. Transmittances are held
                fixed unless the lights' own places are attached (``lights.moving``)

    Returns radiance per point, a 3-tuple. The loop over lights is symbolic: compile time and memory do not depend on
    their number (but for moving lights, as Dr.Jit cannot differentiate one loop within another).
    """
    floats = type(points.x[0])
    uint = dr.uint32_array_t(floats)
    moving = getattr(lights, "moving", False)

    def body(i, r, g, b):
        wi, irradiance, distance, *known = lights.sample(i, points.x, True)
        number = known[0] if known else i
        lit, diffuse, gloss = _lobes(wi, points, skin and bool(visibility), specular)
        tau = _tau(visibility, points.x, wi, distance, number, lit, gradients and not moving) if visibility else 1
        if moving and visibility:
            tau = tau * _edge(wi, points.normal)
        value = [k * diffuse + gloss for k in points.albedo] if specular else [k * diffuse for k in points.albedo]
        dimmed = tuple(tau) if dr.depth_v(tau) > 1 else (tau, tau, tau)
        r, g, b = (c + e * v * t for c, e, v, t in zip((r, g, b), irradiance, value, dimmed, strict=True))
        return i + 1, r, g, b

    zero = dr.zeros(floats, dr.width(points.x[0]))
    if moving:
        light = zero, zero, zero
        for i in range(lights.count):
            light = body(dr.opaque(uint, i), *light)[1:]
        return light
    count = dr.opaque(uint, lights.count)
    _, r, g, b = dr.while_loop(
        state=(dr.zeros(uint, dr.width(zero)), zero, zero, zero),
        cond=lambda i, r, g, b: i < count,
        body=body,
        label="lights",
        max_iterations=-1 if gradients else None,  # a sum
    )
    return r, g, b


def _edge(wi, normal):
    """1, with the slope of a ramp over EDGE: what the jump of the skin's lobes at the horizon adds to derivatives."""
    cos = dot(normal, wi)
    return dr.replace_grad(type(cos)(1), dr.select(dr.detach(cos) < EDGE, cos * (1 / EDGE), 0))


def _tau(visibility, x, wi, distance, index, lit, fixed: bool):
    """The transmittance where `lit`, 0 elsewhere; without derivatives if `fixed`."""
    if fixed:
        wi, distance = dr.detach(wi), dr.detach(distance)
    return dr.select(lit, visibility.tau(x, wi, distance, index, lit), 0)


def _lobes(wi, points, skin: bool, specular: bool):
    """Return a mask of light on the normal's side, the diffuse lobe, to be multiplied by the albedo, and the specular
    one (None without), each with its weight, which may be 0."""
    if not specular:
        cos = dr.maximum(dot(points.normal, wi), 0)
        if skin:
            cos = microfacet.joint_cosine(ops, cos, dr.maximum(dot(points.normal, points.wo), 0), points.softness)
        return cos > 0, cos * microfacet.INV_PI, None
    direction = wi, points.wo, points.normal, points.roughness
    diffuse, gloss = (
        microfacet.scattering(ops, *direction, points.softness) if skin else microfacet.lobes(ops, *direction)
    )
    of_diffuse, of_gloss = fresnel.weights(ops, *direction, points.specular, points.reflectance.fresnel)
    return diffuse > 0, of_diffuse * diffuse, of_gloss * gloss


class Reflectance(NamedTuple):
    """Reflectance of field points: ranges as in :mod:`mi_ntf.core.microfacet`, softness as in :mod:`mi_ntf.core.skin`.
    `fresnel`: whether the specular weight is that at normal incidence alone."""

    normal: tuple
    albedo: tuple
    roughness: Any
    specular: Any
    softness: Any
    fresnel: bool = False

    def diffuse_albedo(self) -> list:
        """Albedos, linear RGB, of a diffuse surface that reflects as much of light from everywhere."""
        return [fresnel.diffuse_albedo(ops, k, self.roughness, self.specular, self.fresnel) for k in self.albedo]


class Points:
    """Shading points: position, direction to the viewer, reflectance. 3-tuples and scalars, all of one width.

    ray, ordinal  of each point: the number of its camera ray, and its place among the points of this ray. Random
                  lights of the point follow from these two. None: the point's place in the arrays, and 0.
    """

    def __init__(self, x, wo, reflectance: Reflectance, ray=None, ordinal=None):
        self.x, self.wo, self.reflectance = x, wo, reflectance
        uint = dr.uint32_array_t(type(x[0]))
        self.ray = dr.arange(uint, dr.width(x[0])) if ray is None else ray
        self.ordinal = uint(0) if ordinal is None else ordinal
        self.normal, self.albedo, self.roughness, self.specular, self.softness, _ = reflectance

    def evaluate(self) -> None:
        """Compute them now: what follows loops over lights."""
        dr.eval(self.x, self.wo, self.normal, self.albedo, self.roughness, self.specular, self.softness, self.ray,
                self.ordinal)

"""Reflected light at shading points: points × lights in one kernel."""

from typing import NamedTuple, Protocol

import drjit as dr

from ..core import fresnel, microfacet
from ..core.ops import dot
from . import ops
from .lights import LightSource
from .types import Array, Float, Mask, UInt32, Vector, Visibility

EDGE = 0.02
"""Cosines over which derivatives spread the jump of the phase function between light from below and from above."""


class Lobe(Protocol):
    """Phase function of a participating medium at points; directions in field coordinates."""

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Vector, Float]:
        """Return value (linear RGB, 1/sr) and density of light scattered from `wi` to `wo`."""

    def sample(self, wo: Vector, u1: Float, u2: tuple[Float, Float]) -> Vector:
        """Return a direction to the light, of the density of :meth:`evaluate`; the numbers are uniform in [0, 1)."""


class Reflectance(NamedTuple):
    """Reflectance of field points: ranges as in :mod:`mi_ntf.core.microfacet`, softness as in :mod:`mi_ntf.core.skin`.

    `specular`: weight of the specular lobe, linear RGB; at normal incidence if there is a Fresnel term. `retro`: the
    field's retro-reflection (:mod:`mi_ntf.core.fresnel`), None without a Fresnel term. `tail`: that of the specular
    lobe (:mod:`mi_ntf.core.microfacet`), None for GGX. `lobe`: a phase function that is weighted by the albedo, in
    place of normal, roughness and specular weight. `emission`: emitted radiance of matter that reflects nothing.
    """

    normal: Vector
    albedo: Vector
    roughness: Float
    specular: Vector
    softness: Float
    retro: Float | None = None
    tail: Float | None = None
    lobe: Lobe | None = None
    emission: Vector | None = None

    def diffuse_albedo(self) -> list[Float]:
        """Return the linear RGB albedo of a diffuse surface that reflects as much of uniform light."""
        rim = self.retro is not None
        return [fresnel.diffuse_albedo(ops, k, self.roughness, s, rim)
                for k, s in zip(self.albedo, self.specular, strict=True)]


class Points:
    """Shading points: position, direction to the viewer, reflectance; vectors and scalars of one width.

    Parameters
    ----------
    ray, ordinal
        Number of each point's camera ray, and its place among the points of this ray. The random numbers of sampled
        lights follow from these two. None: the point's place in the arrays, and 0.
    """

    def __init__(self, x: Vector, wo: Vector, reflectance: Reflectance, ray: UInt32 | None = None,
                 ordinal: UInt32 | None = None):
        self.x, self.wo, self.reflectance = x, wo, reflectance
        uint = dr.uint32_array_t(type(x[0]))
        self.ray: UInt32 = dr.arange(uint, dr.width(x[0])) if ray is None else ray
        self.ordinal: UInt32 = uint(0) if ordinal is None else ordinal
        self.normal, self.albedo, self.roughness, self.specular, self.softness, _, self.tail, self.lobe, _ = reflectance

    def evaluate(self) -> None:
        """Evaluate the arrays now, before a loop over lights."""
        dr.eval(self.x, self.wo, self.normal, self.albedo, self.roughness, self.specular, self.softness, self.ray,
                self.ordinal)


def reflect(points: Points, lights: LightSource, visibility: Visibility | None, specular: bool = True,
            gradients: bool = False, skin: bool = True) -> tuple[Float, Float, Float]:
    """Return the radiance that `points` reflect from all lights: Σ of irradiance · τ · f.

    f is the phase function of :func:`mi_ntf.core.microfacet.scattering`; the sum is the light that a
    point scatters to the viewer.

    Parameters
    ----------
    visibility
        None: no shadow. The light then does not pass the skin either, so a point reflects as a surface, ρ ⟨n,ω_i⟩⁺.
    specular
        The field has a specular lobe; otherwise all its albedo is diffuse.
    gradients
        A parameter is attached, so the loop must be differentiable in reverse. Transmittances are held fixed unless the
        lights' own places are attached (``lights.moving``).
    skin
        The points lie in a skin, otherwise on a surface.

    Notes
    -----
    The loop over lights is symbolic: compile time and memory do not depend on their number. It is unrolled for moving
    lights, since Dr.Jit cannot differentiate one loop within another.
    """
    floats = type(points.x[0])
    uint = dr.uint32_array_t(floats)
    moving = lights.moving

    def body(i: UInt32, r: Float, g: Float, b: Float) -> tuple[Array, ...]:
        light = lights.sample(i, points.x, True)
        lit, value = _value(light.wi, points, skin and bool(visibility), specular)
        tau: Array = 1
        if visibility:
            wi, distance = light.wi, light.distance
            if gradients and not moving:
                wi, distance = dr.detach(wi), dr.detach(distance)
            index = i if light.sun is None else uint(0)  # sampled lights are in no table
            tau = dr.select(lit, visibility.tau(points.x, wi, distance, index, lit, light.sun), 0)
            if moving:
                tau = tau * _edge(light.wi, points.normal)
        dimmed = tuple(tau) if dr.depth_v(tau) > 1 else (tau, tau, tau)
        r, g, b = (c + e * v * t for c, e, v, t in zip((r, g, b), light.irradiance, value, dimmed, strict=True))
        return i + 1, r, g, b

    zero = dr.zeros(floats, dr.width(points.x[0]))
    if moving:
        r = g = b = zero
        for i in range(lights.count):
            _, r, g, b = body(dr.opaque(uint, i), r, g, b)
        return r, g, b
    count = dr.opaque(uint, lights.count)
    _, r, g, b = ops.while_loop(
        state=(dr.zeros(uint, dr.width(zero)), zero, zero, zero),
        cond=lambda i, r, g, b: i < count,
        body=body,
        label="lights",
        max_iterations=-1 if gradients else None,  # a sum
    )
    return r, g, b


def _edge(wi: Vector, normal: Vector) -> Float:
    """Return 1, with the slope of a ramp over EDGE: the derivative of the jump of the skin's lobes at the horizon."""
    cos = dot(normal, wi)
    return ops.replace_grad(type(cos)(1), dr.select(dr.detach(cos) < EDGE, cos * (1 / EDGE), 0))


def _value(wi: Vector, points: Points, skin: bool, specular: bool) -> tuple[Mask, list[Float]]:
    """Return a mask of light that is scattered, and the phase function, linear RGB; `specular`: with that lobe."""
    if points.lobe:
        phase, _ = points.lobe.evaluate(wi, points.wo)
        value = [k * c for k, c in zip(points.albedo, phase, strict=True)]
        return dr.maximum(dr.maximum(value[0], value[1]), value[2]) > 0, value
    if not specular:
        cos = dr.maximum(dot(points.normal, wi), 0)
        if skin:
            cos = microfacet.joint_cosine(ops, cos, dr.maximum(dot(points.normal, points.wo), 0), points.softness)
        diffuse = cos * microfacet.INV_PI
        return cos > 0, [k * diffuse for k in points.albedo]
    direction = wi, points.wo, points.normal, points.roughness
    diffuse, glossy = (
        microfacet.scattering(ops, *direction, points.softness, points.tail) if skin
        else microfacet.lobes(ops, *direction, points.tail)
    )
    weights = [fresnel.weights(ops, *direction, s, points.reflectance.retro) for s in points.specular]
    return diffuse > 0, [k * w * diffuse + s * glossy for k, (w, s) in zip(points.albedo, weights, strict=True)]

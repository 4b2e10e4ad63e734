"""Effects that a scene needs, as a frozen description on which the later code branches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import quantities
from ...core.errors import MiNtfError
from ...infer.backend import floats, module_of
from ...infer.types import Float, Vector3
from ...infer.visibility import REGISTRY
from ..lights.scene_lights import Lights
from ..scene.frame import Frame
from ..scene.many import MIN_GLOSS, Crowd
from ..scene.media import NRFMedium, lets_light_through, ordinary_shapes
from ..scene.settings import Settings
from ..scene.traversal import traverse

PINHOLES = ("PerspectiveCamera",)
"""Cameras whose rays all start at one point; light from there has the transmittance of the view."""
NEAR = 1e-3
"""Largest distance of a light at the camera, relative to the distance of the nearest field's sphere."""
POWERS = {
    "PointLight": ("intensity",),
    "SpotLight": ("intensity", "texture"),
    "DirectionalEmitter": ("irradiance",),
    "EnvironmentMapEmitter": ("data", "scale"),
    "ConstantBackgroundEmitter": ("radiance",),
    "AreaLight": ("radiance",),
    "Projector": ("irradiance", "scale"),
    "SmoothDiffuse": ("reflectance",),
}
"""Mitsuba's class name → parameters in which radiance is linear."""
FIELD = ("log_density", "density", "albedo", "roughness", "specular", "emission")
"""Parameters of a field by which there are derivatives."""
STOCK = ("sigma_t", "scale", "albedo")
"""Parameters of Mitsuba's own media by which there are derivatives."""
PLACES = {"PointLight": ("position",), "SpotLight": ("to_world",), "DirectionalEmitter": ("to_world",)}
"""Mitsuba's class name → parameters that move a light of the table, and its shadows."""


@dataclass(frozen=True)
class Effects:
    """Effects of a render. An effect that is absent is neither traced into a kernel nor built.

    emitters    plugin names of the emitters
    lit         a light has power, and `max_depth` lets it scatter
    emission    the camera may see a field that emits light
    background  the environment is directly visible
    exhaustive  every light is summed at every shading point, rather than random ones
    visibility  visibility method, never ``auto``
    reason      reason for this method
    collocated  all light comes from the camera, so that it has the transmittance of the view
    in_view     for each medium: the camera may see it
    surfaces    there are shapes other than the media's bounds
    specular    a field has a specular lobe
    fresnel     a field has a specular lobe whose weight grows towards grazing angles
    bounces     method for multiple scattering, ``paths`` or ``radiosity``; "": there is none
    gradients   a scene parameter carries gradients
    """

    emitters: tuple[str, ...]
    lit: bool
    emission: bool
    background: bool
    exhaustive: bool
    visibility: str
    reason: str
    collocated: bool
    in_view: tuple[bool, ...]
    surfaces: bool
    specular: bool
    fresnel: bool
    bounces: str
    gradients: bool

    @property
    def needs_visibility(self) -> bool:
        """True if a visibility method has to be built."""
        return self.lit and (not self.collocated or self.surfaces or bool(self.bounces))


def describe(scene: mi.Scene, settings: Settings, sensor: mi.Sensor, spp: int, media: Sequence[NRFMedium],
             lights: Lights) -> Effects:
    """Return the effects of rendering `scene`, with its `media` and `lights`, by `spp` camera rays a pixel."""
    depth = settings.max_depth
    lit = bool(lights.rows.power.size or lights.sampled) and not 0 <= depth < 2
    exhaustive = settings.light_samples == 0
    gradients = check_gradients(scene, lights, media)
    surfaces = len(ordinary_shapes(scene)) > 0
    # Derivatives by a light's position need the light's own transmittance. A camera ray crosses a surface or ends there
    # at random, while a shadow ray is attenuated.
    collocated = (lit and not gradients and settings.visibility != "none" and _at_camera(lights, sensor, media)
                  and not lets_light_through(scene) and not any(m.shadow_catcher for m in media))
    width, height = sensor.film().crop_size()
    bounces = _bounces(settings, media, surfaces, gradients) if lit and not 0 <= depth <= 2 else ""
    _check_field_gradients(media, settings, bounces)
    method, reason = _method(settings, width * height * spp, lights)
    if collocated:
        reason += "; not needed where the camera's own transmittance is the light's"
    in_view = _in_view(sensor, media)
    rims = [m.field.retro is not None for m in media]
    return Effects(
        emitters=tuple(lights.kinds),
        lit=lit,
        emission=depth != 0 and any(m.field.emissive for m, seen in zip(media, in_view, strict=True) if seen),
        background=lights.background and not settings.hide_emitters and depth != 0,
        exhaustive=exhaustive,
        visibility=method,
        reason=reason,
        collocated=collocated,
        in_view=in_view,
        surfaces=surfaces,
        specular=settings.specular and (any(rims) or any(m.field.grid.gloss > MIN_GLOSS for m in media)),
        fresnel=settings.specular and any(rims),
        bounces=bounces,
        gradients=gradients,
    )


def _bounces(settings: Settings, media: Sequence[NRFMedium], surfaces: bool, gradients: bool) -> str:
    """Return the method for multiple scattering; ``auto`` is radiosity if that covers the whole scene."""
    conditions = {
        "surfaces": surfaces, "many instances": any(isinstance(m, Crowd) for m in media), "derivatives": gradients,
        "visibility=none": settings.visibility == "none",
        "smoke": any(not m.field.softness.opaque for m in media if m.field.grid.majorant > 0)}
    unsupported, name = [text for text, holds in conditions.items() if holds], settings.bounces
    if name == "radiosity" and unsupported:
        raise MiNtfError(
            f"nrf integrator: bounces=radiosity is light between the opaque skins of fields, but here are "
            f"{' and '.join(unsupported)}; choose bounces=paths"
        )
    return name if name != "auto" else "paths" if unsupported else "radiosity"


def sampled_light_count(settings: Settings, lights: Lights) -> int:
    """Return the number of lights that are sampled at random for each shading point."""
    return settings.light_samples or 2 * len(lights.sampled)


def lights_per_point(settings: Settings, lights: Lights) -> int:
    """Return the number of lights for each shading point, those of the table and sampled ones."""
    return len(lights.rows.power) + sampled_light_count(settings, lights)


def _method(settings: Settings, rays: int, lights: Lights) -> tuple[str, str]:
    """Return the visibility method and the reason for it; `rays`: number of camera rays."""
    method = settings.visibility
    if method != "auto":
        if REGISTRY[method].sampled and settings.light_samples:
            raise MiNtfError(
                f"light_samples is {settings.light_samples}, but visibility={method} holds one map or volume for "
                "every light and sums all of them; remove light_samples or choose raymarch or transmittance_atlas"
            )
        return method, "chosen by name"
    shadow_rays = rays * settings.frames * lights_per_point(settings, lights)
    atlas_rays = REGISTRY["transmittance_atlas"].rays(0, 0)
    fewer = shadow_rays <= atlas_rays
    return ("raymarch" if fewer else "transmittance_atlas",
            f"camera rays times lights are {quantities.count(shadow_rays)}, {'no more' if fewer else 'more'} than the "
            f"{quantities.count(atlas_rays)} rays that fill an atlas")


def _at_camera(lights: Lights, sensor: mi.Sensor, media: Sequence[NRFMedium]) -> bool:
    """Return True if all lights are points at the pinhole of the camera."""
    if lights.sampled or sensor.class_name() not in PINHOLES or not lights.rows.is_point.all():
        return False
    eye = _eye(sensor)
    to_field = min(abs(np.linalg.norm(m.frame.origin - eye) - m.frame.length) for m in media)
    return bool((np.linalg.norm(lights.rows.where - eye, axis=1) <= NEAR * to_field).all())


def _in_view(sensor: mi.Sensor, media: Sequence[NRFMedium]) -> tuple[bool, ...]:
    """Return True for each medium that has matter and whose sphere intersects the pyramid of a pinhole camera."""
    has_matter = [m.field.grid.majorant > 0 for m in media]
    if sensor.class_name() not in PINHOLES:
        return tuple(has_matter)
    film = sensor.film()
    margin = film.rfilter().radius() + 1 if film.sample_border() else 0
    (u0, u1), (v0, v1) = ((-margin / n, 1 + margin / n) for n in film.crop_size())
    zero: Float = 0.0
    places = (floats(np.array(c), module_of(mi.Float)) for c in ([u0, u1, u1, u0], [v0, v0, v1, v1]))
    corner: Vector3 = mi.Point2f(*places)
    rays, _ = sensor.sample_ray(zero, zero, corner, mi.Point2f(0.5))
    corners = np.array(rays.d, np.float64).T
    sides = np.cross(corners, np.roll(corners, -1, axis=0))
    sides *= np.sign(sides @ corners.sum(0))[:, None] / np.linalg.norm(sides, axis=1, keepdims=True)
    eye = _eye(sensor)
    return tuple(
        matter and bool((sides @ (m.frame.origin - eye) > -m.frame.length).all())
        for matter, m in zip(has_matter, media, strict=True)
    )


def on_film(sensor: mi.Sensor, frame: Frame) -> tuple[np.ndarray, np.ndarray] | None:
    """Return the corners (low, high) of a box around the sphere of `frame` on the picture, a unit square.

    Returns None if the camera is no pinhole or the sphere reaches behind it.
    """
    if sensor.class_name() not in PINHOLES:
        return None
    corners = frame.origin[:, None] + frame.length * (2 * np.indices((2, 2, 2)).reshape(3, 8) - 1)
    interaction = dr.zeros(mi.Interaction3f, 8)
    interaction.p = mi.Point3f(*(mi.Float(c) for c in corners))
    if (np.array(sensor.world_transform().inverse() @ interaction.p)[2] <= 0).any():
        return None
    projection, _ = sensor.sample_direction(interaction, mi.Point2f(0.5))
    place = np.array(projection.uv, np.float64) / np.array(sensor.film().crop_size(), np.float64)[:, None]
    return np.clip(place.min(1), 0, 1), np.clip(place.max(1), 0, 1)


def _eye(sensor: mi.Sensor) -> np.ndarray:
    """Return the position of a camera's pinhole."""
    return np.array(sensor.world_transform().translation(), np.float64).ravel()


def check_gradients(scene: mi.Scene, lights: Lights, media: Sequence[NRFMedium] = ()) -> bool:
    """Return True if a parameter of `scene` carries gradients.

    Raises MiNtfError if derivatives by this parameter are not supported.
    """
    parameters = traverse(scene)
    attached = [key for key, value in parameters if dr.grad_enabled(value)]
    for key in attached:
        if not _supported(parameters, key, lights, media):
            raise MiNtfError(
                f"gradients by {key}: not supported; detach it. Supported are what lights emit (intensity, irradiance, "
                "radiance, texture of a spot, data and scale of an envmap), the reflectance of diffuse BSDFs, density, "
                "albedo, roughness, specular and emission of a field, sigma_t, scale and albedo of a medium and, of "
                "lights that are not drawn at random, the position of a point and the to_world of a spot or directional"
            )
        place = key.rpartition(".")[2] in ("position", "to_world")
        if place and lets_light_through(scene):
            raise MiNtfError(f"gradients by {key}: not supported beside surfaces that let light through (null, mask, "
                             "thindielectric), whose own slopes would be missing; detach it or take these surfaces out")
    return bool(attached)


def _check_field_gradients(media: Sequence[NRFMedium], settings: Settings, bounces: str) -> None:
    """Raise MiNtfError if a field carries gradients and the render has effects that would leave them out."""
    names = [name for m in media for name in m.attached]
    unsupported = {"max_depth above 2": bool(bounces), "unbiased": settings.unbiased}
    present = [text for text, holds in unsupported.items() if holds]
    if names and present:
        raise MiNtfError(f"gradients by {names[0]} of a field: not supported with {' and '.join(present)}, which would "
                         "leave parts of them out; detach it, or render with max_depth=2 and unbiased=false")


def _supported(parameters: mi.SceneParameters, key: str, lights: Lights, media: Sequence[NRFMedium]) -> bool:
    node, words = parameters.properties[key][2], 1
    if getattr(node, "is_nrf", False):
        return key.rpartition(".")[2] in FIELD
    if any(key.endswith(name) and name.split(".")[0] in STOCK for m in media for name in m.attached):
        return True
    while node is not None:
        of_owner, kind = ".".join(key.split(".")[-words:]), node.class_name()
        if of_owner.startswith(POWERS.get(kind, ())):
            return True
        if of_owner in PLACES.get(kind, ()):
            return any(node is d.emitter for d in lights.discrete)
        node, words = parameters.hierarchy[node][0], words + 1
    return False

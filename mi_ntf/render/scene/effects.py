"""Effects that a scene calls for, as a frozen description that the later code branches on."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.visibility import REGISTRY
from . import gradient_checks
from .media import lets_light_through, ordinary_shapes
from .settings import Settings

PINHOLES = ("PerspectiveCamera",)
"""Cameras whose rays all pass one point: light from there goes the way of the view."""
MIN_GLOSS = 0.01
"""Specular lobes that stay below this share of a white diffuse surface (:class:`mi_ntf.infer.grid.GridField`, `gloss`)
are left out."""
NEAR = 1e-3
"""A light counts as at the camera within this share of the distance to the nearest field's sphere."""


@dataclass(frozen=True)
class Effects:
    """Effects of a render. An effect that is absent is neither traced into a kernel nor built.

    emitters    their kinds
    lit         a light has power, and `max_depth` lets it scatter
    background  the environment is seen directly
    exhaustive  every light at every shading point, rather than random ones
    visibility  the method that runs, never ``auto``; `reason`: why that one
    collocated  all light comes from the camera: the view transmittance is the light's too
    in_view     of each medium, whether the camera may see matter of it
    surfaces    there are shapes other than the media's bounds
    specular    a field has a specular lobe
    fresnel     one whose weight grows towards grazing angles
    bounces     how light that scatters more than once is found, ``paths`` or ``radiosity``; "": it is not looked for
    gradients   a scene parameter is attached
    """

    emitters: tuple[str, ...]
    lit: bool
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


def describe(scene, settings: Settings, sensor, spp: int, media: list, light) -> Effects:
    """The effects of rendering `scene`, with its `media` and `light`
    (:class:`mi_ntf.render.lights.scene_lights.Lights`), by an ``nrf`` integrator of `settings` with `spp` camera rays a
    pixel."""
    depth = settings.max_depth
    lit = bool(light.rows.power.size or light.sampled) and not 0 <= depth < 2
    exhaustive = settings.light_samples == 0
    gradients = gradient_checks.check(scene, light)
    surfaces = len(ordinary_shapes(scene)) > 0
    # Derivatives by a light's place need the light's own transmittance. A camera ray either crosses a surface or ends
    # there, at random, while a shadow ray is dimmed.
    collocated = (lit and not gradients and settings.visibility != "none" and _at_camera(light, sensor, media)
                  and not lets_light_through(scene))
    width, height = sensor.film().crop_size()
    bounces = _bounces(settings, media, surfaces, gradients) if lit and not 0 <= depth <= 2 else ""
    method, reason = _method(settings, width * height * spp, light)
    if collocated:
        reason += "; not needed where the camera's own transmittance is the light's"
    rims = [m.field.header.architecture.fresnel for m in media]
    return Effects(
        emitters=tuple(light.kinds),
        lit=lit,
        background=light.background and not settings.hide_emitters and depth != 0,
        exhaustive=exhaustive,
        visibility=method,
        reason=reason,
        collocated=collocated,
        in_view=_in_view(sensor, media),
        surfaces=surfaces,
        specular=settings.specular and (any(rims) or any(m.field.grid.gloss > MIN_GLOSS for m in media)),
        fresnel=settings.specular and any(rims),
        bounces=bounces,
        gradients=gradients,
    )


def _bounces(integrator, media: list, surfaces: bool, gradients: bool) -> str:
    """Return the way of further bounces: the chosen one, or with ``auto`` radiosity where it covers the whole scene."""
    name = integrator.bounces
    unknown = [what for what, there in (
        ("surfaces", surfaces), ("derivatives", gradients), ("visibility=none", integrator.visibility == "none"),
        ("smoke", any(not m.field.softness.opaque for m in media if m.field.grid.majorant > 0))) if there]
    if name == "radiosity" and unknown:
        raise MiNtfError(
            f"nrf integrator: bounces=radiosity is light between the opaque skins of fields, but here are "
            f"{' and '.join(unknown)}; choose bounces=paths"
        )
    return name if name != "auto" else "paths" if unknown else "radiosity"


def drawn(integrator, light) -> int:
    """Lights that are drawn for each point."""
    return integrator.light_samples or 2 * len(light.sampled)


def _method(settings, rays: int, light) -> tuple[str, str]:
    """Return the visibility method that runs, and why."""
    method = settings.visibility
    if method != "auto":
        if REGISTRY[method].drawn and settings.light_samples:
            raise MiNtfError(
                f"light_samples is {settings.light_samples}, but visibility={method} holds one map or volume for "
                "every light and sums all of them; remove light_samples or choose raymarch or transmittance_atlas"
            )
        return method, "chosen by name"
    marched = rays * settings.frames * shadow_rays(settings, light)
    filled = REGISTRY["transmittance_atlas"].rays(0, 0)
    fewer = marched <= filled
    return ("raymarch" if fewer else "transmittance_atlas",
            f"camera rays times lights are {count(marched)}, {'no more' if fewer else 'more'} than the {count(filled)} "
            "rays that fill an atlas")


def shadow_rays(settings, light) -> int:
    """Return the number of lights that a shading point asks for, all of the table and those drawn at random."""
    return len(light.rows.power) + drawn(settings, light)


def count(number: float) -> str:
    """Return a large number in words of two digits."""
    for size, word in ((1e9, " billion"), (1e6, " million"), (1e3, " thousand")):
        if number >= size:
            return f"{float(f'{number / size:.2g}'):g}{word}"
    return f"{number:g}"


def _at_camera(light, sensor, media) -> bool:
    """Return True if all lights are points at the pinhole of the camera."""
    if light.sampled or sensor.class_name() not in PINHOLES or not light.rows.is_point.all():
        return False
    eye = _eye(sensor)
    to_field = min(abs(np.linalg.norm(m.frame.origin - eye) - m.frame.length) for m in media)
    return bool((np.linalg.norm(light.rows.where - eye, axis=1) <= NEAR * to_field).all())


def _in_view(sensor, media) -> tuple[bool, ...]:
    """Return for each medium if its sphere reaches into the pinhole camera's pyramid and holds matter."""
    held = [m.field.grid.majorant > 0 for m in media]
    if sensor.class_name() not in PINHOLES:
        return tuple(held)
    film = sensor.film()
    margin = film.rfilter().radius() + 1 if film.sample_border() else 0
    (u0, u1), (v0, v1) = ((-margin / n, 1 + margin / n) for n in film.crop_size())
    rays, _ = sensor.sample_ray(0.0, 0.0, mi.Point2f([u0, u1, u1, u0], [v0, v0, v1, v1]), mi.Point2f(0.5))
    corners = np.array(rays.d, np.float64).T
    sides = np.cross(corners, np.roll(corners, -1, axis=0))
    sides *= np.sign(sides @ corners.sum(0))[:, None] / np.linalg.norm(sides, axis=1, keepdims=True)
    eye = _eye(sensor)
    return tuple(
        h and bool((sides @ (m.frame.origin - eye) > -m.frame.length).all()) for h, m in zip(held, media, strict=True)
    )


def on_film(sensor, frame):
    """Corners (low, high) of the part of the picture, a unit square, that the sphere of `frame` may take; None where
    the camera is no pinhole or the sphere reaches behind it."""
    if sensor.class_name() not in PINHOLES:
        return None
    corners = frame.origin[:, None] + frame.length * (2 * np.indices((2, 2, 2)).reshape(3, 8) - 1)
    at = dr.zeros(mi.Interaction3f, 8)
    at.p = mi.Point3f(*(mi.Float(c) for c in corners))
    if (np.array(sensor.world_transform().inverse() @ at.p)[2] <= 0).any():
        return None
    seen, _ = sensor.sample_direction(at, mi.Point2f(0.5))
    place = np.array(seen.uv, np.float64) / np.array(sensor.film().crop_size(), np.float64)[:, None]
    return np.clip(place.min(1), 0, 1), np.clip(place.max(1), 0, 1)


def _eye(sensor) -> np.ndarray:
    """Position of a camera's pinhole."""
    return np.array(sensor.world_transform().translation(), np.float64).ravel()

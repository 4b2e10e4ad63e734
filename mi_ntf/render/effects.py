"""What a scene calls for: one look at it, a frozen description, and everything after it branches on that."""

from dataclasses import dataclass

import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from . import cost, gradient_checks

PINHOLES = ("PerspectiveCamera",)
"""Cameras whose rays all pass one point: light from there goes the way of the view."""
MIN_GLOSS = 0.01
"""Specular lobes that stay below this share of a white diffuse surface (:class:`mi_ntf.infer.grid.GridField`, `gloss`)
are left out."""
NEAR = 1e-3
"""A light counts as at the camera within this share of the distance to the nearest field's sphere."""


@dataclass(frozen=True)
class Effects:
    """What takes part in a render; what does not is neither traced into a kernel nor built.

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
        """Whether a visibility method has to be built."""
        return self.lit and (not self.collocated or self.surfaces or self.bounces)


def find_media(scene) -> list:
    """The scene's ``nrf`` media. Raises MiNtfError where there is none, or a bounding shape is wrong."""
    media, bounds = [], []
    for shape in scene.shapes():
        medium = _nrf_medium(shape)
        if medium is None:
            continue
        if not any(medium is m for m in media):
            media.append(medium)
            bounds.append([])
        bounds[next(i for i, m in enumerate(media) if m is medium)].append(shape)
    if not media:
        raise MiNtfError(
            'nrf integrator: the scene has no nrf medium; put one inside a bounding shape: <shape type="sphere"> '
            '… <bsdf type="null"/> <medium type="nrf" name="interior"> … </medium> </shape>, '
            "or let `mi-ntf swap` write the scene"
        )
    for medium, shapes in zip(media, bounds, strict=True):
        _check_bounds(medium, shapes)
    return media


def ordinary_shapes(scene) -> list:
    """All shapes but the bounds of ``nrf`` media. Raises MiNtfError where one holds another medium."""
    shapes = [s for s in scene.shapes() if _nrf_medium(s) is None]
    for shape in shapes:
        if shape.is_medium_transition():
            raise MiNtfError(
                f"nrf integrator: {_called(shape)} bounds a medium that is no nrf medium, which this integrator does "
                "not see; remove the medium, or render the scene with volpath"
            )
    return shapes


def _nrf_medium(shape):
    medium = shape.interior_medium() if shape.is_medium_transition() else None
    return medium if getattr(medium, "is_nrf", False) else None


def _check_bounds(medium, shapes) -> None:
    """The medium knows its own place; its one bounding shape must enclose the object there."""
    corners = np.stack(np.meshgrid(*zip(*medium.field.grid.bounds, strict=True), indexing="ij"), -1).reshape(-1, 3)
    world = np.array(medium.frame.point_to_world(corners.T.astype(np.float32)), dtype=np.float64).T
    # Matter lies in the unit sphere too, out of which the corners of a box may stick.
    origin, radius = medium.frame.origin, medium.frame.length
    low, high = np.maximum(world.min(0), origin - radius), np.minimum(world.max(0), origin + radius)
    if len(shapes) > 1:
        raise MiNtfError(
            f"{len(shapes)} bounding shapes ({', '.join(map(_called, shapes))}) share one nrf medium ({medium.path}), "
            f"which is at one place, {_text(origin)}, by <ref> or since Mitsuba merges media of the same text; give "
            "each shape a medium of its own with its own to_world, or take the other shapes out"
        )
    (shape,), slack = shapes, 0.01 * radius
    _check_bsdf(shape)
    box = shape.bbox()
    if not ((np.array(box.min).ravel() <= low + slack).all() and (np.array(box.max).ravel() >= high - slack).all()):
        raise MiNtfError(
            f"bounding {_called(shape)} spans {_text(box.min)} to {_text(box.max)}, but the nrf medium inside it "
            f"({medium.path}) has its object from {_text(low)} to {_text(high)}; give shape and medium the same "
            f"placement (a sphere of centre {_text(origin)} and radius {radius:.4g} fits)"
        )


def _called(shape) -> str:
    """A shape as its user knows it: by its id, else by kind and place."""
    return f'shape "{shape.id()}"' if shape.id() else f"{shape.class_name()} at {_text(shape.bbox().center())}"


def _check_bsdf(shape) -> None:
    """A bound is no surface: rays enter the medium as if it were not there."""
    flags, names = shape.bsdf().flags(), ("Diffuse", "Glossy", "DeltaReflection", "DeltaTransmission")
    if any(mi.has_flag(flags, getattr(mi.BSDFFlags, name)) for name in names):
        raise MiNtfError(
            f"bounding {_called(shape)} has a {shape.bsdf().class_name()} BSDF, but a shape that bounds an nrf "
            'medium is no surface; give it <bsdf type="null"/> (the default is diffuse), and add a surface such as '
            "glass as a shape of its own around it"
        )


def _text(v) -> str:
    return "(" + ", ".join(f"{float(c):.4g}" for c in np.array(v).ravel()) + ")"


def describe(scene, integrator, sensor, spp: int, media: list, light) -> Effects:
    """The effects of rendering `scene`, with its `media` and `light` (:class:`mi_ntf.render.lights.Lights`), by an
    ``nrf`` integrator with `spp` camera rays a pixel."""
    depth = integrator.max_depth
    lit = bool(light.rows.power.size or light.sampled) and not 0 <= depth < 2
    exhaustive = integrator.light_samples == 0
    gradients = gradient_checks.check(scene, light)
    # Derivatives by a light's place need the light's own transmittance.
    collocated = lit and not gradients and integrator.visibility != "none" and _at_camera(light, sensor, media)
    surfaces = len(ordinary_shapes(scene)) > 0
    width, height = sensor.film().crop_size()
    method, reason = _method(integrator, width * height * spp, exhaustive, media)
    if collocated:
        reason += "; not needed where the camera's own transmittance is the light's"
    rims = [m.field.header.architecture.fresnel for m in media]
    return Effects(
        emitters=tuple(light.kinds),
        lit=lit,
        background=scene.environment() is not None and not integrator.hide_emitters and depth != 0,
        exhaustive=exhaustive,
        visibility=method,
        reason=reason,
        collocated=collocated,
        in_view=_in_view(sensor, media),
        surfaces=surfaces,
        specular=any(rims) or any(m.field.grid.gloss > MIN_GLOSS for m in media),
        fresnel=any(rims),
        bounces=_bounces(integrator.bounces, media, method, surfaces, gradients) if lit and not 0 <= depth <= 2 else "",
        gradients=gradients,
    )


SOLID = 0.5
"""Fields with fewer opaque skins than this share are smoke, whose bounces radiosity does not know."""


def _bounces(name: str, media: list, method: str, surfaces: bool, gradients: bool) -> str:
    """How further bounces are found: `name`, or the fast way where it knows all that takes part."""
    unknown = [what for what, there in (
        ("surfaces", surfaces), ("derivatives", gradients), ("visibility=none", method == "none"),
        ("smoke", any(m.field.softness.solid < SOLID for m in media if m.field.grid.majorant > 0))) if there]
    if name == "radiosity" and unknown:
        raise MiNtfError(
            f"nrf integrator: bounces=radiosity is light between the opaque skins of fields, but here are "
            f"{' and '.join(unknown)}; choose bounces=paths"
        )
    return name if name != "auto" else "paths" if unknown else "radiosity"


def _method(integrator, rays: int, exhaustive: bool, media: list) -> tuple[str, str]:
    """The visibility method that runs, and why."""
    method, reason = integrator.visibility, "chosen by name"
    if method in ("transmittance_map", "transmittance_volume") and not exhaustive:
        raise MiNtfError(
            f"light_samples is {integrator.light_samples}, but visibility={method} holds one map or volume for every "
            "light and sums all of them; remove light_samples or choose raymarch or neural_transmittance"
        )
    if method == "auto":
        if not exhaustive:
            return "raymarch", "random lights have no maps"
        return cost.choose(cost.work(integrator, media[0], method, rays))
    return method, reason


def _at_camera(light, sensor, media) -> bool:
    """Whether all lights are points at the pinhole of the camera."""
    if light.sampled or sensor.class_name() not in PINHOLES or not light.rows.is_point.all():
        return False
    eye = _eye(sensor)
    to_field = min(abs(np.linalg.norm(m.frame.origin - eye) - m.frame.length) for m in media)
    return bool((np.linalg.norm(light.rows.where - eye, axis=1) <= NEAR * to_field).all())


def _in_view(sensor, media) -> tuple[bool, ...]:
    """Of each medium, whether its sphere reaches into the pinhole camera's pyramid and holds matter."""
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


def _eye(sensor) -> np.ndarray:
    """Where the pinhole of a camera is."""
    return np.array(sensor.world_transform().translation(), np.float64).ravel()

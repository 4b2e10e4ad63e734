"""The ``nrf`` media of a scene, the shapes that bound them, and the scene's ordinary shapes."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Protocol, cast

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.grid import Density
from ...infer.shade import Reflectance
from ...infer.types import Float, Vector
from .frame import Frame
from .loaded import LoadedField
from .stock_medium import StockMedium
from .traversal import traverse


class NRFMedium(Protocol):
    """Attributes of the ``nrf`` medium plugin, whose class exists once a variant is set.

    `source`: density, of the baked voxels or of the networks, as `representation` says; `path`: the field file;
    `resolution`: voxels per side that the scene asks for, None: the default, or a medium of Mitsuba; `shadow_catcher`:
    shadows of others darken the light that the field emits.
    """

    field: LoadedField
    frame: Frame
    source: Density
    representation: str
    path: str
    resolution: int | None
    shadow_catcher: bool

    @property
    def attached(self) -> Sequence[str]:
        """Names of the medium's parameters that carry gradients."""

    @property
    def attached_log_density(self) -> Callable[[Vector], Float] | None:
        """Function of field points to ln σ with the gradients of the density; None if it has none."""

    def reflectance(self, x: Vector) -> Reflectance:
        """Return the reflectance at field points."""


class InstancedMedium:
    """A field as an instance of a shape group places it; all but its `frame` is that of the `medium` in the group."""

    is_nrf = False  # the medium itself stands in the group, not in the scene

    def __init__(self, medium: NRFMedium, frame: Frame) -> None:
        self.medium, self.frame = medium, frame

    def __getattr__(self, name: str) -> object:
        return getattr(self.medium, name)


def find_media(scene: mi.Scene) -> list[NRFMedium]:
    """Return the scene's ``nrf`` media, those of instances, and then its media of Mitsuba.

    Each instance of a shape group has the fields of its group. Raises MiNtfError if there is no medium, or if a
    bounding shape is wrong.
    """
    media: list[NRFMedium] = []
    bounds: list[list[mi.Shape]] = []
    stock: list[NRFMedium] = []
    for shape in scene.shapes():
        medium = _nrf_medium(shape)
        if medium is None:
            if shape.is_medium_transition():
                stock.append(medium_inside(shape))
            continue
        if not any(medium is m for m in media):
            media.append(medium)
            bounds.append([])
        bounds[next(i for i, m in enumerate(media) if m is medium)].append(shape)
    for medium, shapes in zip(media, bounds, strict=True):
        _check_bounds(medium, shapes)
    media += _instanced(scene)
    if not media and not stock:
        raise MiNtfError(
            'nrf integrator: the scene has no nrf medium and no other; put one inside a bounding shape: '
            '<shape type="sphere"> … <bsdf type="null"/> <medium type="nrf" name="interior"> … </medium> </shape>, '
            "or let `mi-ntf swap` write the scene"
        )
    return media + stock


def medium_inside(shape: mi.Shape) -> NRFMedium:
    """Return the medium inside `shape`, which is closed. Raises MiNtfError if there is none, or one that is refused."""
    field = _nrf_medium(shape)
    if field is not None:
        return field
    if not shape.is_medium_transition():
        raise MiNtfError(f'{_label(shape)} has no medium inside; nest one with the name "interior"')
    if shape.exterior_medium() is not None or shape.interior_medium() is None:
        raise MiNtfError(f"{_label(shape)} has an exterior medium, which fills space without an end; put the medium "
                         "inside a closed shape of its own, or render the scene with volpath")
    return cast(NRFMedium, StockMedium(shape, shape.interior_medium(), _label(shape)))


def ordinary_shapes(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes that rays can meet.

    Bounds of ``nrf`` media, shapes with a ``null`` BSDF that emit nothing, and instances of groups are left out if the
    groups hold fields alone. Raises MiNtfError if a shape in a group bounds another medium than a field.
    """
    absent = _hold_fields_alone(scene)
    for shape in _grouped(scene):
        if shape.is_medium_transition() and _nrf_medium(shape) is None:
            raise MiNtfError(
                f"nrf integrator: {_label(shape)} bounds a medium inside a shapegroup, but media cannot be instanced; "
                "take the shape out of the group, and give each place a shape and a medium of its own"
            )
    return [s for s in scene.shapes() if _nrf_medium(s) is None and not _is_absent(s)
            and not (absent and s.class_name() == "Instance")]


def shape_groups(scene: mi.Scene) -> list[mi.Shape]:
    """Return the ``shapegroup`` objects of `scene`, which its list of shapes does not contain."""
    return [node for node in traverse(scene).hierarchy if node.class_name() == "ShapeGroupPlugin"]


def lets_light_through(scene: mi.Scene) -> bool:
    """Return True if an ordinary shape of `scene` has a BSDF with a null component, which light can cross."""
    groups = [] if _hold_fields_alone(scene) else shape_groups(scene)
    return any(isinstance(node, mi.BSDF) and mi.has_flag(node.flags(), mi.BSDFFlags.Null)
               for shape in groups + ordinary_shapes(scene) for node in traverse(shape).hierarchy)


def _is_absent(shape: mi.Shape) -> bool:
    """Return True if a shape neither scatters light nor emits it."""
    simple = shape.class_name() != "Instance" and not shape.is_emitter()
    return simple and str(shape.bsdf().class_name()) == "Null"


def _shapes_of(group: mi.Shape) -> list[mi.Shape]:
    """Return the shapes inside a shape group."""
    return [node for node in traverse(group).hierarchy if isinstance(node, mi.Shape) and node is not group]


def _grouped(scene: mi.Scene) -> list[mi.Shape]:
    """Return the shapes inside the shape groups of `scene`."""
    return [shape for group in shape_groups(scene) for shape in _shapes_of(group)]


def _hold_fields_alone(scene: mi.Scene) -> bool:
    """Return True if all shapes in the shape groups of `scene` bound ``nrf`` media."""
    return all(_nrf_medium(shape) is not None for shape in _grouped(scene))


def _nrf_medium(shape: mi.Shape) -> NRFMedium | None:
    medium = shape.interior_medium() if shape.is_medium_transition() else None
    return cast(NRFMedium, medium) if getattr(medium, "is_nrf", False) else None


def _check_bounds(medium: NRFMedium, shapes: Sequence[mi.Shape]) -> None:
    """Raise MiNtfError unless exactly one shape bounds `medium` and encloses its object."""
    origin, radius, low, high = _extent(medium)
    if len(shapes) > 1:
        raise MiNtfError(
            f"{len(shapes)} bounding shapes ({', '.join(map(_label, shapes))}) share one nrf medium ({medium.path}), "
            f"which is at one place, {_text(origin)}, by <ref> or since Mitsuba merges media of the same text; give "
            "each shape a medium of its own with its own to_world, or take the other shapes out"
        )
    (shape,) = shapes
    _check_bsdf(shape)
    box = shape.bbox()
    if not _encloses(shape, medium):
        raise MiNtfError(
            f"bounding {_label(shape)} spans {_text(box.min)} to {_text(box.max)}, but the nrf medium inside it "
            f"({medium.path}) has its object from {_text(low)} to {_text(high)}; give shape and medium the same "
            f"placement (a sphere of centre {_text(origin)} and radius {radius:.4g} fits)"
        )


def _instanced(scene: mi.Scene) -> list[NRFMedium]:
    """Return the fields of all instances of shape groups. Raises MiNtfError if a group holds other shapes, too."""
    fields = {group.id(): [shape for shape in _shapes_of(group) if _nrf_medium(shape)] for group in shape_groups(scene)}
    result: list[NRFMedium] = []
    for instance in scene.shapes() if any(fields.values()) else ():
        if instance.class_name() != "Instance":
            continue
        shapes = fields[_group_name(instance)]
        to_world = np.array(mi.traverse(instance)["to_world"].matrix, np.float64).reshape(4, 4)
        for shape in shapes:
            medium = cast(NRFMedium, _nrf_medium(shape))
            _check_group(scene, shape, medium)
            result.append(cast(NRFMedium, InstancedMedium(medium, medium.frame.moved(to_world))))
    return result


def _group_name(instance: mi.Shape) -> str:
    """Return the id of the group of an instance, which Mitsuba shows in its text alone."""
    name = re.search(r'name = "([^"]*)"', str(instance))
    return name[1] if name else ""


def _check_group(scene: mi.Scene, shape: mi.Shape, medium: NRFMedium) -> None:
    """Raise MiNtfError unless `shape`, in a group, bounds a field as it could outside, and groups hold fields alone."""
    if not _hold_fields_alone(scene):
        raise MiNtfError(
            f"nrf integrator: {_label(shape)} bounds an nrf medium in a shapegroup, beside other shapes; groups may "
            "hold fields or other shapes, but not both: give the field a group and instances of its own"
        )
    _check_bounds(medium, [shape])


def _extent(medium: NRFMedium) -> tuple[np.ndarray, float, np.ndarray, np.ndarray]:
    """Return the centre and radius of the field's sphere, and the corners of the box of its object, in the scene."""
    corners = np.stack(np.meshgrid(*zip(*medium.field.grid.bounds, strict=True), indexing="ij"), -1).reshape(-1, 3)
    # All matter is in the unit sphere, from which the corners of the box may protrude.
    origin, radius = medium.frame.origin, medium.frame.length
    world = origin + radius * corners @ medium.frame.rotation.T
    return origin, radius, np.maximum(world.min(0), origin - radius), np.minimum(world.max(0), origin + radius)


def _encloses(shape: mi.Shape, medium: NRFMedium) -> bool:
    """Return True if the box of `shape` contains the object of `medium`."""
    _, radius, low, high = _extent(medium)
    box, slack = shape.bbox(), 0.01 * radius
    inside = (np.array(box.min).ravel() <= low + slack) & (np.array(box.max).ravel() >= high - slack)
    return bool(inside.all())


def _label(shape: mi.Shape) -> str:
    """Return the name of a shape in messages: its id, or its class and centre."""
    return f'shape "{shape.id()}"' if shape.id() else f"{shape.class_name()} at {_text(shape.bbox().center())}"


def _check_bsdf(shape: mi.Shape) -> None:
    """Raise MiNtfError unless rays cross a bounding shape as if it were absent."""
    flags, names = shape.bsdf().flags(), ("Diffuse", "Glossy", "DeltaReflection", "DeltaTransmission")
    if any(mi.has_flag(flags, getattr(mi.BSDFFlags, name)) for name in names):
        raise MiNtfError(
            f"bounding {_label(shape)} has a {shape.bsdf().class_name()} BSDF, but a shape that bounds a "
            'medium is no surface; give it <bsdf type="null"/> (the default is diffuse), and add a surface such as '
            "glass as a shape of its own around it"
        )


def _text(v: object) -> str:
    return "(" + ", ".join(f"{float(c):.4g}" for c in np.array(v).ravel()) + ")"

"""The ``nrf`` media of a scene, the shapes that bound them, and all others."""

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError


def find_media(scene) -> list:
    """The scene's ``nrf`` media. Raises MiNtfError where there is none, or a bounding shape is wrong or in a group."""
    media: list = []
    bounds: list[list] = []
    for shape in scene.shapes():
        medium = _nrf_medium(shape)
        if medium is None:
            continue
        if not any(medium is m for m in media):
            media.append(medium)
            bounds.append([])
        bounds[next(i for i, m in enumerate(media) if m is medium)].append(shape)
    for shape in _grouped(scene):
        if _nrf_medium(shape) is not None:
            raise MiNtfError(
                f"nrf integrator: {_called(shape)} bounds an nrf medium inside a shapegroup, but fields cannot be "
                "instanced; take the shape out of the group, and give each other place a shape and a medium of its own"
            )
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
    """Return the shapes that rays can meet: all but the bounds of ``nrf`` media and those of a ``null`` BSDF that do
    not shine. Raises MiNtfError where one holds another medium."""
    shapes = [s for s in scene.shapes() if _nrf_medium(s) is None and not _is_absent(s)]
    for shape in shapes + _grouped(scene):
        if shape.is_medium_transition():
            raise MiNtfError(
                f"nrf integrator: {_called(shape)} bounds a medium that is no nrf medium, which this integrator does "
                "not see; remove the medium, or render the scene with volpath"
            )
    return shapes


def shape_groups(scene) -> list:
    """Return the ``shapegroup`` objects of `scene`, which its list of shapes leaves out."""
    return [node for node in mi.traverse(scene).hierarchy if node.class_name() == "ShapeGroupPlugin"]


def lets_light_through(scene) -> bool:
    """Return True if light may cross an ordinary shape of `scene` at the null component of its BSDF."""
    return any(isinstance(node, mi.BSDF) and mi.has_flag(node.flags(), mi.BSDFFlags.Null)
               for shape in shape_groups(scene) + ordinary_shapes(scene) for node in mi.traverse(shape).hierarchy)


def _is_absent(shape) -> bool:
    """Return True if a shape neither scatters light nor emits it."""
    simple = shape.class_name() != "Instance" and not shape.is_medium_transition() and not shape.is_emitter()
    return simple and shape.bsdf().class_name() == "Null"


def _grouped(scene) -> list:
    """Return the shapes inside the shape groups of `scene`."""
    return [node for group in shape_groups(scene) for node in mi.traverse(group).hierarchy if isinstance(node, mi.Shape)
            and node is not group]


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

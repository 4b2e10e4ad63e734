"""Scene that the virtual camera photographs: the chosen shapes, and an integrator that sees them."""

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mi_ntf.core import scene_shapes
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.scene_shapes import SceneShape
from mi_ntf.core.variants import VARIANTS, enough_threads
from mi_ntf.data.poses import view_directions

if TYPE_CHECKING:
    import mitsuba as mi

POSITIONS = "vertex_positions", "positions"  # parameter of a mesh until Mitsuba 3.9, and from 3.10 on
SURFACE_INTEGRATORS = {"PathIntegrator", "DirectIntegrator"}
VOLUME_INTEGRATORS = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl"}  # class names of volpath and volpathmis


@dataclass
class Subject:
    """Shapes to photograph, groups of which they may be instances, an integrator that sees them, and notes on them."""

    shapes: "list[mi.Shape]"
    groups: "list[mi.Object]"
    integrator: "mi.Integrator"
    notes: list[str]


def load(path: Path, choice: str = "", parameters: dict[str, str] | None = None) -> Subject:
    """Return what is photographed of a scene: the shapes that `choice` names, "" for all that reflect light.

    `parameters` are values of the scene's $names. The integrator is the scene's own if it is a path tracer, a
    volumetric one for media; else `path` or `volpath` of depth 6.
    """
    import drjit as dr
    import mitsuba as mi

    enough_threads(dr)
    variant = mi.variant()
    if variant is None:
        mi.set_variant(*VARIANTS)
    elif "rgb" not in variant:
        raise MiNtfError(f"variant '{variant}' is active; photographs are linear RGB: set an rgb variant "
                         "such as llvm_ad_rgb")
    if not Path(path).is_file():
        raise MiNtfError(f"{path} does not exist; name a Mitsuba scene file (.xml)")
    scene, entries = _scene(path, choice, parameters or {})
    shapes = [shape for shape in scene.shapes() if not (shape.is_emitter() or shape.is_sensor())]
    if not shapes:
        raise MiNtfError(f"{path}: no shapes that reflect light ({len(scene.shapes())} emitters); "
                         "add the object to photograph")
    around = [shape.id() for shape in shapes if shape.exterior_medium()]
    if around:
        raise MiNtfError(f"{path}: shape '{around[0]}' has an exterior medium, in which the cameras would stand; give "
                         "the medium to a bounding shape as its interior")
    media = any(shape.interior_medium() for shape in shapes)
    integrator = scene.integrator()
    if integrator is None or integrator.class_name() not in VOLUME_INTEGRATORS | (set() if media else
                                                                                   SURFACE_INTEGRATORS):
        integrator = mi.load_dict({"type": "volpath" if media else "path", "max_depth": 6, "hide_emitters": True})
    shapes.sort(key=lambda shape: (fingerprint(shape), shape.id()))  # Mitsuba's order is chance
    groups = [node for node in mi.traverse(scene).hierarchy if node.class_name() == "ShapeGroupPlugin"]
    return Subject(shapes, groups, integrator, _notes(shapes, entries, choice))


def _scene(path: Path, choice: str, parameters: dict[str, str]) -> "tuple[mi.Scene, list[SceneShape]]":
    """Load a scene without the objects that `choice` leaves out. Also return all its shapes, with names as ids."""
    import mitsuba as mi

    api: Any = mi  # whose stubs lack some of this
    parser = api.parser
    config, before = parser.ParserConfig(str(mi.variant())), api.file_resolver()
    config.merge_meshes = False  # they would lose their names
    resolver = api.FileResolver(before)
    resolver.prepend(str(path.parent))
    api.set_file_resolver(resolver)
    try:
        state = parser.parse_file(config, str(path), **parameters)
        if state.root.type != mi.ObjectType.Scene:
            raise MiNtfError(f"{path}: holds a {state.root.props.plugin_name()}, not a scene; the root element must be "
                             "<scene>")
        parser.transform_upgrade(config, state)
        parser.transform_resolve(config, state)
        leaves = _take_shapes(state, state.root)
        entries = [_entry(state, state.nodes[leaf]) for leaf in leaves]
        objects = iter(scene_shapes.named([entry for entry in entries if not entry.holds]))
        entries = [entry if entry.holds else next(objects) for entry in entries]
        names = [entry.name for entry in entries if not entry.holds]
        chosen = iter(scene_shapes.choose(choice, names))
        for leaf, entry in zip(leaves, entries, strict=True):
            if entry.holds or next(chosen):
                state.nodes[leaf].props.set_id(entry.name or entry.id)
                state.root.props[f"shape_{leaf}"] = mi.Properties.ResolvedReference(leaf)
        parser.transform_merge_equivalent(config, state)
        scene = parser.instantiate(config, state)
    finally:
        api.set_file_resolver(before)
    assert isinstance(scene, mi.Scene)
    return scene, entries


def _take_shapes(state: Any, parent: Any) -> list[int]:
    """Remove shapes from a node, and return the numbers of their nodes. Those of a ``merge`` are taken one by one.

    Groups stay. They are invisible without their instances.
    """
    import mitsuba as mi

    leaves = []
    for key in list(parent.props):
        reference = parent.props[key]
        if isinstance(reference, mi.Properties.ResolvedReference):
            node = state.nodes[reference.index()]
            if node.type == mi.ObjectType.Shape and node.props.plugin_name() != "shapegroup":
                del parent.props[key]
                leaves += _take_shapes(state, node) if node.props.plugin_name() == "merge" else [reference.index()]
    return leaves


def _entry(state: Any, node: Any) -> SceneShape:
    """Return a shape's entry in the list of shapes."""
    import mitsuba as mi

    values = [node.props[key] for key in node.props]
    parts = [state.nodes[value.index()].type for value in values if isinstance(value, mi.Properties.ResolvedReference)]
    holds = "emitter" if mi.ObjectType.Emitter in parts else "sensor" if mi.ObjectType.Sensor in parts else ""
    file = str(node.props["filename"]) if "filename" in node.props else ""
    return SceneShape(node.props.plugin_name(), node.props.id(), file, holds)


def _notes(shapes: "list[mi.Shape]", entries: list[SceneShape], choice: str) -> list[str]:
    """Return lines on what is photographed, and a warning if that includes a floor without the user's choice."""
    by_name = {entry.name: entry for entry in entries if entry.name}
    taken = [by_name[shape.id()] for shape in shapes if shape.id() in by_name]
    rest = [entry for entry in entries if entry not in taken]
    text = f"photographed: {scene_shapes.listed([entry for entry in entries if entry in taken])}"
    notes = [f"{text}; left out: {scene_shapes.listed(rest)}" if rest else text]
    if not choice:
        boxes = [shape.bbox() for shape in shapes if shape.id() in by_name]
        low, high = (np.array([np.array(corner).ravel() for corner in corners], np.float64).reshape(-1, 3)
                     for corners in ([box.min for box in boxes], [box.max for box in boxes]))
        notes += filter(None, [scene_shapes.warning(taken, low, high)])
    return notes


def outline(shapes: "list[mi.Shape]") -> np.ndarray:
    """Return points (P, 3) whose hull contains every shape.

    They are the vertices of meshes, points all over spheres (within 0.5 %), and the box corners of all other shapes.
    Media count by the shapes that bound them.
    """
    import mitsuba as mi

    points = []
    for shape in shapes:
        params = mi.traverse(shape)
        positions = next((name for name in POSITIONS if name in params), None)
        if positions:  # a rectangle calls itself a mesh and has none
            points.append(np.array(params[positions]).reshape(-1, 3))
        elif shape.shape_type() == int(mi.ShapeType.Sphere):
            to_world = np.array(params["to_world"].matrix).reshape(4, 4)
            lattice = view_directions(1000, np.random.default_rng(0))
            points.append(lattice @ to_world[:3, :3].T + to_world[:3, 3])
        else:
            points.append(np.array([np.array(shape.bbox().corner(i)).ravel() for i in range(8)]))
    return np.concatenate(points).astype(np.float64)


def fingerprint(thing: "mi.Object") -> str:
    """Return a hash of all parameters (vertices, materials) of a Mitsuba object."""
    import mitsuba as mi

    digest = hashlib.sha256()
    for key, value in sorted(mi.traverse(thing), key=lambda item: item[0]):
        digest.update(key.encode())
        digest.update(np.array(value).tobytes() if hasattr(value, "__len__") else repr(value).encode())
    return digest.hexdigest()[:16]

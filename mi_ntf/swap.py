"""`mi-ntf swap`: copy of a scene in which a field replaces the meshes. It works on XML alone."""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from xml.etree import ElementTree as ET

from mi_ntf import scene_xml
from mi_ntf.core import files, scene_shapes
from mi_ntf.core.architecture import Similarity
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.field_file import load_header
from mi_ntf.core.scene_shapes import SceneShape

_DEPTHS = dict.fromkeys(("path", "volpath", "volpathmis", "ptracer"), -1) | dict.fromkeys(
    ("prb", "prb_basic", "prb_projective", "prbvolpath"), 6)
"""Default `max_depth` of Mitsuba's integrators; −1 is no limit. The default of ``nrf`` is 2."""
_AOVS = {"depth": "depth", "albedo": "albedo", "sh_normal": "normal", "geo_normal": "normal"}
"""Output of ``nrf`` for each type of Mitsuba's integrator ``aov``."""

REFERENCES = "ref", "alias"
"""Elements whose `id` is that of another element."""


@dataclass(frozen=True)
class Swapped:
    """Things of a scene that a field has replaced, those that stay, and sentences about others that were left out."""

    replaced: list[str]
    unchanged: list[str]
    notes: list[str]

    def __str__(self) -> str:
        return f"replaced: {scene_shapes.listed(self.replaced)}; kept: {scene_shapes.listed(self.unchanged)}"


def swap(scene: Path, field: Path, out: Path, shapes: str = "", parameters: dict[str, str] | None = None) -> Swapped:
    """Write a copy of a scene in which a field replaces shapes.

    `shapes` chooses them as the option ``--shapes`` does: by names, by ``not:`` and names, or all ("" by default).
    Shapes that emit light or hold a sensor stay. `parameters` become the defaults of $names. The field sits in one
    bounding ``sphere``, "field", with a ``null`` BSDF and the centre and radius of the capture. An integrator other
    than ``nrf`` becomes ``nrf`` with ``<default name="visibility" value="auto"/>``. It keeps `hide_emitters`, the
    channels of ``aov`` that ``nrf`` has, and `max_depth`, also where it was the old integrator's default.

    Sensors, films, emitters, parameters and includes stay. An include that holds shapes or the integrator is inlined,
    with the defaults of ``$parameters`` in its name. BSDFs, textures and groups that nothing refers to any more are
    dropped, and comments. Paths are rewritten for `out`'s folder, which is searched before the working folder.

    Raises MiNtfError if `scene` is no Mitsuba XML or has no shape to replace, or an include is missing.
    """
    scene, field, out = Path(scene), Path(field), Path(out)
    similarity = load_header(field).similarity
    if out.resolve() == scene.resolve():
        raise MiNtfError(f"{out} is the mesh scene itself; choose another name for the scene with the field")
    root = scene_xml.parse(scene)
    scene_xml.set_defaults(root, parameters or {})
    content = _Content(root, scene)
    sphere = _bounding_sphere(similarity, scene_xml.relative(field, out.parent))
    replaced, unchanged = content.replace(shapes, sphere)
    sphere.set("id", content.free_name("field"))
    notes = _replace_integrator(root, content.defaults)
    content.drop_unused()
    scene_xml.move_paths(root, scene.parent, out.parent, content.defaults, sphere.find("medium/string"))
    root.insert(0, ET.Comment(f" The meshes of {scene.name} as the field {field.name}; written by `mi-ntf swap`. "))
    ET.indent(root, "    ")
    files.make_folder(out.parent)
    files.write(out, ET.tostring(root, encoding="unicode") + "\n")
    return Swapped(replaced, unchanged, notes)


class _Content:
    """Elements of a scene, with those of its includes that hold shapes or the integrator."""

    def __init__(self, root: ET.Element, scene: Path):
        self.root, self.scene = root, scene
        self.defaults = {d.get("name", ""): d.get("value", "") for d in root.iter("default")}
        self.includes = scene_xml.Includes(scene.parent, self.defaults)
        self.includes.inline(root, scene, lambda content: content.find("integrator") is not None or any(
            not shape.holds for _, _, shape in self._shapes(content)))

    def replace(self, choice: str, new: ET.Element) -> tuple[list[str], list[str]]:
        """Put `new` in place of the chosen shapes. Return descriptions of these, and of what stays."""
        entries = list(self._shapes(self.root))
        objects = [entry for entry in entries if not entry[2].holds]
        if not objects:
            raise MiNtfError(f"{self.scene} has no shape that a field could replace (emitters stay); give the scene "
                             "that `mi-ntf capture` photographed")
        shapes = scene_shapes.named([shape for _, _, shape in objects])
        chosen = scene_shapes.choose(choice, [shape.name for shape in shapes])
        removed = [shape for (_, shape, _), yes in zip(objects, chosen, strict=True) if yes]
        first = next(i for i, child in enumerate(self.root) if removed[0] in child.iter())
        self.root.insert(first, new)
        for (parent, shape, _), yes in zip(objects, chosen, strict=True):
            if yes:
                parent.remove(shape)
        self._remove_empty(self.root)
        self._lift(removed, first)
        replaced, unchanged = ([str(shape) for shape, yes in zip(shapes, chosen, strict=True) if yes is is_new]
                          for is_new in (True, False))
        return replaced, unchanged + self._lights()

    def free_name(self, name: str) -> str:
        """Return `name`, or with a number if an element of the scene has that id."""
        taken = {self._value(e.get("id", "")) for tree in (self.root, *self.includes.reached(self.root))
                 for e in tree.iter()}
        return next(n for n in chain([name], (f"{name}_{i}" for i in count(2))) if n not in taken)

    def drop_unused(self) -> None:
        """Drop definitions that neither the scene nor its includes refer to, until all are used."""
        groups = [e for e in self.root if e.get("type") == "shapegroup"]
        while True:
            used = self._references()
            unused = [e for e in self.root if (e.tag in ("bsdf", "texture") or e in groups)
                      and not any(used(inner.get("id", "")) for inner in e.iter() if inner.tag not in REFERENCES)]
            if not unused:
                return
            for element in unused:
                self.root.remove(element)

    def _shapes(self, parent: ET.Element) -> Iterator[tuple[ET.Element, ET.Element, SceneShape]]:
        """Yield the shapes below `parent`, each with its parent. Those of a ``merge`` count one by one.

        A shapegroup is none: it is invisible without its instances.
        """
        lights = {e.get("id") for tree in (self.root, *self.includes.reached(self.root)) for e in tree.iter("emitter")}
        for element in parent.findall("shape"):
            kind = self._value(element.get("type", ""))
            if kind == "merge":
                yield from self._shapes(element)
            elif kind != "shapegroup":
                content = (element, *self.includes.reached(element))
                shines = any(tree.find("emitter") is not None or any(self._value(r.get("id", "")) in lights for r in
                                                                      tree.findall("ref")) for tree in content)
                sees = any(tree.find("sensor") is not None for tree in content)
                file = next((e.get("value", "") for e in element.findall("string[@name='filename']")), "")
                yield parent, element, SceneShape(kind, self._value(element.get("id", "")), self._value(file),
                                                  "emitter" if shines else "sensor" if sees else "")

    def _lights(self) -> list[str]:
        """Return descriptions of the shapes that no field replaces, and of the emitters."""
        trees = [self.root]
        for include in self.root.findall("include"):
            trees += self.includes.reached(include, every=False)
        shapes = [str(shape) for tree in trees for _, _, shape in self._shapes(tree) if shape.holds]
        emitters = [(self._value(e.get("id", "")), self._value(e.get("type", "")))
                    for tree in trees for e in tree.findall("emitter")]
        return shapes + [f"{name} ({kind})" if name else kind for name, kind in emitters]

    def _remove_empty(self, parent: ET.Element) -> None:
        """Remove shapes of type ``merge`` that hold no shape any more."""
        for merge in parent.findall("shape[@type='merge']"):
            self._remove_empty(merge)
            if merge.find("shape") is None and merge.find("include") is None:
                parent.remove(merge)

    def _lift(self, removed: list[ET.Element], index: int) -> None:
        """Insert the parts of `removed` shapes to which other elements refer at the root's place `index`."""
        while True:
            used = self._references()
            there = {e.get("id") for e in self.root.iter() if e.tag not in REFERENCES}
            parts = [e for shape in removed for e in shape.iter() if e is not shape and e.tag not in REFERENCES]
            missing = [e for e in parts if used(e.get("id", "")) and e.get("id") not in there]
            if not missing:
                return
            missing[0].attrib.pop("name", None)
            self.root.insert(index, missing[0])

    def _references(self) -> Callable[[str], bool]:
        """Return a function that is true of the ids that a <ref> or <alias> may name, with any $parameters."""
        trees = (self.root, *self.includes.reached(self.root))
        names = {e.get("id", "") for tree in trees for e in tree.iter() if e.tag in REFERENCES}
        patterns = [scene_xml.pattern(name) for name in names if "$" in name]
        return lambda name: bool(name) and (name in names or any(p.fullmatch(name) for p in patterns))

    def _value(self, text: str) -> str:
        return scene_xml.substitute(text, self.defaults)

def _bounding_sphere(similarity: Similarity, filename: str) -> ET.Element:
    shape = ET.Element("shape", type="sphere")
    x, y, z = (repr(c) for c in similarity.center)
    ET.SubElement(shape, "point", name="center", x=x, y=y, z=z)
    ET.SubElement(shape, "float", name="radius", value=repr(similarity.radius))
    ET.SubElement(shape, "bsdf", type="null")
    medium = ET.SubElement(shape, "medium", type="nrf", name="interior")
    ET.SubElement(medium, "string", name="filename", value=filename)
    return shape


def _replace_integrator(root: ET.Element, defaults: dict[str, str]) -> list[str]:
    """Put the ``nrf`` integrator in place of the old one, and the default of its parameter at the top.

    Returns sentences about what cannot be kept.
    """
    if any(scene_xml.substitute(e.get("type", ""), defaults) == "nrf" for e in root.findall("integrator")):
        return []  # of the scene of another field
    new = ET.Element("integrator", type="nrf")
    ET.SubElement(new, "string", name="visibility", value="$visibility")
    old = root.findall("integrator")
    place = list(root).index(old[0]) if old else 0
    for tag, name in (("integer", "max_depth"), ("boolean", "hide_emitters")):
        new.extend([e for i in old for e in i.iter(tag) if e.get("name") == name][:1])
    nested = [e for i in old for e in i.iter("integrator")]
    types = [scene_xml.substitute(e.get("type", ""), defaults) for e in nested]
    depths = [_DEPTHS[t] for t in types if t in _DEPTHS]
    if depths and new.find("integer[@name='max_depth']") is None:
        ET.SubElement(new, "integer", name="max_depth", value=str(depths[0]))
    known, unknown = _outputs([e for e, t in zip(nested, types, strict=True) if t == "aov"], defaults)
    if known:
        ET.SubElement(new, "string", name="aovs", value=", ".join(known))
    for integrator in old:
        root.remove(integrator)
    root.insert(place, new)
    for default in root.findall("default"):
        if default.get("name") == "visibility":
            root.remove(default)
    root.insert(0, ET.Element("default", name="visibility", value="auto"))
    note = f"left out {', '.join(unknown)} of the integrator aov: nrf has {', '.join(dict.fromkeys(_AOVS.values()))}"
    return [note] if unknown else []


def _outputs(aov: list[ET.Element], defaults: dict[str, str]) -> tuple[list[str], list[str]]:
    """Return the outputs of ``nrf`` for the channels of the integrators `aov`, and the channels that have none."""
    texts = [scene_xml.substitute(e.get("value", ""), defaults) for i in aov for e in i.findall("string[@name='aovs']")]
    channels = [word for text in texts for word in re.split(r"[,\s]+", text) if word]
    kinds = [channel.rpartition(":")[2] for channel in channels]
    known = list(dict.fromkeys(_AOVS[kind] for kind in kinds if kind in _AOVS))
    return known, [channel for channel, kind in zip(channels, kinds, strict=True) if kind not in _AOVS]

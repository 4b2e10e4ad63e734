"""`mi-ntf swap`: copy of a scene in which a field replaces the meshes. It works on XML alone."""

import os
import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat

from mi_ntf.core import files
from mi_ntf.core.architecture import Similarity
from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.core.field_file import load_header

_PARAMETER = re.compile(r"(?<!\\)\$(\w+)")
_CAMEL = re.compile(r"(?<=[a-z])[A-Z]+")
_DEPTHS = dict.fromkeys(("path", "volpath", "volpathmis", "ptracer"), -1) | dict.fromkeys(
    ("prb", "prb_basic", "prb_projective", "prbvolpath"), 6)
"""Default `max_depth` of Mitsuba's integrators; −1 is no limit. The default of ``nrf`` is 2."""
_AOVS = {"depth": "depth", "albedo": "albedo", "sh_normal": "normal", "geo_normal": "normal"}
"""Output of ``nrf`` for each type of Mitsuba's integrator ``aov``."""


def swap(scene: Path, field: Path, out: Path) -> list[str]:
    """Write a copy of a scene in which a field replaces all shapes but emitters and sensors.

    The field sits in one bounding ``sphere`` with a ``null`` BSDF, with the centre and radius of the capture. The
    integrator becomes ``nrf`` with ``<default name="visibility" value="auto"/>``. It keeps `hide_emitters`, the
    channels of ``aov`` that ``nrf`` has, and `max_depth`, also where it was the old integrator's default.

    Sensors, films, emitters, parameters and includes stay. An include that holds shapes or the integrator is inlined,
    with the defaults of ``$parameters`` in its name. Unused BSDFs and textures, and comments, are dropped. Paths are
    rewritten for `out`'s folder, which is searched before the working folder.

    Returns sentences about other things that were left out. Raises MiNtfError if `scene` is no Mitsuba XML or has no
    shape to replace, or an include is missing.
    """
    scene, field, out = Path(scene), Path(field), Path(out)
    similarity = load_header(field).similarity
    if out.resolve() == scene.resolve():
        raise MiNtfError(f"{out} is the mesh scene itself; choose another name for the scene with the field")
    root = parse(scene)
    defaults = {d.get("name", ""): d.get("value", "") for d in root.iter("default")}
    inline(root, scene, scene.parent, defaults, lambda content: bool(_replaceable(content)) or
           content.find("integrator") is not None)
    root.insert(_remove_shapes(root, scene), _bounding_sphere(similarity, os.path.relpath(field, out.parent)))
    notes = _replace_integrator(root, defaults)
    _drop_unused(root, scene.parent, defaults)
    move_paths(root, scene.parent, out.parent, defaults, root.find("shape/medium[@type='nrf']/string"))
    root.insert(0, ET.Comment(f" The meshes of {scene.name} as the field {field.name}; written by `mi-ntf swap`. "))
    ET.indent(root, "    ")
    files.make_folder(out.parent)
    files.write(out, ET.tostring(root, encoding="unicode") + "\n")
    return notes


def parse(path: Path) -> ET.Element:
    """Return the <scene> of an XML file, with names of properties as in Mitsuba since version 2.

    Raises MiNtfError if there is none, or if the file declares entities. Mitsuba does not read entities, and a few
    lines of them can fill the memory.
    """
    if not path.is_file():
        raise MiNtfError(f"scene {path} does not exist; give the XML file of a mesh scene")

    def refuse(name: str, *_: object) -> None:
        raise MiNtfError(f"{path} declares the entity {shown(name)}, which Mitsuba does not read; write its text")

    content, checker = path.read_bytes(), expat.ParserCreate()
    checker.EntityDeclHandler = refuse
    try:
        checker.Parse(content, True)
        root = ET.fromstring(content)
    except (expat.ExpatError, ET.ParseError) as error:
        raise MiNtfError(f"{path} is not XML ({error}); give the XML file of a Mitsuba scene") from None
    if root.tag != "scene":
        raise MiNtfError(f"{path}: root element is <{root.tag}>, expected <scene>; give the XML of a Mitsuba scene")
    _rename(root)
    return root


def _rename(root: ET.Element) -> None:
    """Rename properties of files for Mitsuba 0.6 and older, as ``maxDepth`` to ``max_depth``, by Mitsuba's rule."""
    if not re.match(r"[01]\.", root.get("version", "")):
        return
    for element in root.iter():
        if element.tag != "default" and (name := element.get("name")):
            element.set("name", _CAMEL.sub(lambda m: "_" + m[0].lower(), name))


def _resolve(include: ET.Element, source: Path, folder: Path, defaults: dict[str, str]) -> Path:
    """Return the file that `include` of the scene file `source` names, with the defaults of parameters.

    Mitsuba looks beside the including file first, then in the folder of the main scene.
    """
    name = substitute(include.get("filename", ""), defaults)
    for base in (source.parent, folder):
        if (base / name).is_file():
            return base / name
    hint = "; give its $parameters a <default>" if "$" in name else ""
    raise MiNtfError(f"{source}: included file {name!r} does not exist beside it{hint}")


def substitute(text: str, defaults: dict[str, str]) -> str:
    """Return `text` with the values of its $parameters."""
    return _PARAMETER.sub(lambda m: defaults.get(m[1], m[0]), text)


def inline(root: ET.Element, source: Path, folder: Path, defaults: dict[str, str],
           is_needed: Callable[[ET.Element], bool]) -> None:
    """Replace includes of `root`, the content of the file `source`, by their content where `is_needed` is true of it.

    `folder` is that of the main scene, `defaults` are the values of its $parameters, to which those of includes are
    added.
    """
    for include in root.findall("include"):
        path = _resolve(include, source, folder, defaults)
        content = parse(path)
        for d in content.iter("default"):
            defaults.setdefault(d.get("name", ""), d.get("value", ""))
        inline(content, path, folder, defaults, is_needed)
        position = list(root).index(include)
        if is_needed(content):
            root.remove(include)
            for offset, child in enumerate(content):
                root.insert(position + offset, child)
        else:
            # The include moves from `source` to the main scene, so its path becomes relative to that folder.
            name = include.get("filename", "")
            include.set("filename", os.path.relpath(source.parent / name, folder) if not os.path.isabs(name) else name)


def _replaceable(root: ET.Element) -> list[ET.Element]:
    """Return the top-level shapes that are neither emitters nor sensors."""
    lights = {e.get("id") for e in root.findall("emitter")} - {None}
    return [s for s in root.findall("shape") if s.find("emitter") is None and s.find("sensor") is None
            and not any(r.get("id") in lights for r in s.findall("ref"))]


def _remove_shapes(root: ET.Element, scene: Path) -> int:
    """Remove the shapes that the field replaces, and return the index of the first among the root's children."""
    shapes = _replaceable(root)
    if not shapes:
        raise MiNtfError(f"{scene} has no shape that a field could replace (emitters stay); give the scene that "
                         "`mi-ntf capture` photographed")
    index = list(root).index(shapes[0])
    for shape in shapes:
        root.remove(shape)
    return index


def _bounding_sphere(similarity: Similarity, filename: str) -> ET.Element:
    shape = ET.Element("shape", type="sphere")
    x, y, z = (repr(c) for c in similarity.center)
    ET.SubElement(shape, "point", name="center", x=x, y=y, z=z)
    ET.SubElement(shape, "float", name="radius", value=repr(similarity.radius))
    ET.SubElement(shape, "bsdf", type="null")
    medium = ET.SubElement(shape, "medium", type="nrf", name="interior")
    ET.SubElement(medium, "string", name="filename", value=Path(filename).as_posix())
    return shape


def _replace_integrator(root: ET.Element, defaults: dict[str, str]) -> list[str]:
    """Put the ``nrf`` integrator in place of the old one, and the default of its parameter at the top.

    Returns sentences about what cannot be kept.
    """
    new = ET.Element("integrator", type="nrf")
    ET.SubElement(new, "string", name="visibility", value="$visibility")
    old = root.findall("integrator")
    place = list(root).index(old[0]) if old else 0
    for tag, name in (("integer", "max_depth"), ("boolean", "hide_emitters")):
        new.extend([e for i in old for e in i.iter(tag) if e.get("name") == name][:1])
    nested = [e for i in old for e in i.iter("integrator")]
    types = [substitute(e.get("type", ""), defaults) for e in nested]
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
    texts = [substitute(e.get("value", ""), defaults) for i in aov for e in i.findall("string[@name='aovs']")]
    channels = [word for text in texts for word in re.split(r"[,\s]+", text) if word]
    kinds = [channel.rpartition(":")[2] for channel in channels]
    known = list(dict.fromkeys(_AOVS[kind] for kind in kinds if kind in _AOVS))
    return known, [channel for channel, kind in zip(channels, kinds, strict=True) if kind not in _AOVS]


def _drop_unused(root: ET.Element, folder: Path, defaults: dict[str, str]) -> None:
    """Drop definitions that neither the scene nor its includes refer to, until all are used."""
    included = [parse(_resolve(i, folder / "scene.xml", folder, defaults)) for i in root.findall("include")]
    while True:
        used = {r.get("id") for tree in (root, *included) for r in tree.iter("ref")}
        used |= {a.get("id") for a in root.iter("alias")}
        unused = [e for e in root if e.tag in ("bsdf", "texture") and e.get("id") not in used]
        if not unused:
            return
        for element in unused:
            root.remove(element)


def move_paths(root: ET.Element, old: Path, new: Path, defaults: dict[str, str],
               moved: ET.Element | None = None) -> None:
    """Rewrite relative paths of the folder `old` for the folder `new`, except that of the element `moved`."""
    if old.resolve() == new.resolve():
        _search_here_first(root)
        return
    nodes = [(e, "value") for e in root.iter("string") if e.get("name") == "filename"]
    nodes += [(e, "filename") for e in root.iter() if e.tag in ("include", "spectrum")]
    nodes += [(e, "value") for e in root.iter("path")]
    for element, attribute in nodes:
        value = element.get(attribute, "")
        # Other files are found by a <path>, which is rewritten itself.
        if element is not moved and not os.path.isabs(value) and (old / substitute(value, defaults)).exists():
            element.set(attribute, Path(os.path.relpath(old / value, new)).as_posix())
    if root.find("include") is not None:
        # Mitsuba looks for the files that an include names in the main scene's folder, so that folder stays known.
        root.insert(0, ET.Element("path", value=Path(os.path.relpath(old, new)).as_posix()))
    _search_here_first(root)


def _search_here_first(root: ET.Element) -> None:
    """Add the scene's folder as last path, which Mitsuba searches first.

    Otherwise it would search the working folder first, where another field may have the same name.
    """
    root.insert(len(root.findall("path")), ET.Element("path", value="."))

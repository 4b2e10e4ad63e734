"""Scene files as XML, without Mitsuba: parameters, includes, old versions and relative paths."""

import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from xml.etree import ElementTree as ET
from xml.parsers import expat

from mi_ntf.core.errors import MiNtfError, shown

_PARAMETER = re.compile(r"(?<!\\)\$(\w+)")
_CAMEL = re.compile(r"(?<=[a-z])[A-Z]+")


def parse(path: Path, included: bool = False) -> ET.Element:
    """Return the <scene> of an XML file, with names of properties as in Mitsuba since version 2.

    A file that is `included` may consist of another element, which is returned as the only child of a <scene>.
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
    if root.tag != "scene" and not included:
        raise MiNtfError(f"{path}: root element is <{root.tag}>, expected <scene>; give the XML of a Mitsuba scene")
    _upgrade(root)
    if root.tag != "scene":
        inner, root = root, ET.Element("scene", version=root.attrib.pop("version", ""))
        root.append(inner)
    return root


def _upgrade(root: ET.Element) -> None:
    """Bring the properties of a file for Mitsuba before version 2 to their present names, by Mitsuba's rules."""
    if not re.match(r"[01]\.", root.get("version", "")):
        return
    for element in root.iter():
        if element.tag != "default" and (name := element.get("name")):
            element.set("name", _CAMEL.sub(lambda m: "_" + m[0].lower(), name))
    for element in root.iter():
        for old in element.findall("*[@name='diffuse_reflectance']") if element.get("type") == "diffuse" else ():
            old.set("name", "reflectance")
        steps = {tag: {axis: old.get("value", "") for axis, letter in (("x", "u"), ("y", "v"))
                       for old in element.findall(f"float[@name='{letter}{name}']")}
                 for tag, name in (("translate", "offset"), ("scale", "scale"))}
        if any(steps.values()):
            for old in [e for e in element if e.get("name") in ("uoffset", "voffset", "uscale", "vscale")]:
                element.remove(old)
            transform = ET.SubElement(element, "transform", name="to_uv")
            transform.extend([ET.Element(tag, values) for tag, values in steps.items() if values])


def substitute(text: str, defaults: dict[str, str]) -> str:
    """Return `text` with the values of its $parameters."""
    return _PARAMETER.sub(lambda m: defaults.get(m[1], m[0]), text)


def pattern(text: str) -> re.Pattern[str]:
    """Return a pattern of what `text` may be with any values of its $parameters."""
    return re.compile(".*".join(map(re.escape, _PARAMETER.split(text)[::2])))


def set_defaults(root: ET.Element, values: dict[str, str]) -> None:
    """Make `values` the defaults of the $parameters with their names, above all else where there are none yet."""
    for name, value in values.items():
        defaults = [d for d in root.iter("default") if d.get("name") == name]
        for default in defaults[1:]:
            root.remove(default)
        if defaults:
            defaults[0].set("value", value)
        else:
            root.insert(0, ET.Element("default", name=name, value=value))


class Includes:
    """Files that a scene file in `folder` includes, found as Mitsuba finds them.

    `defaults` are the values of $parameters. Those of includes are added when they are read.
    """

    def __init__(self, folder: Path, defaults: dict[str, str]):
        self.folder, self.defaults = folder, defaults

    def inline(self, root: ET.Element, source: Path, is_needed: Callable[[ET.Element], bool],
               folders: tuple[Path, ...] = ()) -> None:
        """Replace includes of `root`, the content of the file `source`, by their content where `is_needed` is true.

        The includes that are left, and the <path>s of inlined files, become relative to the main scene's folder.
        `folders` are those in which the including file finds its includes.
        """
        folders = self._folders(root, source, folders)
        for parent in list(root.iter()):
            for include in parent.findall("include"):
                path = self._find(include, source, folders)
                content = self._parse(path)
                self.inline(content, path, is_needed, folders)
                if (parent is root or parent.get("type") == "merge") and is_needed(content):
                    position = list(parent).index(include)
                    parent[position : position + 1] = list(content)
                elif not os.path.isabs(name := include.get("filename", "")):
                    base = next(base for base in folders if (base / substitute(name, self.defaults)).is_file())
                    include.set("filename", relative(base / name, self.folder))
        if source.parent != self.folder:
            for element in root.findall("path"):
                element.set("value", relative(source.parent / element.get("value", ""), self.folder))

    def reached(self, root: ET.Element, every: bool = True, source: Path | None = None,
                folders: tuple[Path, ...] = (), seen: set[Path] | None = None) -> Iterator[ET.Element]:
        """Yield the contents of all includes in `root`, an element of the inlined main scene, and of theirs.

        With `every`, a name with $parameters stands for all scene files that it may name, else for that of the
        defaults. `source` and `folders` are given for included files, and `seen`, the files so far.
        """
        seen = set() if seen is None else seen
        source = source or self.folder / "scene.xml"
        folders = self._folders(root, source, folders)
        for include in root.iter("include"):
            path = self._find(include, source, folders)
            name = pattern(Path(include.get("filename", "")).name)
            for other in sorted(path.parent.iterdir()):
                if other == path or (every and other not in seen and name.fullmatch(other.name)):
                    seen.add(other)
                    try:
                        content = self._parse(other)
                    except MiNtfError:
                        if other == path:
                            raise
                        continue  # a name may fit other files than scenes
                    yield content
                    yield from self.reached(content, every, other, folders, seen)

    def _parse(self, path: Path) -> ET.Element:
        content = parse(path, included=True)
        for d in content.iter("default"):
            self.defaults.setdefault(d.get("name", ""), d.get("value", ""))
        return content

    def _folders(self, root: ET.Element, source: Path, others: tuple[Path, ...]) -> tuple[Path, ...]:
        """Return the folders in which includes of the file `source` are sought: its own, <path>s, and the `others`."""
        paths = [source.parent / substitute(p.get("value", ""), self.defaults) for p in reversed(root.findall("path"))]
        return source.parent, *paths, *(others or (self.folder,))

    def _find(self, include: ET.Element, source: Path, folders: tuple[Path, ...]) -> Path:
        name = substitute(include.get("filename", ""), self.defaults)
        for base in folders:
            if (base / name).is_file():
                return base / name
        hint = "; give its $parameters a <default>" if "$" in name else ""
        raise MiNtfError(f"{source}: included file {name!r} does not exist beside it{hint}")


def relative(place: Path, folder: Path) -> str:
    """Return the path of `place` from `folder`, with slashes; links among their folders are followed first."""
    place, folder = Path(place).absolute(), Path(folder).resolve()
    return Path(os.path.relpath(place.parent.resolve() / place.name, folder)).as_posix()


def move_paths(root: ET.Element, old: Path, new: Path, defaults: dict[str, str],
               moved: ET.Element | None = None) -> None:
    """Rewrite relative paths of the folder `old` for the folder `new`, except that of the element `moved`."""
    if old.resolve() == new.resolve():
        _search_here_first(root)
        return
    nodes = [(e, "value") for e in root.iter("string") if e.get("name") in ("filename", "map_file")]
    nodes += [(e, "filename") for e in root.iter() if e.tag in ("include", "spectrum")]
    nodes += [(e, "value") for e in root.iter("path")]
    for element, attribute in nodes:
        value = element.get(attribute, "")
        meant = substitute(value, defaults)
        # Other files are found by a <path>, which is rewritten itself.
        if element is not moved and not os.path.isabs(meant) and (old / meant).exists():
            element.set(attribute, relative(old / value, new))
    if root.find("include") is not None:
        # Mitsuba looks for the files that an include names in the main scene's folder, so that folder stays known.
        root.insert(0, ET.Element("path", value=relative(old, new)))
    _search_here_first(root)


def _search_here_first(root: ET.Element) -> None:
    """Make the scene's folder the last path, which Mitsuba searches first.

    Otherwise it would search the working folder first, where another field may have the same name.
    """
    for path in root.findall("path[@value='.']"):
        root.remove(path)
    root.insert(len(root.findall("path")), ET.Element("path", value="."))

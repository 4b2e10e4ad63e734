"""Environment maps of a view: the available files, and the exchange of one for another."""

import tempfile
from pathlib import Path

import mitsuba as mi

from mi_ntf import scene_xml
from mi_ntf.core.errors import MiNtfError

from .save import save
from .session import Session

ENDINGS = (".exr", ".hdr")


def beside(session: Session) -> list[Path]:
    """Return the pictures in the folders of the scene's files, those in use first.

    They may include results of renders.
    """
    in_use = [p.resolve() for p in _files(session)]
    folders = {session.path.parent, *(p.parent for p in _files(session))}
    pictures = sorted({p.resolve() for folder in folders for p in folder.iterdir() if p.suffix.lower() in ENDINGS})
    return [p for p in pictures if p in in_use] + [p for p in pictures if p not in in_use]


def _files(session: Session) -> list[Path]:
    """Return the files of the present environments."""
    root = scene_xml.parse(session.path)
    values = {d.get("name", ""): d.get("value", "") for d in root.iter("default")} | session.define
    scene_xml.Includes(session.path.parent, values).inline(
        root, session.path, lambda content: content.find("emitter") is not None)
    names = [s.get("value", "") for e in root.findall("emitter") for s in e.findall("string[@name='filename']")]
    places = [session.path.parent / scene_xml.substitute(name, values) for name in names]
    return [p for p in [session.environment, *places] if p is not None and p.is_file()]


def swap_environment(session: Session, picture: Path) -> None:
    """Use the file `picture` (latitude-longitude, EXR or HDR) as the scene's environment.

    Raises MiNtfError where the scene has none, or the file is no picture.
    """
    if not any(light.can_turn for light in session.lights):
        raise MiNtfError('the scene has no environment map to swap; give it an <emitter type="envmap">')
    try:
        mi.Bitmap(str(picture))
    except Exception as error:
        raise MiNtfError(f"{picture} is no picture that Mitsuba reads ({error}); choose an EXR or HDR file") from None
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.xml"
        save(session, scene, picture)
        session.reopen(scene, picture)

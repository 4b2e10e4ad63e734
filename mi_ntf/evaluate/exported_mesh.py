"""A scene whose fields are replaced by exported meshes, as a user would render it without this package."""

import os
import shlex
import time
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..render.scene.media import NRFMedium, ordinary_shapes


class ExportedMesh:
    """A scene whose fields are meshes of `mi-ntf export`, for stock integrators.

    Parameters
    ----------
    loaded
        The scene with fields.
    media
        Its ``nrf`` media.
    folder
        Folder for the meshes.

    Attributes
    ----------
    scene
        The scene with meshes.
    shapes
        XML of the shapes that replace those around the fields, with the file names of `commands`.
    commands
        Shell commands that make the meshes.
    seconds
        Duration of the export.

    Raises
    ------
    MiNtfError
        If a field has no surface, or libraries are missing.
    """

    def __init__(self, loaded: "mi.Scene", media: list[NRFMedium], folder: Path):
        from mi_ntf.export import export, mitsuba_shape

        start, shapes = time.perf_counter(), ordinary_shapes(loaded)
        lights = [e for e in loaded.emitters() if not any(s.is_emitter() and s.emitter() is e for s in shapes)]
        parts: list[Any] = [loaded.sensors()[0], *lights, *shapes]
        self.shapes, self.commands = "", ""
        level = mi.log_level()
        mi.set_log_level(mi.LogLevel.Error)  # Mitsuba warns of the roughness, which its plugin ignores
        try:
            for i, medium in enumerate(media):
                name = f"{Path(medium.path).stem}{i or ''}.ply"
                exported = export(Path(medium.path), folder / name)
                place = medium.frame.of_capture(medium.field.similarity)
                text = mitsuba_shape((folder / name).absolute(), exported, place)
                parts.append(mi.load_string(text.replace("<shape ", '<shape version="3.9.0" ', 1)))
                self.shapes += mitsuba_shape(Path(name), exported, place)
                self.commands += shlex.join(["mi-ntf", "export", os.path.relpath(medium.path), "-o", name]) + "\n"
            self.scene = mi.load_dict({"type": "scene", **{f"part{i}": part for i, part in enumerate(parts)}})
        finally:
            mi.set_log_level(level)
        self.seconds = time.perf_counter() - start

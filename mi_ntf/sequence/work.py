"""Rendering of one frame, in this process or another.

:func:`render` takes one :class:`Task`, which can be pickled, and writes one file. Fields, maps, patches and kernels
stay in the process for the next frame. Maps that neither of the last two frames used are freed.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import DTypeLike

from .. import __version__, bridge
from ..core.errors import MiNtfError, sentence
from ..render import user_cache
from ..render.maps import map_cache
from ..render.scene import changed, environment_option, scene_file
from ..render.scene.environment_option import Environment
from ..render.transport.bounced import Patches
from . import changes, image_file
from .timeline import Frame


@dataclass(frozen=True)
class Task:
    """Render `frame`, one of `count`, of the XML file `scene` into `folder`.

    `variant` "" stands for the one that is set, or else the first that this machine can run. `environment` changes the
    scene's own before the frame does.
    """

    scene: str
    folder: str
    frame: Frame
    count: int
    variant: str = ""
    environment: Environment | None = None

    @property
    def path(self) -> Path:
        """The file to write."""
        return image_file.path_of(Path(self.folder), self.frame.number, self.count)


def render(task: Task) -> float:
    """Render a task's frame, write its file, and return the seconds. Raises MiNtfError that names the frame."""
    begin = time.perf_counter()
    try:
        bridge.start(task.variant)
        state, name = _parsed(task)
        scene = changed.instantiated(Path(task.scene), _for_many(state, task.count))
        with user_cache.film():
            channels = _render(scene, task.scene, _precision(state))
        record = {"number": task.frame.number, "of": task.frame.values(), "key": name}
        image_file.write(task.path, channels, record)
    except (MiNtfError, RuntimeError, OSError) as error:
        raise MiNtfError(f"frame {task.frame.number}: {sentence(error)}") from None
    map_cache.keep_used()
    return time.perf_counter() - begin


def key(task: Task) -> str:
    """Return a hash of all that the frame's pixels depend on, except the machine and the variant.

    That is the scene as the frame changes it, the content of its files, and the version of this package. Raises
    MiNtfError.
    """
    try:
        bridge.start(task.variant)
        return _parsed(task)[1]
    except (MiNtfError, RuntimeError, OSError) as error:
        raise MiNtfError(f"frame {task.frame.number}: {sentence(error)}") from None


_last_frame: dict[str, Patches | None] = {}
"""Patches of the fields, for bounced light."""


def _parsed(task: Task) -> tuple[mi.parser.ParserState, str]:
    """Return the scene as the frame changes it, and its :func:`key`."""
    scene = Path(task.scene)
    if not scene.is_file():
        raise MiNtfError(f"scene {scene} does not exist")
    with changed.beside(scene):
        state = changed.parsed(scene, task.frame.parameters)
        environment_option.apply(task.environment or Environment(), state, scene)
        changes.apply(state.nodes, task.frame)
        digest = hashlib.sha256(json.dumps([__version__, mi.__version__, task.frame.values()]).encode())
        digest.update(mi.parser.write_string(state).encode())
        digest.update(changed.content_of_files(state))
    return state, digest.hexdigest()


def _for_many(state: mi.parser.ParserState, count: int) -> mi.parser.ParserState:
    """Set the integrator's number of frames, among which `auto` divides the cost of what is built for a field."""
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator and node.props.plugin_name() == "nrf" and "frames" not in node.props:
            node.props["frames"] = count
    return state


def _precision(state: mi.parser.ParserState) -> DTypeLike:
    """Return the ``component_format`` of the film, which cannot be read from the film itself."""
    films = [node.props for node in state.nodes if node.type == mi.ObjectType.Film]
    name = films[0].get("component_format", "float16") if films else ""
    return np.float16 if str(name).lower() == "float16" else np.float32


def _render(scene: mi.Scene, path: str, precision: DTypeLike) -> dict[str, np.ndarray]:
    """Return the channels of the picture of `scene`, which was read from `path`."""
    integrator, sensors = scene.integrator(), scene.sensors()
    if integrator is None or not sensors:
        raise MiNtfError(f"{path} needs an integrator and a sensor")
    context = getattr(integrator, "context", None)  # of an nrf integrator
    if context:
        context.patches = _last_frame.get("patches")
    scene_file.render_to_film(scene, sensors[0])
    if context:
        _last_frame["patches"] = context.patches
    bitmap = sensors[0].film().bitmap()
    pixels = np.array(bitmap)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    return {field.name: pixels[..., i].astype(precision) for i, field in enumerate(bitmap.struct_())}

"""Rendering of one frame, in this process or another.

:func:`render` takes one :class:`Task`, which can be pickled, and writes one file. What frames have in common, fields,
maps, light between patches, kernels, stays in the process for the next; what only the last frame but one used does not.
"""

import hashlib
import json
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from .. import __version__, bridge
from ..core.errors import MiNtfError, sentence
from ..core.variants import VARIANTS
from ..render import user_cache
from ..render.maps import map_cache
from ..render.scene import changed, environment_option, scene_file
from ..render.scene.environment_option import Environment
from ..render.scene.settings import Limits
from . import changes, image_file
from .timeline import Frame


@dataclass(frozen=True)
class Task:
    """Render `frame`, one of `count`, of the XML file `scene` into `folder`; of its lights the `part` of `parts`.
    `variant`: "" for the one that is set, or else the first that this machine can run. `environment` is laid over the
    scene's own, before the frame changes it."""

    scene: str
    folder: str
    frame: Frame
    count: int
    part: int = 0
    parts: int = 1
    variant: str = ""
    environment: Environment | None = None

    @property
    def path(self) -> Path:
        """The file to write."""
        return image_file.path_of(Path(self.folder), self.frame.number, self.count, self.part, self.parts)

    @property
    def whole(self) -> Path:
        """The file of the whole frame."""
        return image_file.path_of(Path(self.folder), self.frame.number, self.count)


def render(task: Task) -> dict[str, Any]:
    """Render a task's image and write its file: ``frame``, ``part`` and ``seconds``. Raises MiNtfError that names the
    frame."""
    begin = time.perf_counter()
    try:
        ready(task.variant)
        state, name = _parsed(task)
        scene = changed.instantiated(Path(task.scene), _for_many(state, task.count))
        with user_cache.film():
            # Parts keep the digits that their sum needs.
            channels = _render(scene, task, _precision(state) if task.parts == 1 else np.float32)
        record: dict[str, Any] = {"number": task.frame.number, "of": task.frame.told(), "key": name}
        if task.parts > 1:
            record |= {"part": task.part + 1, "parts": task.parts}
        image_file.write(task.path, channels, record)
    except (MiNtfError, RuntimeError, OSError) as error:
        raise MiNtfError(f"frame {task.frame.number}: {sentence(error)}") from None
    map_cache.keep_used()
    return {"frame": task.frame.number, "part": task.part, "seconds": time.perf_counter() - begin}


def key(task: Task) -> str:
    """Hash of all that the whole frame's pixels depend on but the machine and the variant: the scene as the frame
    changes it, the content of its files, the version of this package. Raises MiNtfError."""
    try:
        ready(task.variant)
        return _parsed(task)[1]
    except (MiNtfError, RuntimeError, OSError) as error:
        raise MiNtfError(f"frame {task.frame.number}: {sentence(error)}") from None


def ready(variant: str = "") -> None:
    """A variant is set, and the plugins are known in it."""
    if variant and variant not in mi.variants():
        raise MiNtfError(f"unknown variant {variant!r}; this Mitsuba has {', '.join(mi.variants())}")
    if (variant and mi.variant() != variant) or mi.variant() is None:
        mi.set_variant(*([variant] if variant else VARIANTS))
    if mi.variant() not in _registered:
        _registered.add(str(mi.variant()))
        bridge.register_all(str(mi.variant()))


_registered: set[str] = set()


_kept: dict[str, Any] = {}
"""Of the last frame, what its integrator found out about its fields."""


def _parsed(task: Task):
    """``(state, key)`` of the scene as the frame has it."""
    scene = Path(task.scene)
    if not scene.is_file():
        raise MiNtfError(f"scene {scene} does not exist")
    with changed.beside(scene):
        state = changed.parsed(scene, task.frame.parameters)
        environment_option.apply(task.environment or Environment(), state, scene)
        changes.apply(state.nodes, task.frame)
        digest = hashlib.sha256(json.dumps([__version__, mi.__version__, task.frame.told()]).encode())
        digest.update(mi.parser.write_string(state).encode())
        resolver = mi.file_resolver()  # type: ignore[operator]  # an object in the stub
        for node in state.nodes:
            for name in node.props:
                if "file" in name and node.props.type(name) == mi.Properties.Type.String:
                    digest.update(_content(Path(str(resolver.resolve(node.props[name])))))
    return state, digest.hexdigest()


def _content(path: Path) -> bytes:
    if not path.is_file():
        return b""  # whoever needs it will say so
    stat = path.stat()
    return _hashed(str(path), stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=256)
def _hashed(path: str, _time: int, _size: int) -> bytes:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").digest()


def _for_many(state, count: int):
    """`auto` shares among all frames what is built for a field."""
    for node in state.nodes:
        if node.type == mi.ObjectType.Integrator and node.props.plugin_name() == "nrf" and "frames" not in node.props:
            node.props["frames"] = count
    return state


def _precision(state) -> type:
    """Return the ``component_format`` of the film, which only its file holds."""
    films = [node.props for node in state.nodes if node.type == mi.ObjectType.Film]
    name = films[0].get("component_format", "float16") if films else ""
    return np.float16 if str(name).lower() == "float16" else np.float32


def _render(scene, task: Task, precision: type) -> dict[str, np.ndarray]:
    """The channels of the picture."""
    integrator, sensors = scene.integrator(), scene.sensors()
    if integrator is None or not sensors:
        raise MiNtfError(f"{task.scene} needs an integrator and a sensor")
    ours = hasattr(integrator, "patches")
    if task.parts > 1:
        _check_parts(integrator, ours)
        integrator.share = task.part, task.parts
    if ours:
        integrator.patches = _kept.get("patches")
    scene_file.render_to_film(scene, sensors[0])
    if ours:
        _kept["patches"] = integrator.patches
    bitmap = sensors[0].film().bitmap()
    pixels = np.array(bitmap)
    pixels = pixels.reshape(*pixels.shape[:2], -1)
    names = [field.name for field in bitmap.struct_()]
    # Parts keep all digits for their sum.
    return {name: pixels[..., i].astype(precision) for i, name in enumerate(names)}


def _check_parts(integrator, ours: bool) -> None:
    """Raise MiNtfError where images of parts of the lights do not add up to the picture."""
    why = (
        f"the integrator is {integrator.class_name()}, and only nrf sums over lights" if not ours else
        "further outputs (aovs) are no sums over lights" if integrator.aovs else
        "light_samples draws from all lights at once" if integrator.light_samples else
        "a limit (noise_threshold, max_error, time_budget) is of the whole picture" if integrator.limits != Limits()
        else "")
    if why:
        raise MiNtfError(f"a frame in parts by its lights: {why}; give whole frames to shards")

"""Shapes of a scene as `mi-ntf capture` and `mi-ntf swap` name them, and the choice among them by ``--shapes``."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .errors import MiNtfError, shown

FLAT = 0.2  # thinnest over middle side of a bounding box
LARGE = 2.0  # size of a shape over that of all others together


@dataclass(frozen=True)
class SceneShape:
    """Shape of a scene file: the type of its plugin, its id, its file, and its name, which tells it from others.

    It holds an "emitter", a "sensor" or neither. Only shapes that hold neither can be part of an object.
    """

    type: str
    id: str = ""
    file: str = ""
    holds: str = ""
    name: str = ""

    def __str__(self) -> str:
        kind = {"emitter": "area light", "sensor": "sensor"}.get(self.holds, self.type)
        name = self.name or self.plain
        return name if not self.holds and name.startswith(self.type) else f"{name} ({kind})"

    @property
    def plain(self) -> str:
        """The id, else the name of the file without its ending, else the type."""
        return self.id or Path(self.file).stem or self.type


def named(shapes: Sequence[SceneShape]) -> list[SceneShape]:
    """Return the shapes with names. Plain ones that several have are numbered in the file's order: cube1, cube2."""
    total, count = Counter(shape.plain for shape in shapes), Counter[str]()
    result = []
    for shape in shapes:
        name = shape.plain
        while total[name] > 1 or (name != shape.plain and name in total):
            count[shape.plain] += 1
            name = f"{shape.plain}{count[shape.plain]}"
        result.append(replace(shape, name=name))
    return result


def choose(text: str, names: Sequence[str]) -> list[bool]:
    """Return for each name whether ``--shapes`` chooses it.

    `text` is "" for all, names separated by commas, or ``not:`` and names for all others. Raises MiNtfError for other
    names, and if none is left.
    """
    others = text.startswith("not:")
    words = [word.strip() for word in text.removeprefix("not:").split(",") if word.strip()]
    unknown = [word for word in words if word not in names]
    if unknown:
        raise MiNtfError(f"--shapes: no shape is called {shown(unknown[0])}; the scene has {', '.join(names)} (lights "
                         "are never photographed or replaced)")
    chosen = [not text or (name in words) != others for name in names]
    if names and not any(chosen):
        raise MiNtfError(f"--shapes is {shown(text)}, which leaves no shape; the scene has {', '.join(names)}")
    return chosen


def listed(things: Sequence[object], most: int = 8) -> str:
    """Return the things as text, separated by commas, with the number of those that are not shown."""
    counted = [str(thing) if n == 1 else f"{n} × {thing}" for thing, n in Counter(map(str, things)).items()]
    rest = [f"and {len(counted) - most} more"] if len(counted) > most else []
    return ", ".join(counted[:most] + rest) or "nothing"


def warning(shapes: Sequence[SceneShape], low: np.ndarray, high: np.ndarray) -> str:
    """Return a warning if a floor or a room is photographed together with an object, else "".

    `low` and `high` are corners of the shapes' bounding boxes, (n, 3). A floor is flat, a room contains all that is
    not flat, and both are more than twice as large as the other shapes together.
    """
    sides = high - low
    flat = np.sort(sides)[:, 0] < FLAT * np.sort(sides)[:, 1]
    room = np.array([all(flat[j] or ((low[i] <= low[j]) & (high[j] <= high[i])).all()
                         for j in range(len(low))) for i in range(len(low))]) & (np.count_nonzero(~flat) > 1)
    rest = ~(flat | room)
    if not rest.any():
        return ""
    sizes = np.linalg.norm(sides, axis=1) / np.linalg.norm(high[rest].max(0) - low[rest].min(0))
    large = [shape for shape, size, candidate in zip(shapes, sizes, ~rest, strict=True) if candidate and size > LARGE]
    if not large:
        return ""
    be, it, times = ("is", "it", "") if len(large) == 1 else ("are", "them", "up to ")
    return (f"warning: {listed(large)} {be} {times}{sizes[~rest].max():.2g} times as large as the other shapes "
            "together, which become small in the photographs; "
            f"--shapes not:{','.join(shape.name for shape in large)} leaves {it} out")

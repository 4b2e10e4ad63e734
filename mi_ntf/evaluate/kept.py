"""Results of long work on the disk, one JSON line each, and pictures, so that interrupted work can continue."""

import json
from pathlib import Path

import numpy as np

from ..core import files
from .limits import Json

NAME, PICTURES = "study.jsonl", "pictures"
"""File of the lines, and folder of the pictures."""


class State:
    """Lines by name in the file ``study.jsonl`` of `folder`; those of another `key` are removed.

    - fresh: names of the entries of `key` that differ from the removed lines; "" where nothing was removed
    """

    def __init__(self, folder: Path, key: Json):
        self.folder, self.path = Path(folder), Path(folder) / NAME
        files.make_folder(self.folder / PICTURES)
        self.lines = _read(self.path)
        old = self.lines.get("key", key)
        self.fresh = ", ".join(name for name in key if old.get(name) != key[name])
        if self.fresh or "key" not in self.lines:
            self.lines = {}
        self.add("key", key)

    def add(self, name: str, values: Json) -> None:
        """Add or replace a line, and write it to the disk. Raises MiNtfError where that fails."""
        self.lines[name] = values
        files.write(self.path, *(json.dumps({"name": n, "values": v}) + "\n" for n, v in self.lines.items()))

    def keep(self, name: str, pictures: dict[str, np.ndarray]) -> None:
        """Write pictures (h, w, 3) under a name."""
        with files.replacing(self.folder / PICTURES / f"{name}.npz") as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, allow_pickle=False, **{key: np.asarray(image, np.float32)
                                                             for key, image in pictures.items()})

    def pictures(self, name: str) -> dict[str, np.ndarray]:
        """Return the pictures of :meth:`keep`; none where the file is missing or damaged."""
        try:
            with np.load(self.folder / PICTURES / f"{name}.npz", allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, EOFError):
            return {}


def _read(path: Path) -> dict[str, Json]:
    """Return the lines of a file up to the first incomplete one."""
    lines: dict[str, Json] = {}
    try:
        for line in filter(None, path.read_text(encoding="utf-8", errors="replace").split("\n")):
            value = json.loads(line)
            lines[value["name"]] = value["values"]
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return lines

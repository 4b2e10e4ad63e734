"""Findings of long work on the disk, one JSON line each, and pictures, so that interrupted work goes on."""

import json
from pathlib import Path
from typing import Any

import numpy as np

from ..core import files

NAME, PICTURES = "study.jsonl", "pictures"
"""File of the lines, and folder of the pictures."""


class State:
    """Lines by name in the file ``study.jsonl`` of `folder`. Those of another `key` are dropped.

    fresh   words for what differs from the dropped lines; "" where nothing was dropped
    """

    def __init__(self, folder: Path, key: dict[str, Any]):
        self.folder, self.path = Path(folder), Path(folder) / NAME
        files.make_folder(self.folder / PICTURES)
        self.lines = _read(self.path)
        old = self.lines.get("key", key)
        self.fresh = ", ".join(name for name in key if old.get(name) != key[name])
        if self.fresh or "key" not in self.lines:
            self.lines = {}
        self.add("key", key)

    def add(self, name: str, values: dict[str, Any]) -> dict[str, Any]:
        """Add a line, or replace one; it is on the disk when this returns. Raises MiNtfError where it cannot be."""
        self.lines[name] = values
        files.write(self.path, *(json.dumps({"name": n, "values": v}) + "\n" for n, v in self.lines.items()))
        return values

    def keep(self, name: str, pictures: dict[str, np.ndarray]) -> None:
        """Write pictures (h, w, 3) under a name."""
        arrays: dict[str, Any] = {key: np.asarray(picture, np.float32) for key, picture in pictures.items()}
        with files.replacing(self.folder / PICTURES / f"{name}.npz") as temporary, open(temporary, "wb") as file:
            np.savez_compressed(file, **arrays)

    def pictures(self, name: str) -> dict[str, np.ndarray]:
        """Return the pictures of :meth:`keep`; none where they are gone or damaged."""
        try:
            with np.load(self.folder / PICTURES / f"{name}.npz", allow_pickle=False) as file:
                return dict(file)
        except (OSError, ValueError, EOFError):
            return {}


def _read(path: Path) -> dict[str, Any]:
    """Return the lines of a file as far as they are whole."""
    lines: dict[str, Any] = {}
    try:
        for line in filter(None, path.read_text(encoding="utf-8", errors="replace").split("\n")):
            value = json.loads(line)
            lines[value["name"]] = value["values"]
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return lines

"""What a study has found so far, on the disk: one JSON line a finding, so that an interrupted study goes on."""

import hashlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from ...core import files
from ...core.errors import MiNtfError

NAME = "study.jsonl"
IMAGES = "images"
ATTEMPTS = 2
"""Beginnings of one point without an end after which it counts as what ended the process."""


class State:
    """The findings in `folder`, dictionaries with a ``kind``, in their order. Of another `key` than theirs they are
    dropped: `fresh` says why, "" where they were taken over or there were none."""

    def __init__(self, folder: Path, key: dict[str, Any]):
        self.folder, self.path = Path(folder), Path(folder) / NAME
        files.make_folder(self.folder / IMAGES)
        self.fresh = ""
        self.findings = _read(self.path)
        if self.findings:
            self.fresh = _changed(self.findings[0], key)
            if self.fresh:
                self.findings = []
        if not self.findings:
            self.findings = [{"kind": "key", **key}]
        # Written anew: a line that a kill cut off would swallow the next one.
        files.write(self.path, *(_line(f) for f in self.findings))

    def of(self, kind: str) -> list[dict[str, Any]]:
        """All findings of a kind."""
        return [f for f in self.findings if f["kind"] == kind]

    def one(self, kind: str) -> dict[str, Any] | None:
        """The last finding of a kind."""
        found = self.of(kind)
        return found[-1] if found else None

    def add(self, kind: str, **values: Any) -> dict[str, Any]:
        """Append a finding; it is on the disk when this returns. Raises MiNtfError where it cannot be written."""
        found = {"kind": kind, **values}
        try:
            with open(self.path, "a", encoding="utf-8") as file:
                file.write(_line(found))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            raise MiNtfError(f"cannot write {self.path} ({error.strerror}); free space there or choose another "
                             "--output") from None
        self.findings.append(found)
        return found

    def keep(self, name: str, image: np.ndarray) -> str:
        """Write a picture (h, w, 3); its path in the folder."""
        place = f"{IMAGES}/{name}.npy"
        with files.replacing(self.folder / place) as temporary, open(temporary, "wb") as file:
            np.save(file, np.asarray(image, np.float32))
        return place

    def image(self, place: str) -> np.ndarray | None:
        """A picture of :meth:`keep`; None where it is gone or damaged."""
        try:
            return np.load(self.folder / place, allow_pickle=False)
        except (OSError, ValueError, EOFError):
            return None

    def attempts(self, name: str) -> int:
        """How often a point was begun and not ended, by failing or otherwise."""
        begun = sum(f["name"] == name for f in self.of("begun"))
        return begun - sum(f.get("name") == name for f in (*self.of("point"), *self.of("interrupted")))


def forget(folder: Path) -> bool:
    """Remove what a study has found in `folder`, so that the next one there begins anew; whether there was anything.
    Its report stays. Raises MiNtfError."""
    path, images = Path(folder) / NAME, Path(folder) / IMAGES
    there = path.is_file()
    try:
        for file in (path, *images.glob("*.npy")):
            file.unlink(missing_ok=True)
    except OSError as error:
        raise MiNtfError(f"cannot remove {error.filename} ({error.strerror}); remove it or choose another folder"
                         ) from None
    return there


def name_of(values: dict[str, Any]) -> str:
    """A short name of a point's dials."""
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]


def _line(finding: dict[str, Any]) -> str:
    return json.dumps(finding) + "\n"


def _read(path: Path) -> list[dict[str, Any]]:
    """The findings of a file as far as they are whole."""
    found: list[dict[str, Any]] = []
    try:
        lines = path.read_text(encoding="utf-8", errors="replace").split("\n")
    except OSError:
        return found
    for line in filter(None, lines):
        try:
            value = json.loads(line)
        except ValueError:
            break
        if not isinstance(value, dict) or not isinstance(value.get("kind"), str):
            break
        found.append(value)
    return found if found and found[0]["kind"] == "key" else []


def _changed(old: dict[str, Any], key: dict[str, Any]) -> str:
    """What differs between the key of the findings and `key`, in words."""
    names = [name for name in key if old.get(name) != key[name]]
    return ", ".join(names)

"""Checkpoint files: the whole state of a refinement, written so that a crash at any moment leaves a good one."""

from __future__ import annotations

import io
import json
from pathlib import Path

import numpy as np

from ..core import files
from ..core.errors import MiNtfError
from ..core.json_values import Json
from ..core.ops import Tensors


def write(path: Path, identity: Json, head: Json, arrays: Tensors) -> None:
    """Write the state of the run with these settings: numbers in `head`, and `arrays`. Raises MiNtfError."""
    content = io.BytesIO()
    np.savez(content, allow_pickle=False, head=np.array(json.dumps({"identity": identity} | head)), **arrays)
    files.write(path, content.getbuffer())


def read(path: Path, identity: Json) -> tuple[Json, Tensors] | None:
    """Return ``(head, arrays)`` of a checkpoint, None if there is no file.

    Raises MiNtfError if the file is damaged, or belongs to a run with other settings or data.
    """
    if not path.is_file():
        return None
    try:
        with np.load(path, allow_pickle=False) as data:
            arrays = dict(data)
        head = json.loads(str(arrays.pop("head")))
        before = dict(head["identity"])
    except Exception as error:  # NumPy and zipfile raise many kinds
        raise MiNtfError(f"{path} cannot be read ({error}); delete it to start anew") from None
    changed = [key for key, value in json.loads(json.dumps(identity)).items() if before.get(key) != value]
    if changed:
        raise MiNtfError(f"{path} belongs to a run with other {', '.join(changed)}; repeat that command, or delete the "
                         "file to start anew")
    return head, arrays


def delete(path: Path) -> None:
    """Remove the checkpoint, and the remains of an interrupted :func:`write`."""
    path.unlink(missing_ok=True)
    files.tidy(path)

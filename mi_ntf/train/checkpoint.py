"""Checkpoint files: the whole state of a run, written so that a crash at any moment leaves a good one."""

import io
from pathlib import Path
from typing import Any

import torch

from ..core import files
from ..core.errors import MiNtfError

State = dict[str, Any]
"""Tensors, numbers and texts, in dicts, lists and tuples."""
VERSION = 2
"""Version of the content; files of other versions are refused."""


def write(path: Path, identity: State, state: State) -> None:
    """Write the `state` of the run whose settings and data are `identity`.

    `identity` holds JSON types; ``data`` maps names to hashes. Raises MiNtfError if the file cannot be written; the
    one before then remains.
    """
    content = io.BytesIO()
    torch.save({"version": VERSION, "identity": identity, "state": state}, content)
    files.write(path, content.getbuffer())


def read(path: Path, identity: State) -> State | None:
    """Return the state in `path`, or None if there is no such file.

    Raises MiNtfError if the file is damaged, of another version, or not of the run that `identity` describes.
    """
    if not path.is_file():
        return None
    try:
        data = torch.load(path, map_location=torch.get_default_device(), weights_only=True)
        version, settings, state = data.get("version"), dict(data["identity"]), dict(data["state"])
        hashes = dict(settings.pop("data"))
    except Exception as error:
        raise MiNtfError(f"{path} cannot be read ({error}); delete it to start anew") from None
    if version != VERSION:
        raise MiNtfError(f"{path} was written by another version of mi_ntf; delete it to start anew")
    changed = _differences(hashes, identity["data"])
    if changed:
        raise MiNtfError(f"{path} belongs to a run on other data: {', '.join(changed)} changed since; put back what "
                         "the run began with, or delete the file to start anew")
    differing = _differences(settings, {k: v for k, v in identity.items() if k != "data"})
    if differing:
        shown = str({k: settings.get(k) for k in differing})[:200]
        raise MiNtfError(f"{path} belongs to a run with other settings ({shown}); repeat that command, or delete the "
                         "file to start anew")
    return state


def _differences(a: State, b: State) -> list[str]:
    return [k for k in b | a if a.get(k) != b.get(k)]


def delete(path: Path) -> None:
    """Remove the checkpoint, and the remains of an interrupted :func:`write`."""
    path.unlink(missing_ok=True)
    files.tidy(path)

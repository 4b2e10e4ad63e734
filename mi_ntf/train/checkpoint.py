"""Checkpoint files: the whole state of a run, written so that a crash at any moment leaves a good one."""

import os
from pathlib import Path

import torch

from ..core.errors import MiNtfError


def write(path: Path, identity: str, state: dict) -> None:
    """Write `state` (tensors, numbers, texts in dicts and lists), of the run whose settings are `identity`.

    The file is complete on the disk before it takes the place of the one before.
    """
    temporary = _part(path)
    with open(temporary, "wb") as file:
        torch.save({"identity": identity, "state": state}, file)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def read(path: Path, identity: str) -> dict | None:
    """The state in `path`, None where there is no such file. It must be of a run with the settings `identity`."""
    if not path.is_file():
        return None
    try:
        data = torch.load(path, map_location=torch.get_default_device(), weights_only=True)
        found, state = data["identity"], data["state"]
    except Exception as error:
        raise MiNtfError(f"{path} cannot be read ({error}); delete it to start anew") from None
    if found != identity:
        raise MiNtfError(f"{path} belongs to a run with other settings ({found[:200]}…); repeat that command, or "
                         "delete the file to start anew")
    return state


def delete(path: Path) -> None:
    """Remove the checkpoint and what an interrupted :func:`write` left."""
    path.unlink(missing_ok=True)
    _part(path).unlink(missing_ok=True)


def _part(path: Path) -> Path:
    return Path(f"{path}.part")

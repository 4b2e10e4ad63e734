"""Checkpoint files: the whole state of a run, written so that a crash at any moment leaves a good one."""

import io
from pathlib import Path

import torch

from ..core import files
from ..core.errors import MiNtfError


def write(path: Path, identity: dict, state: dict) -> None:
    """Write `state` (tensors, numbers, texts in dicts and lists), of the run whose settings and data are `identity`
    (JSON types; ``data``: name → hash). Raises MiNtfError where it cannot be written; the one before stays."""
    content = io.BytesIO()
    torch.save({"identity": identity, "state": state}, content)
    files.write(path, content.getbuffer())


def read(path: Path, identity: dict) -> dict | None:
    """The state in `path`, None where there is no such file. Raises MiNtfError where it is not of the run that
    `identity` describes, naming what differs."""
    if not path.is_file():
        return None
    try:
        data = torch.load(path, map_location=torch.get_default_device(), weights_only=True)
        found, state = dict(data["identity"]), data["state"]
        before = dict(found.pop("data"))
    except Exception as error:
        raise MiNtfError(f"{path} cannot be read ({error}); delete it to start anew") from None
    changed = _differences(before, identity["data"])
    if changed:
        raise MiNtfError(f"{path} belongs to a run on other data: {', '.join(changed)} changed since; put back what "
                         "the run began with, or delete the file to start anew")
    others = {k: found.get(k) for k in _differences(found, {k: v for k, v in identity.items() if k != "data"})}
    if others:
        raise MiNtfError(f"{path} belongs to a run with other settings ({str(others)[:200]}); repeat that command, or "
                         "delete the file to start anew")
    return state


def _differences(a: dict, b: dict) -> list[str]:
    return [k for k in b | a if a.get(k) != b.get(k)]


def delete(path: Path) -> None:
    """Remove the checkpoint and what an interrupted :func:`write` left."""
    path.unlink(missing_ok=True)
    files.tidy(path)

"""Fields in memory: read and baked once, whoever asks."""

import hashlib
import threading
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import field_file
from ...core.architecture import Header
from ...infer.backend import module
from ...infer.bake import VERSION, bake
from ...infer.grid import GridField
from ...infer.network import NetworkField
from ...infer.skin import Softness, measure
from .. import log, user_cache

QUEUED = 1 << 16
"""Width of a kernel that Dr.Jit queues instead of running it at once: several blocks."""

# Reentrant, since a thread that waits for a kernel of the bake may start to load the next medium.
_one_at_a_time = threading.RLock()


@dataclass(frozen=True)
class LoadedField:
    """A field file in both representations, and how soft its skins are. `digest`: hash of the networks that were read,
    whatever has become of the file since."""

    header: Header
    network: NetworkField
    grid: GridField
    softness: Softness
    digest: str


def voxels(header: Header) -> int:
    """Voxels per side that a field is baked to unless told: two for each texel of its finest density planes, and 192 at
    least. Products of three planes are finer than one: of 192² planes, relit pictures differ from the photographed
    object by 12.8 % with 256 voxels, 12.5 % with 384, 12.4 % with 512."""
    finest = max(header.architecture.density.encoding.resolutions, default=0)
    return min(max(192, 2 * finest), 512)


def load(path: str, resolution: int | None) -> LoadedField:
    """Read `path` and bake it at `resolution`³, None for :func:`voxels`; cached by path, the file's identity and time,
    resolution and variant."""
    stat = Path(path).stat() if Path(path).is_file() else None
    _begin_other_media(str(mi.variant()))
    with _one_at_a_time:
        return _load(path, stat and (stat.st_mtime_ns, stat.st_size, stat.st_ino), resolution, mi.variant())


def _begin_other_media(variant: str) -> None:
    """Start the constructors of the scene's other media before a field is baked.

    Mitsuba constructs media as tasks of Dr.Jit's thread pool, and a thread that waits for a kernel executes other tasks
    meanwhile. Another medium would then start within the bake, on the same thread, and bake the field again, since it
    cannot wait for its own thread. Waiting for a kernel at the end of the queue makes all of them start here.
    """
    dj = module(variant)
    dr.eval(dr.arange(dj.UInt32, QUEUED) + 1)
    dr.sync_thread()


@lru_cache(maxsize=4)
def _load(path: str, _identity: tuple | None, resolution: int | None, variant: str) -> LoadedField:
    dj = module(variant)
    header, tensors = field_file.load(path)
    with log.timed(f"nrf medium: loaded {path}"):
        network, digest = NetworkField(header, tensors, dj), _digest(header, tensors)
        n = resolution or voxels(header)
        known = field_file.load_baked(path, _stamp(digest, n))
        if known is not None:
            try:
                return LoadedField(header, network, GridField(known, network, dj), Softness(known, dj), digest)
            except (KeyError, ValueError):
                log.info(f"nrf medium: the voxels in {path} are damaged")
        arrays = user_cache.kept("fields", user_cache.key(digest, n), lambda: _baked(path, network, n, dj))
        return LoadedField(header, network, GridField(arrays, network, dj), Softness(arrays, dj), digest)


def add_baked(path: Path, resolution: int | None = None) -> dict:
    """Bake a field file and put the voxels into it, so that no later load bakes; return ``file``, ``voxels`` and
    ``bytes``. Raises MiNtfError."""
    header, tensors = field_file.load(path)
    dj = module(str(mi.variant()))
    n = resolution or voxels(header)
    arrays = _baked(str(path), NetworkField(header, tensors, dj), n, dj)
    field_file.add_baked(path, arrays, _stamp(_digest(header, tensors), n))
    return {"file": str(path), "voxels": n, "bytes": Path(path).stat().st_size}


def _baked(path: str, network: NetworkField, n: int, dj) -> dict[str, np.ndarray]:
    with log.timed(f"nrf medium: baked {path}, {n}³ voxels"):
        arrays = bake(network, n, dj, log.Progress(f"nrf medium: baking {path}, {n}³ voxels"))
        return arrays | measure(GridField(arrays, network, dj), dj)


def _stamp(digest: str, n: int) -> str:
    """Return what tells that arrays in a field file are baked from its tensors, by this version, at n³ voxels."""
    return f"{VERSION} {n} {digest}"


def _digest(header: Header, tensors: dict) -> str:
    """SHA-256 of the architecture and the tensors in memory, hexadecimal."""
    digest = hashlib.sha256(repr(header.architecture).encode())
    for name, value in sorted(tensors.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value).data)
    return digest.hexdigest()

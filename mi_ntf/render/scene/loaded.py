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
from ...infer.grid import GridField
from ...infer.network import NetworkField
from ...infer.skin import Softness

QUEUED = 1 << 16
"""Size of a kernel that is not run at once but queued: several blocks of Dr.Jit."""

# Reentrant: a medium that begins during the baking all the same must not wait for its own thread.
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
    """Let the other media of a scene that is being loaded begin, those of them that would begin during the baking.

    Mitsuba makes them as tasks of Dr.Jit's threads, and a thread that waits for a kernel takes up any task: a medium
    that began while this thread bakes its field could not wait for the result and would bake it again. A kernel at the
    end of the queue is waited for after all of them, here, before anything is baked.
    """
    dj = module(variant)
    dr.eval(dr.arange(dj.UInt32, QUEUED) + 1)
    dr.sync_thread()


@lru_cache(maxsize=4)
def _load(path: str, _stamp: tuple | None, resolution: int | None, variant: str) -> LoadedField:
    dj = module(variant)
    header, tensors = field_file.load(path)
    network = NetworkField(header, tensors, dj)
    grid = GridField(network, resolution or voxels(header), dj)
    return LoadedField(header, network, grid, Softness(grid, dj), _digest(header, tensors))


def _digest(header: Header, tensors: dict) -> str:
    """SHA-256 of the architecture and the tensors in memory, hexadecimal."""
    digest = hashlib.sha256(repr(header.architecture).encode())
    for name, value in sorted(tensors.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value).data)
    return digest.hexdigest()

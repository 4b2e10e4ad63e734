"""Cache of the fields in memory, each read and baked once."""

import hashlib
import itertools
import threading
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from types import ModuleType
from weakref import WeakValueDictionary

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core import field_file
from ...core import voxels as voxel_file
from ...core.architecture import Header, Similarity
from ...core.errors import MiNtfError
from ...infer.backend import module
from ...infer.bake import VERSION, bake
from ...infer.bricks import SIDE
from ...infer.grid import GridField
from ...infer.network import NetworkField
from ...infer.skin import Smoke, Softness, measure, scale_height
from ...infer.tuning import VOXEL
from ...infer.volume import VoxelVolume, of_file
from .. import log, user_cache

QUEUED = 1 << 16
"""Width of a kernel of several blocks, which Dr.Jit queues instead of running it at once."""

# Reentrant, since a thread that waits for a kernel of the bake may start to load the next medium.
_one_at_a_time = threading.RLock()


@dataclass(frozen=True)
class LoadedField:
    """The field of a medium: of a trained field file, of a file of voxels, or of a medium of Mitsuba.

    - name: field file or medium, for messages
    - grid: density and reflectance
    - digest: hash of the density, and of the networks as they were read, even if the file has changed since
    - appearance: hash of density and reflectance; another one than `digest` if any was set in the scene
    - similarity: transform from the capture to the field
    - softness: softness of the skins, that of the file
    - networks: header and networks of a trained field
    - phase: asymmetry of the phase function, None for surfaces
    - emissive: the matter emits light
    - density_set: the density was set in the scene, so the networks do not know it
    """

    name: str
    grid: GridField | VoxelVolume
    digest: str
    appearance: str
    similarity: Similarity = field(default_factory=Similarity)
    softness: Softness | Smoke = field(default_factory=Smoke)
    networks: tuple[Header, NetworkField] | None = None
    phase: float | None = None
    emissive: bool = False
    density_set: bool = False

    @property
    def trained(self) -> bool:
        """True if there are networks that know the density."""
        return self.networks is not None and not self.density_set

    @property
    def header(self) -> Header:
        """Header of the field file. Raises MiNtfError if there are no networks that know the density."""
        return self._trained()[0]

    @property
    def network(self) -> NetworkField:
        """Networks of the field file. Raises MiNtfError if there are none that know the density."""
        return self._trained()[1]

    @property
    def retro(self) -> float | None:
        """Retro-reflection of :mod:`mi_ntf.core.fresnel`, None if the specular weight is the same at all angles."""
        return self.networks and self.networks[1].retro

    @property
    def tail(self) -> float | None:
        """Tail of the specular lobe (:mod:`mi_ntf.core.microfacet`), None for GGX."""
        return self.networks and self.networks[1].tail

    def _trained(self) -> tuple[Header, NetworkField]:
        if self.networks is not None and not self.density_set:
            return self.networks
        why = ("nrf medium: its density was set in the scene, which its trained networks do not know"
               if self.density_set else f"{self.name} is no trained field, so it has no networks")
        raise MiNtfError(f"{why}; choose visibility=raymarch, transmittance_map, transmittance_volume or "
                         "transmittance_atlas, and map_source=field")


class InMemory:
    """Header and arrays of a field of voxels without a file; media find it by its `name` as long as it exists."""

    def __init__(self, header: voxel_file.Voxels, arrays: dict[str, np.ndarray]) -> None:
        self.name = f"memory:{next(_numbers)}"
        voxel_file.check("the field in memory", header, arrays)
        self.header, self.arrays = header, arrays
        _in_memory[self.name] = self


_numbers = itertools.count(1)
_in_memory: WeakValueDictionary[str, InMemory] = WeakValueDictionary()


def is_in_memory(name: str) -> bool:
    """Return True if `name`, in place of a file, is that of an :class:`InMemory`, perhaps a freed one."""
    return name.startswith("memory:")


def voxels(header: Header, network: NetworkField, dj: ModuleType) -> int:
    """Return the default number of voxels per side, 192 to 512.

    There are two for each texel of the finest density planes, since the product of three planes has finer detail than a
    single plane; and more where skins are thinner than that.
    """
    planes = 2 * max(header.architecture.density.encoding.resolutions, default=0)
    skins = 2 / (VOXEL * scale_height(network, dj)) if header.architecture.phase is None else 0
    return min(max(192, planes, -(-round(skins) // SIDE) * SIDE), 512)


def load(path: str, resolution: int | None) -> LoadedField:
    """Read the field file `path` and bake it at `resolution`³ voxels, None for :func:`voxels`.

    A file of voxels, or the name of an :class:`InMemory`, is read as it is.

    The result is cached by path, the file's identity and time, resolution and variant.
    """
    path = str(Path(path))  # Mitsuba finds files of a scene as "folder/./name"
    stat = Path(path).stat() if Path(path).is_file() else None
    _begin_other_media(str(mi.variant()))
    with _one_at_a_time:
        return _load(path, stat and (stat.st_mtime_ns, stat.st_size, stat.st_ino), resolution, mi.variant())


def forget() -> None:
    """Free the fields in memory, apart from those that media of existing scenes hold."""
    with _one_at_a_time:
        _load.cache_clear()


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
def _load(path: str, _identity: tuple[int, int, int] | None, resolution: int | None, variant: str
          ) -> LoadedField:
    dj = module(variant)
    volume = _stored_voxels(path)
    if volume is not None:
        if resolution is not None:
            raise MiNtfError(f"nrf medium: resolution is {resolution}, but {path} is a field of voxels, which has its "
                             "own; leave resolution out")
        return _volume_field(path, *volume, dj)
    header, tensors = field_file.load(path)
    with log.Work("nrf medium", f"reading {path}"):
        network, digest = NetworkField(header, tensors, dj), _digest(header, tensors)
        stored = field_file.load_baked(path, _stamp(digest, resolution))
        if stored is not None:
            try:
                return _trained_field(path, header, network, stored, digest, dj)
            except (KeyError, ValueError):
                log.info(f"nrf medium: the voxels in {path} are damaged")
        arrays = user_cache.cached("fields", user_cache.key(digest, resolution),
                                   lambda: _baked(path, header, network, resolution, dj))
        return _trained_field(path, header, network, arrays, digest, dj)


def _stored_voxels(path: str) -> tuple[voxel_file.Voxels, dict[str, np.ndarray]] | None:
    """Return header and arrays of a field of voxels, None if `path` is a trained field."""
    if is_in_memory(path):
        volume = _in_memory.get(path)
        if volume is None:
            raise MiNtfError(f"the field {path} was freed; keep the mi_ntf.Field as long as scenes are loaded with it")
        return volume.header, volume.arrays
    header = field_file.load_header(path)
    return (header, voxel_file.load(path, header)) if isinstance(header, voxel_file.Voxels) else None


def _volume_field(path: str, header: voxel_file.Voxels, arrays: dict[str, np.ndarray], dj: ModuleType) -> LoadedField:
    """Return a field of voxels. Raises MiNtfError if the arrays are damaged."""
    with log.Work("nrf medium", f"reading {path}") as work:
        try:
            volume = of_file(header, arrays, dj)
        except ValueError as error:
            raise MiNtfError(f"{path} is damaged ({error}); make it anew with `mi-ntf import`") from None
        softness: Softness | Smoke = Smoke()
        if header.phase is None and volume.majorant > 0:
            softness = Softness(user_cache.cached("fields", user_cache.key(volume.digest, volume.resolution),
                                                  lambda: measure(volume, dj, work.update)), dj)
        return LoadedField(path, volume, volume.digest, volume.digest, header.similarity, softness, None, header.phase,
                           header.emissive)


def _trained_field(path: str, header: Header, network: NetworkField, arrays: dict[str, np.ndarray], digest: str,
                   dj: ModuleType) -> LoadedField:
    """Return a trained field with its baked `arrays`. Raises KeyError or ValueError if these are damaged."""
    phase = header.architecture.phase
    return LoadedField(path, GridField(arrays, network, dj), digest, digest, header.similarity,
                       Softness(arrays, dj) if phase is None else Smoke(), (header, network), phase)


def add_baked(path: Path, resolution: int | None = None) -> dict[str, str | int]:
    """Bake a field file and store the voxels in it, so that no later load bakes.

    Returns ``file``, ``voxels`` per side and ``bytes`` of the file. Raises MiNtfError.
    """
    header, tensors = field_file.load(path)
    dj = module(str(mi.variant()))
    network = NetworkField(header, tensors, dj)
    arrays = _baked(str(path), header, network, resolution, dj)
    field_file.add_baked(path, arrays, _stamp(_digest(header, tensors), resolution))
    grid = GridField(arrays, network, dj)
    return {"file": str(path), "voxels": grid.resolution, "bytes": Path(path).stat().st_size}


def _baked(path: str, header: Header, network: NetworkField, resolution: int | None, dj: ModuleType
           ) -> dict[str, np.ndarray]:
    n = resolution or voxels(header, network, dj)
    with log.Work("nrf medium", f"baking {Path(path).name}, {n}³ voxels") as work:
        arrays = bake(network, n, dj, lambda done: work.update(0.75 * done))
        if header.architecture.phase is not None:
            return arrays
        return arrays | measure(GridField(arrays, network, dj), dj, lambda done: work.update(0.75 + 0.25 * done))


def _stamp(digest: str, resolution: int | None) -> str:
    """Return a text that identifies arrays which this version bakes from the tensors with this digest."""
    return f"{VERSION} {resolution or 'default'} {digest}"


def _digest(header: Header, tensors: dict[str, np.ndarray]) -> str:
    """Return the SHA-256 of the architecture and the tensors in memory, hexadecimal."""
    digest = hashlib.sha256(repr(header.architecture).encode())
    for name, value in sorted(tensors.items()):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(value).data)
    return digest.hexdigest()

"""Readers of voxel grids: Mitsuba's ``.vol``, NumPy's ``.npy`` and ``.npz`` with the names of NeRF programs.

The extinction of a grid is linear, 1/scene unit. Arrays have z first, as in ``.vol`` files, unless `order` says else.
OpenVDB files are read by :mod:`mi_ntf.data.vdb`.
"""

import struct
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError, shown

Order = Literal["zyx", "xyz"]
DENSITY = ("density", "densities", "sigma", "sigmas", "sigma_t", "occs", "binaries", "grid", "arr_0")
"""Names of arrays of extinction in ``.npz`` files. ``occs`` and ``binaries``, of nerfacc, begin with the level."""
COLOUR = ("albedo", "color", "colour", "colors", "rgb", "rgbs")
"""Names of arrays of colours, 0 to 1."""
BOTH = ("rgba", "rgb_sigma", "rgbsigma")
"""Names of arrays of four channels, the last of which is the extinction, as from instant-ngp's `get_rgba_on_grid`."""
BOUNDS = ("bounds", "aabb", "aabbs", "bbox", "roi_aabb")
"""Names of the box: 6 numbers, the lower corner first."""
PLENOXELS = ("links", "density_data")
"""Names of arrays in a checkpoint of Plenoxels (svox2)."""
SH_CONSTANT = 0.28209479177387814
"""Value of the first spherical harmonic."""
UNIT = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
"""Box of a grid that has none, as of ``gridvolume``."""
_VOL = struct.Struct("<3sBiiiii6f")
"""Header of a ``.vol`` file: "VOL", version 3, type 1 (float32), voxels along x, y, z, channels, box."""


@dataclass(frozen=True)
class Grid:
    """Voxels of extinction and, maybe, of colour.

    Attributes
    ----------
    density
        (z, y, x) float32, extinction in 1/scene unit.
    bounds
        (2, 3): lower and upper corner of the box that the voxels fill, x first.
    albedo
        (z, y, x, 3) float32 in the same box, linear RGB, 0 to 1; None: not known.
    """

    density: np.ndarray
    bounds: np.ndarray
    albedo: np.ndarray | None = None


def checked(grid: Grid, source: str) -> Grid:
    """Return `grid` in single precision. Raises MiNtfError if a value is out of range or the form is wrong."""
    density = _real(grid.density, f"{source}: the density")
    density = density[..., 0] if density.ndim == 4 and density.shape[3] == 1 else density
    if density.ndim != 3 or 0 in density.shape:
        raise MiNtfError(f"{source}: the density has the shape {density.shape}, expected three axes, z, y, x")
    _within(density, 0, 1e30, f"{source}: the density", "finite numbers from 0; raw outputs of a network need their "
            "activation")
    if not density.any():
        raise MiNtfError(f"{source} has no density above 0, so there is nothing to render")
    bounds = corners(grid.bounds, source)
    albedo = grid.albedo
    if albedo is not None:
        albedo = _real(albedo, f"{source}: the albedo")
        if albedo.ndim == 3 or (albedo.ndim == 4 and albedo.shape[3] == 1):
            albedo = np.repeat(albedo.reshape(*albedo.shape[:3], 1), 3, axis=3)
        if albedo.ndim != 4 or albedo.shape[3] != 3 or 0 in albedo.shape:
            raise MiNtfError(f"{source}: the albedo has the shape {albedo.shape}, expected z, y, x and 3 channels")
        _within(albedo, 0, 1, f"{source}: the albedo", "0 to 1")
    return Grid(density, bounds, albedo)


def corners(bounds: ArrayLike, source: str) -> np.ndarray:
    """Return the corners (2, 3) of a box; raise MiNtfError, whose text begins with `source`, if they are none."""
    box = np.asarray(bounds, np.float64)
    if box.shape != (2, 3) or not (np.abs(box) < 1e30).all() or not (box[1] > box[0]).all():
        raise MiNtfError(f"{source}: the box is {shown(box.tolist())}, expected two corners, the lower one first")
    return box


def read(path: Path, order: Order = "zyx") -> Grid:
    """Read a grid. Raises MiNtfError if the file is missing, damaged or of another form."""
    path = Path(path)
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; give a file that ends in {', '.join(READERS)}")
    reader = READERS.get(path.suffix.lower())
    if reader is None:
        raise MiNtfError(f"{path}: the name ends in {path.suffix!r}, expected {', '.join(READERS)}")
    grid = reader(path)
    if order == "xyz" and path.suffix.lower() in (".npy", ".npz") and not isinstance(grid, _Turned):
        grid = _turned(grid)
    return checked(grid, str(path))


def read_albedo(path: Path, order: Order = "zyx") -> np.ndarray:
    """Read the albedo (z, y, x, channels) of a ``.vol`` or ``.npy`` file; its box is not used. Raises MiNtfError.

    `order` is that of the axes of ``.npy`` files.
    """
    path = Path(path)
    if not path.is_file() or path.suffix.lower() not in (".vol", ".npy"):
        raise MiNtfError(f"{path} is no albedo; give a number, r,g,b, or a .vol or .npy file of 1 or 3 channels")
    if path.suffix.lower() == ".vol":
        return _vol_values(path)[0]
    values = _npy(path)
    return values.swapaxes(0, 2) if order == "xyz" and values.ndim in (3, 4) else values


def write_vol(path: Path, density: np.ndarray, bounds: np.ndarray) -> None:
    """Write (z, y, x) as a ``.vol`` file of one channel; raise MiNtfError if that fails."""
    z, y, x = density.shape
    files.write(path, _VOL.pack(b"VOL", 3, 1, x, y, z, 1, *np.asarray(bounds, np.float64).ravel()),
                np.ascontiguousarray(density, "<f4").tobytes())


def _read_vol(path: Path) -> Grid:
    values, bounds = _vol_values(path)
    if values.shape[3] != 1 and not (values == values[..., :1]).all():
        raise MiNtfError(f"{path} has another extinction in each of {values.shape[3]} channels, which one "
                         "transmittance cannot hold; give a file of one channel, and the colours with --albedo")
    return Grid(values[..., 0], bounds)


def _vol_values(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return the values (z, y, x, channels) and the box of a ``.vol`` file."""
    data = path.read_bytes()
    if len(data) < _VOL.size or data[:3] != b"VOL":
        raise MiNtfError(f"{path} is no .vol file of Mitsuba (it does not begin with VOL); give another file")
    _, version, kind, x, y, z, channels, *box = _VOL.unpack_from(data)
    if version != 3 or kind != 1:
        raise MiNtfError(f"{path} is a .vol file of version {version} and type {kind}; version 3 and type 1, float32, "
                         "are read, as by Mitsuba")
    size = x * y * z * channels
    if min(x, y, z) < 1 or channels not in (1, 3) or len(data) != _VOL.size + 4 * size:
        raise MiNtfError(f"{path} says {x} × {y} × {z} voxels of {channels} channels (1 or 3 are read) and has "
                         f"{len(data)} bytes; the file is damaged, write it anew")
    values = np.frombuffer(data, "<f4", size, _VOL.size).reshape(z, y, x, channels)
    bounds = np.array(box).reshape(2, 3)
    return values, bounds if np.isfinite(bounds).all() and (bounds[1] > bounds[0]).all() else UNIT


def _read_npy(path: Path) -> Grid:
    values = _npy(path)
    if values.ndim == 4 and values.shape[3] == 4:
        return Grid(values[..., 3], UNIT, values[..., :3])
    return Grid(values[..., 0] if values.ndim == 4 and values.shape[3] == 1 else values, UNIT)


def _npy(path: Path) -> np.ndarray:
    with _damage(path):
        values: np.ndarray = np.array(np.load(path, mmap_mode="r", allow_pickle=False))
        return values


class _Turned(Grid):
    """A grid whose program has x first, whatever the option says; its arrays have z first already."""


def _read_npz(path: Path) -> Grid:
    with _damage(path), _Npz(path) as arrays:
        keys = {name.rpartition(".")[2].lower(): name for name in arrays}
        if all(name in keys for name in PLENOXELS):
            return _plenoxels({name: arrays[key] for name, key in keys.items()})
        density, colour, both, bounds = ([name for name in names if name in keys]
                                         for names in (DENSITY, COLOUR, BOTH, BOUNDS))
        if not density and not both:
            raise MiNtfError(f"{path} has the arrays {shown(', '.join(arrays))}, none of which is a density; name it "
                             f"one of {', '.join(DENSITY + BOTH)} (colours: {', '.join(COLOUR)}; "
                             f"box: {', '.join(BOUNDS)})")
        box = _box(arrays[keys[bounds[0]]]) if bounds else UNIT
        if not density:
            values = arrays[keys[both[0]]]
            if values.ndim != 4 or values.shape[3] != 4:
                raise MiNtfError(f"{path}: {both[0]} has the shape {values.shape}, expected three axes and 4 channels")
            return Grid(values[..., 3], box, values[..., :3])
        values = arrays[keys[density[0]]]
        if density[0] in ("occs", "binaries"):
            sides = arrays[keys["resolution"]] if "resolution" in keys else None
            return _turned(Grid(_finest(values, sides, path), box))
        return Grid(values, box, arrays[keys[colour[0]]] if colour else None)


def _finest(values: np.ndarray, sides: np.ndarray | None, path: Path) -> np.ndarray:
    """Return the innermost level (x, y, z) of nerfacc's ``occs``, a flat array, or ``binaries``."""
    if values.ndim == 4:
        first: np.ndarray = values[0]
        return first
    if sides is None or np.size(sides) != 3 or np.prod(sides) > values.size:
        raise MiNtfError(f"{path}: occs is flat, and needs nerfacc's array `resolution` of 3 numbers beside it")
    x, y, z = (int(n) for n in np.ravel(sides))
    level: np.ndarray = values.ravel()[: x * y * z].reshape(x, y, z)
    return level


def _plenoxels(arrays: Mapping[str, np.ndarray]) -> Grid:
    """Return a checkpoint of Plenoxels: sparse voxels, x first, with the mean colour of their harmonics."""
    links = arrays["links"]
    known = links >= 0
    density = np.zeros(links.shape, np.float32)
    density[known] = np.maximum(arrays["density_data"].reshape(-1)[links[known]], 0)
    colour = None
    if "sh_data" in arrays:
        harmonics = arrays["sh_data"]
        first = harmonics[:, [k * harmonics.shape[1] // 3 for k in range(3)]].astype(np.float32)
        colour = np.zeros((*links.shape, 3), np.float32)
        colour[known] = np.clip(0.5 + SH_CONSTANT * first[links[known]], 0, 1)
    centre, radius = (np.broadcast_to(np.asarray(arrays.get(name, value), np.float64).ravel(), 3)
                      for name, value in (("center", 0.0), ("radius", 1.0)))
    return _turned(Grid(density, np.stack([centre - radius, centre + radius]), colour))


def _turned(grid: Grid) -> Grid:
    """Return a grid of arrays with x first, with z first."""
    albedo = grid.albedo
    if grid.density.ndim != 3 or (albedo is not None and albedo.ndim not in (3, 4)):
        return grid  # refused by `checked`
    return _Turned(grid.density.transpose(2, 1, 0), grid.bounds,
                   None if albedo is None else np.moveaxis(albedo, (0, 1, 2), (2, 1, 0)))


def _box(values: np.ndarray) -> np.ndarray:
    """Return the first box of an array of one or more."""
    return values.ravel()[:6].astype(np.float64).reshape(2, 3)


class _Npz(Mapping[str, np.ndarray]):
    """Arrays of a ``.npz`` file, none of which is larger than its part of the file."""

    def __init__(self, path: Path) -> None:
        self._file = zipfile.ZipFile(path)
        self._names = {info.filename.removesuffix(".npy"): info for info in self._file.infolist()}

    def __enter__(self) -> "_Npz":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> np.ndarray:
        info = self._names[name]
        with self._file.open(info) as file:
            version = np.lib.format.read_magic(file)
            header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
            shape, _, dtype = header(file)
            if int(np.prod([int(n) for n in shape], dtype=object)) * dtype.itemsize > info.file_size:
                raise ValueError(f"the array {name} is cut off")
        with self._file.open(info) as file:
            values: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
        return values


@contextmanager
def _damage(path: Path) -> Iterator[None]:
    """Turn any error of NumPy or of the archive into one sentence: damaged files raise a dozen types."""
    try:
        yield
    except MiNtfError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise MiNtfError(f"{path} is no array file of NumPy or is damaged ({reason}); save it anew "
                         "with numpy") from None


def _real(values: np.ndarray, name: str) -> np.ndarray:
    values = np.asarray(values)
    if values.dtype.kind not in "fiub":
        raise MiNtfError(f"{name} is of type {values.dtype}, expected real numbers")
    with np.errstate(over="ignore"):
        return np.ascontiguousarray(values, np.float32)


def _within(values: np.ndarray, low: float, high: float, name: str, expected: str) -> None:
    bad = np.count_nonzero(~((values >= low) & (values <= high)))
    if bad:
        raise MiNtfError(f"{name} has {bad} values outside the range, expected {expected}")


def scaled(grid: Grid, factor: float) -> Grid:
    """Return `grid` with its extinction times `factor`."""
    return replace(grid, density=grid.density * np.float32(factor))


def _read_vdb(path: Path) -> Grid:
    from mi_ntf.data.vdb import read

    return Grid(*read(path))


READERS = {".vol": _read_vol, ".npz": _read_npz, ".npy": _read_npy, ".vdb": _read_vdb}
"""Ending of a file → function that reads its grid."""

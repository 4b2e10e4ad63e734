"""`mi-ntf import`: a grid of another program as a field of voxels."""

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from mi_ntf.core import files, progress, voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.ops import Tensors
from mi_ntf.core.voxels import Voxels
from mi_ntf.data import grids
from mi_ntf.data.grids import Grid
from mi_ntf.infer import bricks


@dataclass(frozen=True)
class Imported:
    """Figures of an import: voxels along x, y and z, the box, and the range of the extinction, 1/scene unit."""

    file: str
    voxels: list[int]
    low: list[float]
    high: list[float]
    extinction: float
    phase: float
    bytes: int


def import_grid(source: Path, output: Path, scale: float = 1.0, albedo: str | None = None, phase: float = 0.0,
                bounds: str | None = None, order: grids.Order = "zyx") -> Imported:
    """Write the grid of `source` as a field of voxels.

    Parameters
    ----------
    source
        A ``.vol``, ``.npz``, ``.npy`` or ``.vdb`` file (:mod:`mi_ntf.data.grids`).
    output
        The field file.
    scale
        Factor of the extinction.
    albedo
        A number, three numbers r,g,b, or a ``.vol`` or ``.npy`` file, in place of the file's own colours; without
        either, 1.
    phase
        Asymmetry g of the phase function.
    bounds
        Six numbers x0,y0,z0,x1,y1,z1 in place of the file's box.
    order
        Order of the axes in ``.npz`` and ``.npy`` files.

    Raises
    ------
    MiNtfError
        If the file is damaged, or an option is out of range.
    """
    files.check(output, (".safetensors",))
    if not 0 < scale < 1e30:
        raise MiNtfError(f"--scale is {scale:g}, expected a positive number")
    with progress.Stage(f"importing {source}"):
        grid = grids.scaled(grids.read(source, order), scale)
        constant: ArrayLike = 1.0
        if albedo is not None:
            numbers = _numbers(albedo)
            constant = 1.0 if numbers is None else _triple(numbers)
            grid = Grid(grid.density, grid.bounds, None if numbers else grids.read_albedo(Path(albedo), order))
        if bounds is not None:
            grid = Grid(grid.density, box_of(bounds), grid.albedo)
        contents = of_grid(grids.checked(grid, str(source)), constant, phase, source.name)
        voxels.save(output, *contents)
        header = contents[0]
    return Imported(str(output), list(header.counts), list(header.low), list(header.high),
                    float(grid.density.max()), phase, output.stat().st_size)


def of_grid(grid: Grid, albedo: ArrayLike = 1.0, phase: float = 0.0, source: str = "an array"
            ) -> tuple[Voxels, Tensors, Tensors | None]:
    """Return header, density and reflectance of a field of voxels, the arguments of :func:`mi_ntf.core.voxels.save`.

    `grid` is a checked one; `albedo` counts where it has none. Where a voxel has an optical depth above
    ``bricks.OPAQUE`` and 65 times the median density, its density is lowered to the larger of both limits. Raises
    MiNtfError if a number is out of range.
    """
    constant = np.asarray(albedo, np.float64)
    if constant.shape not in ((), (1,), (3,)):
        raise MiNtfError(f"the albedo has {constant.size} numbers, expected one or three")
    red, green, blue = (float(v) for v in np.broadcast_to(constant, 3))
    if not all(0 <= value <= 1 for value in (red, green, blue)):
        raise MiNtfError(f"the albedo is {constant.tolist()}, expected 0 to 1")
    if not abs(phase) <= voxels.MAX_PHASE:
        raise MiNtfError(f"the phase function's g is {phase:g}, expected −{voxels.MAX_PHASE} to {voxels.MAX_PHASE}")
    density, colour = _at_least_two(grid.density), grid.albedo
    matter = density > 0
    limit = bricks.OPAQUE / (np.ptp(grid.bounds, axis=0) / density.shape[::-1]).min()
    if density.max() > limit:
        # A few outliers of a network would take the digits of all others. The median keeps three of voxels' 16 bits.
        density = np.minimum(density, np.float32(max(limit, 0xFFFF / 1000 * np.median(density[matter]))))
    reflectance = None
    if colour is not None:
        colour = _at_least_two(colour)
        same = colour.shape[:3] == density.shape
        reflectance = bricks.of_dense(colour, matter if same else np.ones(colour.shape[:3], bool))
    low, high = ((float(x), float(y), float(z)) for x, y, z in grid.bounds)
    header = Voxels(low, high, _counts(density), None if colour is None else _counts(colour), float(phase),
                    (red, green, blue), provenance={"source": source})
    return header, bricks.of_dense(density[..., None], matter), reflectance


def box_of(bounds: str) -> np.ndarray:
    """Return the corners (2, 3) of the text x0,y0,z0,x1,y1,z1. Raises MiNtfError if it is something else."""
    box = _numbers(bounds)
    if box is None or len(box) != 6:
        raise MiNtfError(f"--bounds is {bounds}, expected six numbers, x0,y0,z0,x1,y1,z1")
    return grids.corners(np.array(box).reshape(2, 3), "--bounds")


def print_summary(report: Imported) -> None:
    """Print the file, the figures of the grid, and the use of it."""
    low, high = ("(" + ", ".join(f"{value:.6g}" for value in corner) + ")" for corner in (report.low, report.high))
    print(f"field: {report.file} ({' × '.join(map(str, report.voxels))} voxels from {low} to {high})",
          f"extinction: up to {report.extinction:.4g} per scene unit; phase function of asymmetry {report.phase:g}",
          f"next: mi-ntf info {shlex.quote(report.file)} prints the sphere of the nrf medium", sep="\n")


def _at_least_two(values: np.ndarray) -> np.ndarray:
    """Return `values` with the single voxel of a constant grid repeated: bricks have at least two along an axis."""
    return np.repeat(values, 2, axis=0) if max(values.shape[:3]) == 1 else values


def _counts(values: np.ndarray) -> tuple[int, int, int]:
    z, y, x = values.shape[:3]
    return x, y, z


def _numbers(text: str) -> list[float] | None:
    """Return the numbers of a text with commas, None if it is something else."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return None


def _triple(numbers: list[float]) -> ArrayLike:
    if len(numbers) not in (1, 3):
        raise MiNtfError(f"--albedo has {len(numbers)} numbers, expected one, or r,g,b")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1], numbers[2])

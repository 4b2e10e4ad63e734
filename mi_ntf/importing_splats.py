"""`mi-ntf import` of Gaussian splats: a field of voxels of a ``.ply`` or ``.spz`` file."""

import shlex
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mi_ntf.core import files, progress, voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.ops import Tensors
from mi_ntf.core.splats import Splats
from mi_ntf.core.voxels import Voxels
from mi_ntf.data import splat_files
from mi_ntf.importing import box_of
from mi_ntf.infer import splat_field
from mi_ntf.infer.backend import module

LEAST, MOST = 16, 2048
"""Range of the number of voxels along the longest side."""


@dataclass(frozen=True)
class ImportedSplats:
    """Figures of an import: number of splats, voxels along x, y and z, and the box, scene units.

    `crowded`: corners of a much smaller box that holds all splats but a few (:func:`splat_field.crowded_box`), or None.
    """

    file: str
    splats: int
    voxels: list[int]
    low: list[float]
    high: list[float]
    voxel: float
    emissive: bool
    bytes: int
    crowded: list[list[float]] | None = None


def import_splats(source: Path, output: Path, resolution: int | None = None, emissive: bool = False,
                  bounds: str | None = None) -> ImportedSplats:
    """Write the splats of `source` as a field of voxels.

    Parameters
    ----------
    source
        A ``.ply`` or ``.spz`` file (:mod:`mi_ntf.data.splat_files`).
    output
        The field file.
    resolution
        Voxels along the longest side; by default it follows from the splats (:mod:`mi_ntf.infer.splat_field`).
    emissive
        Keep the colours as emitted radiance; otherwise they are the albedo.
    bounds
        Six numbers x0,y0,z0,x1,y1,z1: corners of a box outside of which splats are left out.

    Raises
    ------
    MiNtfError
        If the file is damaged, or an option is out of range.
    """
    files.check(output, (".safetensors",))
    with progress.Stage(f"importing {source}"):
        splats, box = splat_files.read(source), None if bounds is None else box_of(bounds)
        header, density, reflectance = of_splats(splats, resolution, emissive, source.name, box)
        voxels.save(output, header, density, reflectance)
    crowded = splat_field.crowded_box(splats) if box is None else None
    size = (header.high[0] - header.low[0]) / header.counts[0]
    return ImportedSplats(str(output), header.provenance["splats"], list(header.counts), list(header.low),
                          list(header.high), size, emissive, output.stat().st_size,
                          None if crowded is None else crowded.tolist())


def of_splats(splats: Splats, resolution: int | None = None, emissive: bool = False, source: str = "splats",
              bounds: np.ndarray | None = None) -> tuple[Voxels, Tensors, Tensors]:
    """Return header, density and reflectance of a field of voxels, the arguments of :func:`mi_ntf.core.voxels.save`.

    The options are those of :func:`import_splats`. Raises MiNtfError if one is out of range.
    """
    if resolution is not None and not LEAST <= resolution <= MOST:
        raise MiNtfError(f"resolution is {resolution}, expected {LEAST} to {MOST} voxels along the longest side")
    return splat_field.voxelised(splats, module("llvm_ad_rgb"), resolution, emissive, {"source": source},
                                 bounds=bounds)


def print_summary(report: ImportedSplats) -> None:
    """Print the file, the figures of the voxels, and the use of it."""
    low, high = ("(" + ", ".join(f"{value:.6g}" for value in corner) + ")" for corner in (report.low, report.high))
    colours = "kept as emission" if report.emissive else "taken as albedo; light that is baked into them stays"
    print(f"field: {report.file} ({' × '.join(map(str, report.voxels))} voxels from {low} to {high})",
          f"splats: {report.splats} with an opacity that counts; their colours are {colours}",
          sep="\n")
    if report.crowded:
        smaller = np.ptp([report.low, report.high], axis=0).max() / np.ptp(report.crowded, axis=0).max()
        corners = ",".join(f"{value:.4g}" for corner in report.crowded for value in corner)
        print(f"note: a few splats are far away from the others and make the box {smaller:.0f} times as long, so its "
              f"voxels may be coarse; --bounds={corners} leaves them out")
    print(f"next: mi-ntf info {shlex.quote(report.file)} prints the sphere of the nrf medium")

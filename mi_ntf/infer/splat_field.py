"""Gaussian splats as a field of kind *voxels*: extinction, normals and colours."""

from types import ModuleType

import numpy as np

from ..core import splat_normals
from ..core.errors import MiNtfError, shown
from ..core.ops import Tensors
from ..core.splats import Splats
from ..core.voxels import Voxels
from .bake import Progress
from .bricks import OPAQUE, SIDE
from .splat_voxels import Lattice, SplatSums

VISIBLE = 1 / 255
"""Smallest opacity of a splat that is imported, as in the rasteriser of Kerbl et al. (2023)."""
THIN = 0.1
"""Fraction of the splats' cross-section that may be thinner than a voxel."""
FINER = 0.8
"""Length of a voxel over the splats' shortest axis."""
MOST_VOXELS = 2048
"""Largest default number of voxels along the longest side."""
COARSER = 2
"""Least length of the reflectance's voxels over that of the density's."""
MOST_COLOURS = 192
"""Largest number of the reflectance's voxels along the longest side."""
COLOUR_BLUR = 0.75
"""Smallest standard deviation of a splat in the reflectance, voxels: wide enough that no density lies outside of it."""
FAR = 0.01
"""Fraction of the splats on either side, along each axis, that may be far away from the others."""
MOST_BLOCKS = 64_000
"""Number of blocks of density above which the voxels become longer, which bounds the memory."""


def voxelised(splats: Splats, dj: ModuleType, resolution: int | None = None, emissive: bool = False,
              provenance: dict[str, object] | None = None, progress: Progress = lambda done: None,
              bounds: np.ndarray | None = None) -> tuple[Voxels, Tensors, Tensors]:
    """Return header, density and reflectance of a field of kind *voxels* (:func:`mi_ntf.core.voxels.save`).

    Parameters
    ----------
    splats
        The splats.
    dj
        Dr.Jit module of the back end.
    resolution
        Voxels along the longest side. By default a voxel has ``FINER`` of the splats' shortest axis, of which ``THIN``
        of the splats fall short, weighted by cross-section. There are at most ``MOST_VOXELS``, and fewer if more than
        ``MOST_BLOCKS`` blocks hold matter.
    emissive
        Keep the colours as emitted radiance; otherwise they are the albedo of a diffuse surface.
    provenance
        Free-form JSON about the origin.
    progress
        Receives the fraction of the work that is done.
    bounds
        Corners (2, 3) of a box. Splats with centres outside are left out, and the others end at its sides.
    """
    splats = splats.take(np.flatnonzero(splats.opacities >= VISIBLE))
    if not len(splats):
        raise MiNtfError(f"no splat has an opacity of {VISIBLE:.4f} or more, so there is nothing to import")
    if bounds is not None:
        splats = splats.take(np.flatnonzero(((splats.centres >= bounds[0]) & (splats.centres <= bounds[1])).all(1)))
        if not len(splats):
            raise MiNtfError(f"no splat has its centre in the box {shown(bounds.tolist())}, so there is nothing to "
                             "import; give a larger one")
    lattice = lattice_of(splats, resolution, bounds=bounds)
    sums = SplatSums(splats, lattice, dj)
    longer = 1.0
    while sums.count > MOST_BLOCKS:  # the blocks of a surface grow with the square of the resolution
        longer *= 1.03 * (sums.count / MOST_BLOCKS) ** 0.5
        lattice = lattice_of(splats, resolution, longer, bounds)
        sums = SplatSums(splats, lattice, dj)
    progress(0.2)
    density = sums.bricks(np.minimum(sums.total(), np.float32(OPAQUE / lattice.size)))
    del sums
    progress(0.6)
    coarse, reflectance = _reflectance(splats, lattice, dj, emissive)
    x, y, z = lattice.low.tolist()
    header = Voxels((x, y, z), tuple(lattice.high.tolist()), tuple(lattice.counts.tolist()),
                    tuple(coarse.counts.tolist()), 0.0 if emissive else None, emissive=emissive,
                    provenance={"splats": len(splats)} | (provenance or {}))
    return header, density, reflectance


def crowded_box(splats: Splats) -> np.ndarray | None:
    """Return the corners (2, 3) of the box of all `splats` but a few that are far away from the others.

    None if that box is at least half as long as the box of all. It leaves out ``FAR`` of the splats on either side
    along each axis, and is longer by a tenth on either side than that.
    """
    low, high = np.quantile(splats.centres.astype(np.float64), (FAR, 1 - FAR), axis=0)
    box = np.stack([low - 0.1 * (high - low), high + 0.1 * (high - low)])
    longest = np.ptp(splats.centres.astype(np.float64), axis=0).max()
    return box if 2 * (box[1] - box[0]).max() < longest and (box[1] > box[0]).all() else None


def lattice_of(splats: Splats, resolution: int | None, longer: float = 1.0, bounds: np.ndarray | None = None
               ) -> Lattice:
    """Return voxels that hold all `splats`, with an empty one at each side.

    `longer`: factor of their length; `bounds`: corners (2, 3) of a box that they do not leave by more than an edge.
    """
    shortest = splats.scales.min(1).astype(np.float64)
    reach = splats.reach(3.0)
    low, high = (splats.centres - reach).min(0), (splats.centres + reach).max(0)
    if bounds is not None:
        low, high = np.maximum(low, bounds[0]), np.minimum(high, bounds[1])
    longest = float((high - low).max())
    # A splat larger than the box, such as one of the sky, has no more weight than the box is wide.
    scales = np.minimum(np.sort(splats.scales.astype(np.float64), axis=1), longest)
    area = splats.opacities * scales[:, 1] * scales[:, 2]
    order = np.argsort(shortest)
    thin = shortest[order][np.searchsorted(np.cumsum(area[order]), THIN * area.sum())]
    finest = min(max(FINER * thin, longest / MOST_VOXELS), longest / SIDE)
    size = longer * (longest / resolution if resolution else finest)
    counts = np.ceil((high - low) / size).astype(int) + 6  # the splats' tails, and an empty voxel
    ratio = _ratio(splats, counts, size)
    counts = -(-counts // ratio) * ratio
    return Lattice((low + high) / 2 - counts * size / 2, size, counts)


def _ratio(splats: Splats, counts: np.ndarray, size: float) -> int:
    """Return the length of the reflectance's voxels over that of the density's: ``FINER`` of the middle axis."""
    middle = float(np.median(np.sort(splats.scales, axis=1)[:, 1]))
    fewest = min(8, int(counts.max()) // 16)  # of a few large splats
    return max(COARSER, -(-int(counts.max()) // MOST_COLOURS), min(int(np.ceil(FINER * middle / size)), fewest))


def _reflectance(splats: Splats, lattice: Lattice, dj: ModuleType, emissive: bool) -> tuple[Lattice, Tensors]:
    """Return coarser voxels of the reflectance and their bricks: means of the splats, weighted by extinction."""
    ratio = _ratio(splats, lattice.counts, lattice.size)
    coarse = Lattice(lattice.low, lattice.size * ratio, lattice.counts // ratio)
    sums = SplatSums(splats, coarse, dj, COLOUR_BLUR, faintest=1e-30)
    values = splats.colours
    if not emissive:
        values = np.concatenate([splat_normals.outward(splats, lattice.low, lattice.high), values], 1)
    weight, *channels = sums.total(values)
    for channel in channels:
        np.divide(channel, weight, out=channel, where=weight > 0)
    if not emissive:
        channels += [np.ones_like(weight), np.zeros_like(weight)]
    return coarse, sums.bricks(channels)

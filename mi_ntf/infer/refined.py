"""Refinement of a field: differences at voxels, which are added to what its networks give."""

from collections.abc import Mapping
from types import ModuleType

import drjit as dr
import numpy as np

from ..core.errors import MiNtfError
from ..core.field_file import REFINED_CHANNELS
from ..core.microfacet import MIN_ROUGHNESS
from ..core.ops import normalize
from . import ops
from .bricks import SIDE, Bricks, bricks_per_side, octants_of, pack
from .types import Float, Reflected, Vector


def changed(reflected: Reflected, change: Mapping[str, list[Float]]) -> Reflected:
    """Return the reflectance `reflected` with the differences `change`, channels by name."""
    normal, albedo, roughness, specular = reflected
    if "normal" in change:
        normal = normalize(ops, tuple(a + b for a, b in zip(normal, change["normal"], strict=True)))
    if "albedo" in change:
        albedo = tuple(a + b for a, b in zip(albedo, change["albedo"], strict=True))
    if "roughness" in change:
        roughness = dr.clip(roughness + change["roughness"][0], MIN_ROUGHNESS, 1)
    if "specular" in change:
        specular = tuple(dr.clip(a + b, 0, 1) for a, b in zip(specular, change["specular"], strict=True))
    return normal, albedo, roughness, specular


class Refinement:
    """Differences of a field's quantities, trilinear between the voxels of bricks.

    `arrays`: those of the bricks. A reflectance has 3 channels (albedo) or 7 (albedo, roughness, specular weight), a
    density one, that of ln σ. Raises MiNtfError if they cannot be bricks.
    """

    def __init__(self, arrays: dict[str, np.ndarray], dj: ModuleType):
        try:
            self._bricks = Bricks(arrays, dj)
        except ValueError:
            raise MiNtfError("the field's refinement is damaged; make the file anew with `mi-ntf refine`") from None

    def at(self, p: Vector) -> list[Float]:
        """Return the differences at `p` by channels."""
        return self._bricks.at(self._bricks.place(p))

    def apply(self, reflected: Reflected, p: Vector) -> Reflected:
        """Return `reflected`, the networks' reflectance at `p`, with the differences there."""
        values = self.at(p)
        change, first = {}, 0
        for name, count in REFINED_CHANNELS.items():
            if first < len(values):
                change[name] = values[first : first + count]
            first += count
        return changed(reflected, change)


def packed(values: np.ndarray, places: np.ndarray, resolution: int, matter: np.ndarray | None = None
           ) -> dict[str, np.ndarray]:
    """Return the arrays of bricks of values at voxels, in the blocks of :class:`mi_ntf.infer.blocks.Blocks`.

    Parameters
    ----------
    values
        (blocks, 8, 8, 8, channels); voxels have z first and x last.
    places
        (blocks, 3): places of the blocks, x first, in blocks.
    resolution
        Voxels along an edge of the volume.
    matter
        (blocks, 8, 8, 8): mask of the voxels that count. Bricks without one are left out, and read 0. The default is
        the mask of voxels with a value that is not 0.
    """
    mask = (values != 0).any(-1) if matter is None else matter
    side = bricks_per_side(resolution)
    slots = np.full((side + 1,) * 3, -1)
    slots[tuple(places[:, ::-1].T)] = np.arange(len(places))
    inner = places[(places < side).all(1)][:, ::-1]  # z first
    bricks = np.zeros((len(inner), values.shape[-1], *(SIDE + 1,) * 3), np.float32)
    dense = np.zeros((len(inner), *(SIDE + 1,) * 3), bool)
    for offset in np.ndindex(2, 2, 2):
        slot = slots[tuple((inner + offset).T)]
        there = np.flatnonzero(slot >= 0)
        to = tuple(slice(SIDE, None) if o else slice(0, SIDE) for o in offset)
        z, y, x = (slice(0, 1) if o else slice(None) for o in offset)
        in_bricks, in_dense = (there, slice(None), *to), (there, *to)
        bricks[in_bricks] = np.moveaxis(values[slot[there]][:, z, y, x], -1, 1)
        dense[in_dense] = mask[slot[there]][:, z, y, x]
    occupied = dense.any((1, 2, 3))
    arrays = pack(bricks[occupied], inner[occupied], octants_of(dense[occupied]), resolution, 0.0)
    low, step = arrays["range"]
    level = np.round(-low / step)  # of 0, which the empty brick holds where others are negative
    arrays["range"] = np.stack([-level * step, step]).astype(np.float32)
    arrays["words"][0] = (level.astype(np.uint32) * 0x10001)[:, None, None, None]
    return arrays

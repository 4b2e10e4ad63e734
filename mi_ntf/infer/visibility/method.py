"""Interface of a visibility method: its construction, and the lights that it serves.

Every method's file ends with its own :class:`Method`; :data:`mi_ntf.infer.visibility.REGISTRY` lists them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from ..lights import LightTable

COARSEST, FINE_MAPS = 192, 4
"""Texels along a side of the maps of many lights, at least; number of lights whose maps are as fine as the voxels."""


def resolution_for(lights: int, voxels: int) -> int:
    """Return the texels along a side of the maps of so many lights, where the user names none.

    Texels are as fine as the field's voxels, of which there are `voxels` across its sphere, for up to ``FINE_MAPS``
    lights. More lights share as many texels.
    """
    return max(COARSEST, int(voxels * min(1, FINE_MAPS / max(lights, 1)) ** 0.5))


@dataclass(frozen=True)
class Options:
    """`step`: length of the camera march's cells, field units; `map_resolution`: texels along a map's side;
    `map_source`: ``field`` or ``network``; `map_components`: logistics a texel that the field's march is fitted by, 1
    or 2 (the network has its own number); `half`: in half precision; `map_memory`: MiB that the maps or volumes of one
    part of the lights may take; `map_file`: EXR of `mi-ntf bake` that holds the maps, or none; `cache`: maps are kept
    for the next frame and on disk (:mod:`mi_ntf.render.maps.map_cache`)."""

    step: float
    map_resolution: int = COARSEST
    map_source: str = "field"
    map_components: int = 1
    half: bool = False
    map_memory: float = 1024.0
    map_file: str = ""
    cache: bool = False


class Keep(Protocol):
    """Cache of a method's maps, in memory and on disk.

    Parameters
    ----------
    make
        Makes the map: ``make()`` computes the texels, ``make(values)`` takes those that were kept.
    channels
        Numbers of a texel; a light has the square of ``map_resolution`` texels.
    step
        Length of a step of the march that fills the map, in field units.
    directions, options
        Table of directions of a field's own maps, which do not depend on the lights, and their options.
    make_part
        Makes the map of some rows of the light table, where the texels of each light do not depend on other lights.
    """

    def __call__(self, make: Callable[..., Any], *, channels: int, step: float, directions: LightTable | None = None,
                 options: Options | None = None, make_part: Callable[[np.ndarray], Any] | None = None) -> Any: ...


@dataclass(frozen=True)
class Method:
    """
    name         what users type
    summary      what it does, a sentence
    build        ``(medium, table, options, dj, keep)`` → an object with ``tau``, in the medium's field coordinates, and
                 with ``stream``, an opaque seed that the renderer sets, where lookups draw numbers.
                 `table`: the :class:`mi_ntf.infer.lights.LightTable` that what is held per light is made for; None:
                 the others. `keep`: a :class:`Keep`
    rays         ``(lights, resolution)`` → number of rays, each marched or asked for once, that fill what is held for a
                 field; `lights` of the table, `resolution` texels along a side of their maps
    numbers      ``(medium, table, options)`` → what is held for each of the squared ``map_resolution`` rays of a light,
                 in float32 numbers
    per_field    `rays` and `numbers` are of all that is held for a field, whatever the lights
    dials        properties of the integrator that it reads
    resolution   ``(lights, voxels)`` → texels along a side where the user names none
    drawn        name of the method that serves lights which are drawn at random, and all other rays; "": itself
    derivatives  whether places of lights have derivatives
    automatic    true if ``auto`` may take it under a limit
    needs        ``(medium)`` → whether the field can serve it
    """

    name: str
    summary: str
    build: Callable[..., Any]
    rays: Callable[[int, int], int] = lambda lights, resolution: 0
    numbers: Callable[[Any, Any, Options], int] | None = None
    per_field: bool = False
    dials: tuple[str, ...] = ()
    resolution: Callable[[int, int], int] = resolution_for
    drawn: str = ""
    derivatives: bool = False
    automatic: bool = False
    needs: Callable[[Any], bool] = lambda medium: True

    @property
    def for_drawn(self) -> str:
        """Name of the method that serves drawn lights where this one serves the table's."""
        return self.drawn or self.name


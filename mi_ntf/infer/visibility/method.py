"""Interface of a visibility method: its construction, and the lights that it serves.

The file of each method ends with its own :class:`Method`; :data:`mi_ntf.infer.visibility.REGISTRY` lists them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from ...core.architecture import Header
from ..grid import Density, GridField
from ..lights import LightTable
from ..network import NetworkField
from ..skin import Smoke, Softness
from ..tuning import FINE_MAPS, MIN_MAP_RESOLUTION
from ..types import Visibility
from ..volume import VoxelVolume

if TYPE_CHECKING:
    from .transmittance_map import TransmittanceMap


def resolution_for(lights: int, texels: int) -> int:
    """Return the default number of texels along a side of the maps of so many lights.

    Texels are as fine as the field's voxels and skins, `texels` across its sphere, for up to ``FINE_MAPS`` lights:
    coarser ones show as ribs beside shadows. More lights share as many texels, but at least the square of
    ``MIN_MAP_RESOLUTION`` each.
    """
    return max(MIN_MAP_RESOLUTION, int(texels * min(1, FINE_MAPS / max(lights, 1)) ** 0.5))


@dataclass(frozen=True)
class Options:
    """Options of a visibility method."""

    step: float
    """Length of the camera march's cells, field units."""
    map_resolution: int = MIN_MAP_RESOLUTION
    """Texels along a map's side."""
    map_source: str = "field"
    """``field`` or ``network``."""
    map_components: int = 1
    """Logistics per texel that are fitted to the field's march, 1 or 2; the network has its own number."""
    half: bool = False
    """Store half precision."""
    map_memory: float = 1024.0
    """Largest size of the maps or volumes of one run of lights, MiB."""
    map_file: str = ""
    """EXR of `mi-ntf bake` that holds the maps; empty: none."""
    cache: bool = False
    """Keep maps for the next frame and on disk (:mod:`mi_ntf.render.maps.map_cache`)."""


class Field(Protocol):
    """A field file as its networks and as voxels, with the softness of its skins."""

    @property
    def header(self) -> Header: ...  # noqa: D102
    @property
    def network(self) -> NetworkField: ...  # noqa: D102
    @property
    def grid(self) -> GridField | VoxelVolume: ...  # noqa: D102
    @property
    def softness(self) -> Softness | Smoke: ...  # noqa: D102
    @property
    def trained(self) -> bool: ...  # noqa: D102


class Medium(Protocol):
    """A field in a scene; `source`: its voxels or its networks, whichever the medium uses."""

    @property
    def field(self) -> Field: ...  # noqa: D102
    @property
    def source(self) -> Density: ...  # noqa: D102


class Keep(Protocol):
    """Cache of a method's maps, in memory and on disk.

    Parameters
    ----------
    make
        Makes the map: ``make()`` computes the texels, ``make(values)`` takes stored ones.
    channels
        Numbers of a texel; a light has the square of ``map_resolution`` texels.
    step
        Length of a step of the march that fills the map, in field units.
    directions, options
        Table of directions of a field's own maps, which do not depend on the lights, and their options.
    make_part
        Makes the map of some rows of the light table, where the texels of each light do not depend on other lights.
    """

    def __call__(self, make: "Callable[..., TransmittanceMap]", *, channels: int, step: float,
                 directions: LightTable | None = None, options: Options = ...,
                 make_part: "Callable[[np.ndarray], TransmittanceMap] | None" = None) -> "TransmittanceMap":
        """Return the map."""


class Build(Protocol):
    """Constructor of a visibility method in the medium's field coordinates; None: no shadows.

    `table`: lights for which per-light tables are made; None for methods that serve sampled lights. A method whose
    lookups draw random numbers has an attribute ``stream``, an opaque seed that the renderer sets.
    """

    def __call__(self, medium: Medium, table: Any, options: Options, dj: ModuleType, keep: Keep,
                 /) -> Visibility | None:
        """Return the method."""


@dataclass(frozen=True)
class Method:
    """A visibility method."""

    name: str
    """Value of the property `visibility`."""
    summary: str
    """Sentence for users."""
    build: Build
    rays: Callable[[int, int], int] = lambda lights, resolution: 0
    """``(lights, resolution)`` → number of rays, each marched or queried once, that fill the tables of a field."""
    numbers: Callable[[Medium, LightTable, Options], int] | None = None
    """``(medium, table, options)`` → float32 numbers for each of the squared ``map_resolution`` rays of a light."""
    per_field: bool = False
    """`rays` and `numbers` count all tables of a field, independently of the lights."""
    dials: tuple[str, ...] = ()
    """Properties of the integrator that the method reads."""
    resolution: Callable[[int, int], int] = resolution_for
    """``(lights, voxels)`` → default number of texels along a side."""
    sampled: str = ""
    """Name of the method that serves sampled lights and all other rays; empty: itself."""
    derivatives: bool = False
    """Derivatives by the places of lights are supported."""
    automatic: bool = False
    """``auto`` may choose the method under a limit."""
    needs: Callable[[Medium], bool] = lambda medium: True
    """Return True if the method can serve the field."""

    @property
    def for_sampled(self) -> str:
        """Name of the method that serves sampled lights where this one serves the table's."""
        return self.sampled or self.name

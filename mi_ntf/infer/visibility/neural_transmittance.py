"""``neural_transmittance``: the ray network, evaluated once for each ray of an atlas.

The network gives the transmittance along any whole ray as logistics (Shafiei et al. 2021). Its
outputs for the three million rays of :mod:`mi_ntf.infer.visibility.transmittance_atlas` are stored once per field. A
point and light then cost a lookup in the atlas.
"""

from dataclasses import replace
from types import ModuleType

from ..lights import LightTable
from . import transmittance_atlas
from .method import Keep, Medium, Method, Options


def build(medium: Medium, table: LightTable | None, options: Options, dj: ModuleType,
          keep: Keep) -> transmittance_atlas.TransmittanceAtlas:
    """Build the method, see :class:`mi_ntf.infer.visibility.method.Method`."""
    return transmittance_atlas.build(medium, table, replace(options, map_source="network"), dj, keep)


def numbers(medium: Medium, lights: LightTable | None, options: Options) -> int:
    """Return the size of all maps, in float32 numbers."""
    return transmittance_atlas.numbers(medium, lights, replace(options, map_source="network"))


METHOD = Method(
    name="neural_transmittance",
    summary="per field, the ray network's answers for the rays of an atlas, each asked once; looked up as in one",
    build=build,
    rays=transmittance_atlas.METHOD.rays,
    numbers=numbers,
    per_field=True,
    dials=("map_file",),
    needs=lambda medium: medium.field.trained,
)

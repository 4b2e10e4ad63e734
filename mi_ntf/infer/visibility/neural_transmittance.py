"""``neural_transmittance``: the ray network, asked once for each ray of an atlas, and remembered.

What is learned: the transmittance along any whole ray, as logistics (Shafiei et al. 2021; method.md, section 4). What
is remembered: its answers for the rays of :mod:`mi_ntf.infer.visibility.transmittance_atlas`, three million of them.
What it costs: those queries once per field, then an atlas lookup per point and light.
"""

from dataclasses import replace

from . import transmittance_atlas
from .method import Method


def build(medium, table, options, dj, keep):
    """See :class:`mi_ntf.infer.visibility.method.Method`."""
    return transmittance_atlas.build(medium, table, replace(options, map_source="network"), dj, keep)


def numbers(medium, lights, options) -> int:
    """float32 numbers of all maps."""
    return transmittance_atlas.numbers(medium, lights, replace(options, map_source="network"))


METHOD = Method(
    name="neural_transmittance",
    summary="per field, the ray network's answers for the rays of an atlas, each asked once; looked up as in one",
    build=build,
    rays=transmittance_atlas.METHOD.rays,
    numbers=numbers,
    per_field=True,
    dials=("map_file",),
)

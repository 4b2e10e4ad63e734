"""Visibility methods: the transmittance of a field between points and lights, one file a method.

All methods have the interface :class:`mi_ntf.infer.types.Visibility`. Their construction does the work that depends on
the field and the lights alone.
"""

from . import (
    neural_transmittance,
    none,
    ray_network,
    raymarch,
    transmittance_atlas,
    transmittance_map,
    transmittance_volume,
    visibility_mlp,
)
from .method import Method

REGISTRY: dict[str, Method] = {
    module.METHOD.name: module.METHOD
    for module in (raymarch, transmittance_volume, neural_transmittance, transmittance_map, transmittance_atlas,
                   ray_network, visibility_mlp, none)
}
"""Name → :class:`mi_ntf.infer.visibility.method.Method` of all methods."""


def names() -> tuple[str, ...]:
    """Return the legal values of the property `visibility`."""
    return (*REGISTRY, "auto")

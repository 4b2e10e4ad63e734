"""How much of a light reaches a point: one file a method, all behind one call.

    tau(x, wi, distance, index, active) → τ in [0, 1]

`x` shading point and `wi` unit vector towards the light (3-tuples, field coordinates); `distance` to the light, field
units, infinite for directional lights; `index` the light's row in the table, of one drawn at random 1 if it is a sun
(:data:`mi_ntf.infer.visibility.marched_suns.DRAWN`), else 0. `active` masks lanes whose result is unused. Construction
does the work that depends on the lights alone.
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

REGISTRY = {
    module.METHOD.name: module.METHOD
    for module in (raymarch, transmittance_volume, neural_transmittance, transmittance_map, transmittance_atlas,
                   ray_network, visibility_mlp, none)
}
"""Name → :class:`mi_ntf.infer.visibility.method.Method`. What is not in here does not exist."""


def names() -> tuple[str, ...]:
    """Every name that users may type."""
    return (*REGISTRY, "auto")

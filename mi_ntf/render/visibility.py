"""From a method's name, a medium and its lights to the object whose ``tau`` answers for them: the one place that knows
what each method of :mod:`mi_ntf.infer.visibility` is built from. Integrator and ``ntf`` emitter share it."""

import math
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ..infer import profile
from ..infer.visibility import (
    map_source,
    neural_transmittance,
    raymarch,
    transmittance_map,
    transmittance_volume,
    visibility_mlp,
)


@dataclass(frozen=True)
class Options:
    """`step`: length of the camera march's cells, field units; `map_resolution`: texels along a map's side;
    `map_source`: ``field`` or ``network``; `map_components`: logistics a texel that the field's march is fitted by, 1
    or 2 (the network has its own number)."""

    step: float
    map_resolution: int = 128
    map_source: str = "field"
    map_components: int = 1


def build(method: str, medium, table, options: Options):
    """The visibility `method` (never ``auto``) of `medium`, in its field coordinates; None for ``none``.

    `table`: the :class:`mi_ntf.infer.lights.LightTable` of the same coordinates, which maps and volumes are made for;
    others do not read it.
    """
    source, field = medium.source, medium.field
    if method == "none":
        return None
    if method == "raymarch":
        steps = tuple(dr.opaque(mi.Float, s) for s in raymarch.default_steps(options.step))
        return raymarch.RayMarch(source.density, field.grid, steps)
    if method == "visibility_mlp":
        return visibility_mlp.VisibilityMLP(field.network)
    if method == "transmittance_volume":
        depths = math.ceil(2 / options.step)
        return transmittance_volume.TransmittanceVolume(
            table, options.map_resolution, depths, field.grid.hull, source.density, mi
        )
    network = method == "neural_transmittance" or options.map_source == "network"
    step = options.step * (profile.FOR_NETWORKS if network else 1)
    reader = profile.DepthProfile(source.density, field.grid, dr.opaque(mi.Float, step))
    if method == "neural_transmittance":
        return neural_transmittance.NeuralTransmittance(field.network, reader)
    inside = bool((table.is_point & (np.linalg.norm(table.where, axis=1) < 1)).any())
    fit = (
        map_source.network_source(field.network, reader, inside)
        if network
        else map_source.field_source(reader, options.map_components)
    )
    return transmittance_map.TransmittanceMap(table, options.map_resolution, field.grid.hull, fit, mi)

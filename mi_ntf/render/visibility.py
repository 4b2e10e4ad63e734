"""From a method's name, a medium and its lights to the object whose ``tau`` answers for them: the one place that knows
what each method of :mod:`mi_ntf.infer.visibility` is built from. Integrator and ``ntf`` emitter share it."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..infer import profile
from ..infer.visibility import neural_transmittance, raymarch, transmittance_map


@dataclass(frozen=True)
class Options:
    """`step`: length of the camera march's cells, field units; `map_resolution`: texels along a map's side;
    `map_source`: ``field`` or ``network``."""

    step: float
    map_resolution: int = 128
    map_source: str = "field"


def build(method: str, medium, table, options: Options):
    """The visibility `method` (never ``auto``) of `medium`, in its field coordinates; None for ``none``.

    `table`: the :class:`mi_ntf.infer.lights.LightTable` of the same coordinates, which maps are made for; others do
    not read it.
    """
    source, field = medium.source, medium.field
    if method == "none":
        return None
    if method == "raymarch":
        steps = tuple(dr.opaque(mi.Float, s) for s in raymarch.default_steps(options.step))
        return raymarch.RayMarch(source.density, field.grid, steps)
    reader = profile.DepthProfile(source.density, field.grid, dr.opaque(mi.Float, options.step))
    if method == "neural_transmittance":
        return neural_transmittance.NeuralTransmittance(field.network, reader)
    fit = (
        transmittance_map.network_source(field.network, reader)
        if options.map_source == "network"
        else transmittance_map.field_source(reader)
    )
    return transmittance_map.TransmittanceMap(table, options.map_resolution, field.grid.hull, fit, mi)

"""The ``ntf`` emitter."""

import drjit as dr
import mitsuba as mi

from ..core.errors import MiNtfError
from .visibility import Options, build

METHODS = ("neural_transmittance", "raymarch", "none")
STEP = 2 / 384


def emitter_class() -> type:
    """The plugin class for the current variant."""

    class NTFEmitter(mi.Emitter):
        """A light seen through a field (``ntf``).

        =========== ======= ========================================================================================
        parameter   type    meaning
        =========== ======= ========================================================================================
        (nested)    emitter the light
        (nested)    medium  the ``nrf`` medium in its way, nested or by ``<ref>``
        visibility  string  ``neural_transmittance``, ``raymarch``, ``none``; ``auto`` is the first (default: auto)
        =========== ======= ========================================================================================

        Whatever samples this emitter receives the nested light's radiance times the field's transmittance from the lit
        point to the light, so that a field casts its shadow on ordinary surfaces under stock ``path`` and ``direct``.

        Does not support: being hit by BSDF-sampled rays, hence being seen directly or in mirrors (the shading point,
        and with it the transmittance, is known to emitter sampling alone); importance sampling by position (particle
        tracers).
        """

        def __init__(self, props):
            visibility = props.get("visibility", "auto")
            if visibility not in (*METHODS, "auto"):
                raise MiNtfError(
                    f'ntf emitter: visibility is "{visibility}", expected one of auto, {", ".join(METHODS)}'
                )
            nested = [props[name] for name in list(props.keys()) if name not in ("visibility", "to_world")]
            self.inner = _single([o for o in nested if isinstance(o, mi.Emitter)], "emitter", "a light to wrap")
            self.medium = _single([o for o in nested if getattr(o, "is_nrf", False)], "medium", "an nrf medium")
            mi.Emitter.__init__(self, props)
            self.visibility = "neural_transmittance" if visibility == "auto" else visibility
            self.m_flags = int(mi.EmitterFlags.DeltaPosition)
            self.m_needs_sample_2 = self.m_needs_sample_3 = False

        def sample_direction(self, it, sample, active=True):
            ds, weight = self.inner.sample_direction(it, sample, active)
            frame = self.medium.frame
            x, d = frame.point_to_field(it.p), frame.direction_to_field(ds.d)
            far = dr.norm(it.p - mi.Point3f(frame.origin.tolist())) + frame.length
            infinite = mi.has_flag(self.inner.flags(), mi.EmitterFlags.Infinite) or mi.has_flag(
                self.inner.flags(), mi.EmitterFlags.DeltaDirection
            )
            if infinite:
                # The nested light never learns the scene's size: it believes in a unit sphere and would end shadow rays
                # there.
                ds.dist = dr.maximum(ds.dist, 1000 * far)
                ds.p = it.p + ds.d * ds.dist
            method = build(self.visibility, self.medium, None, Options(STEP))
            tau = method.tau(x, d, ds.dist / frame.length, mi.UInt32(0), active) if method else 1
            ds.delta = dr.ones(mi.Bool, dr.width(ds.pdf))
            ds.emitter = mi.EmitterPtr(self)
            return ds, weight * tau

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(0)

        def eval_direction(self, it, ds, active=True):
            return mi.Spectrum(0)

        def eval(self, si, active=True):
            return mi.Spectrum(0)

        def bbox(self):
            return self.inner.bbox()

        def to_string(self):
            return f"NTFEmitter[\n  visibility = {self.visibility},\n  emitter = {self.inner}\n]"

    return NTFEmitter


def _single(objects: list, kind: str, what: str):
    if len(objects) != 1:
        raise MiNtfError(f"ntf emitter: found {len(objects)} nested {kind} objects, needs exactly one: {what}")
    return objects[0]

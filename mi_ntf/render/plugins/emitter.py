"""The ``ntf`` emitter."""

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.visibility import REGISTRY, names, outside
from ...infer.visibility.marched_suns import DRAWN
from ...infer.visibility.method import Options, resolution_for
from ..lights import environment, light_checks, light_rows, scene_lights
from ..lights.emitter_samples import SHARP
from ..maps import building
from . import properties

STEP = 2 / 384
NEVER = 1e18
"""Density that emitter sampling claims for every direction, 1/sr: beside it, the power heuristic gives light that a
BSDF-sampled ray finds no weight. Its square is still a float32."""


def emitter_class() -> type:
    """The plugin class for the current variant."""

    class NTFEmitter(mi.Emitter):
        """A light seen through a field (``ntf``).

        =============== ======= ====================================================================================
        parameter       type    meaning
        =============== ======= ====================================================================================
        (nested)        emitter the light: any emitter, another ``ntf`` for a second field; ``area`` where this emitter
                                stands inside the shape that shines
        (nested)        medium  the ``nrf`` medium in its way, nested or by ``<ref>``
        visibility      string  ``raymarch``, ``transmittance_atlas``, ``neural_transmittance``, ``ray_network``,
                                ``visibility_mlp``, ``none``; of lights that are one point or direction also
                                ``transmittance_map``, ``transmittance_volume``; ``auto`` is ``transmittance_map`` for
                                those and ``transmittance_atlas`` for others (default: auto)
        sampling_weight float   as of any emitter: share of the samples drawn from all (default: 1)
        =============== ======= ====================================================================================

        Whatever samples this emitter receives the nested light's radiance times the field's transmittance from the lit
        point to the light, so that a field casts its shadow on ordinary surfaces under stock ``path``, ``direct`` and
        ``prb``. Light reaches surfaces by emitter sampling alone, which knows the lit point; BSDF samples that hit the
        light weigh nothing, so gloss needs more samples than under the bare light. The camera sees an environment or
        area light as it is.

        Pictures can be differentiated by what stock integrators know derivatives of: the light's power and place, and
        the surfaces. The shadows of what moves are marched for it, whatever `visibility` is, unless ``none``. Where
        place is that of a light of one point or direction, ``prb`` knows no derivative and is refused.

        The ``nrf`` integrator takes the nested light bare where the medium is in the scene, since it casts the shadows
        of fields itself. Stock ``volpath`` does too if the medium fills a shape there: give it the bare light.

        Does not support: the field's shadow on what mirrors (delta BSDFs) reflect; importance sampling by position
        (particle tracers).
        """

        def __init__(self, props):
            read = properties.Reader(props, "ntf emitter", properties.EMITTER, nested=True)
            self.visibility = read.choice("visibility", "auto", names())
            read.number("sampling_weight", 1.0, 0.0, 1e30)
            nested = [value for _, value in props.objects()]
            other = [o for o in nested if not (isinstance(o, mi.Emitter) or getattr(o, "is_nrf", False))]
            if other:
                raise MiNtfError(f"ntf emitter: it has no place for a nested {other[0].class_name()}; it takes a light "
                                 "and an nrf medium")
            self.inner = _single([o for o in nested if isinstance(o, mi.Emitter)], "emitter", "a light to wrap")
            self.medium = _single([o for o in nested if getattr(o, "is_nrf", False)], "medium", "an nrf medium")
            mi.Emitter.__init__(self, props)
            # An environment's flags let the camera see it; the shape that shines asks for those of its emitter.
            self.m_flags = int(self.inner.flags())
            self.m_needs_sample_2 = self.m_needs_sample_3 = False
            self.bare = self._drawn_still = False
            self._prepare()

        def _prepare(self):
            light_checks.check(self.inner, scene_lights.kind(self.inner), drawn=True)
            environment.check_unscaled(self.inner)
            if not self.sampling_weight() and not mi.has_flag(self.inner.flags(), mi.EmitterFlags.Delta):
                raise MiNtfError("ntf emitter: sampling_weight is 0, so that BSDF samples alone would find the light, "
                                 "which know nothing of the field's shadow; give it a weight above 0")
            self._drawn = environment.drawable(self.inner)
            self._method = _visibility(self.visibility, self.inner, self.medium)
            self._march = building.build("raymarch", self.medium, None, Options(STEP))

        def sample_direction(self, it, sample, active=True):
            inner = self.attached()
            self._drawn_still = not _attached_place(inner)
            ds, weight = (inner if self.bare else self._drawn).sample_direction(it, sample, active)
            if _is_far(inner):
                # The nested light never learns the scene's size: it believes in a unit sphere and would end shadow rays
                # there.
                frame = self.medium.frame
                reach = dr.norm(it.p - mi.Point3f(frame.origin.tolist())) + frame.length
                ds.dist = dr.maximum(ds.dist, 1000 * reach)
                ds.p = it.p + ds.d * ds.dist
            ds.emitter = mi.EmitterPtr(self)
            if self.bare:
                return ds, weight
            ds.delta = dr.ones(mi.Bool, dr.width(ds.pdf))
            return ds, weight * self._tau(it, ds, active & (ds.pdf > 0))

        def _tau(self, it, ds, active):
            if self._method is None:
                return mi.Float(1)
            frame = self.medium.frame
            distance = mi.Float(dr.inf) if _is_far(self.inner) else ds.dist / frame.length
            x, d = frame.point_to_field(it.p), frame.direction_to_field(ds.d)
            sun = ds.pdf > SHARP  # never that of one light, whose map has the number 0
            # Maps and networks belong to the light's former place, so attached places are marched.
            method = self._march if dr.grad_enabled(x, d, distance) else self._method
            return outside.tau(method, x, d, distance, mi.UInt32(sun), active)

        def attached(self):
            """The nested light; one with a surface shines from the shape that this emitter belongs to."""
            shape = self.get_shape()
            if shape is not None and self.inner.get_shape() is None:
                self.inner.set_shape(shape)
            return self.inner

        def pdf_direction(self, it, ds, active=True):
            if self.bare:
                return self.attached().pdf_direction(it, ds, active)
            hit = mi.Float(0 if mi.has_flag(self.inner.flags(), mi.EmitterFlags.Delta) else NEVER)
            return dr.select(active, hit, 0)

        def eval_direction(self, it, ds, active=True):
            place = _attached_place(self.inner)
            if place and self._drawn_still:
                raise MiNtfError(f"ntf emitter: gradients by {place} of its light: prb leaves them out; render with "
                                 "direct or path, or detach it")
            value = self.attached().eval_direction(it, ds, active)
            return value if self.bare else value * self._tau(it, ds, active)

        def eval(self, si, active=True):
            return self.attached().eval(si, active)

        def bbox(self):
            return self.attached().bbox()

        def traverse(self, callback):
            mi.Emitter.traverse(self, callback)
            callback.put("emitter", self.inner, mi.ParamFlags.Differentiable)

        def parameters_changed(self, keys):
            mi.Emitter.parameters_changed(self, keys)
            self._prepare()

        def to_string(self):
            return f"NTFEmitter[\n  visibility = {self.visibility},\n  emitter = {self.inner}\n]"

    return NTFEmitter


def _visibility(name: str, inner, medium):
    """The method of this `name`, made for the light `inner` behind `medium`; None for ``none``."""
    one, table = _is_one(inner), None
    # The shadow of one light is sharp: its own map sees it better, and is made in a moment.
    auto = "transmittance_map" if one else "transmittance_atlas"
    method = auto if name == "auto" else name
    if REGISTRY[method].drawn:
        kind = scene_lights.kind(inner)
        if not one:
            raise MiNtfError(
                f"ntf emitter: visibility is {method}, which is made for one light, but {kind} shines from many "
                "places; choose raymarch or transmittance_atlas"
            )
        table = scene_lights.rows([(inner, kind)], 1).table(medium.frame)
    options = Options(STEP, resolution_for(1, medium.field.grid.resolution), cache=True)
    found = building.build(method, medium, table, options)
    return building.with_suns(found, DRAWN, medium, table, options) if REGISTRY[method].per_field and not one else found


def _is_one(inner) -> bool:
    """Return True if a light shines from one point or direction."""
    return light_rows.kind(inner).single and scene_lights.is_discrete(inner)


def _attached_place(inner) -> str:
    """Name of the parameter that moves a light of one point or direction, if it carries gradients; else nothing."""
    if not mi.has_flag(inner.flags(), mi.EmitterFlags.Delta):
        return ""
    attached = (key for key, value in mi.traverse(inner)
                if key.split(".")[-1] in ("position", "to_world") and dr.grad_enabled(value))
    return next(attached, "")


def _is_far(emitter) -> bool:
    """Return True for lights at infinity: environments and directional lights."""
    return bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))


def _single(objects: list, kind: str, what: str):
    if len(objects) != 1:
        raise MiNtfError(f"ntf emitter: found {len(objects)} nested {kind} objects, needs exactly one: {what}")
    return objects[0]

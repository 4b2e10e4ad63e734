"""Light with the shadow of a field or of smoke (``ntf``, an emitter).

=============== ======= ======== =========== ======================== ==================================================
parameter       type    default  range       flags                    meaning
=============== ======= ======== =========== ======================== ==================================================
(nested)        emitter required             exposed, differentiable  the light: any emitter, or another ``ntf`` for a
                                                                      second field; ``area`` if this emitter stands
                                                                      inside the shape that shines
(nested)        medium  required             exposed                  the ``nrf`` medium that casts the shadow, or a
                or                                                    sphere or closed mesh with any medium inside;
                shape                                                 nested or by ``<ref>``
visibility      string  auto     see meaning                          ``raymarch``, ``transmittance_atlas``,
                                                                      ``neural_transmittance``, ``ray_network``,
                                                                      ``visibility_mlp``, ``none``; for lights of one
                                                                      point or direction also ``transmittance_map``,
                                                                      ``transmittance_volume``. ``auto`` is
                                                                      ``transmittance_map`` for those and
                                                                      ``transmittance_atlas`` for others.
sampling_weight float   1        0 to 10³⁰                            as for any emitter: its share of the samples of
                                                                      all emitters. 0 is allowed for lights of one point
                                                                      or direction, and switches them off.
=============== ======= ======== =========== ======================== ==================================================

An integrator that samples this emitter receives the radiance of the nested light times the field's transmittance from
the lit point to the light. A field thus casts its shadow on ordinary surfaces under stock ``path``, ``direct`` and
``prb``. The shadow depends on the lit point, which emitter sampling alone knows. BSDF samples that hit the light
therefore have no weight, and gloss needs more samples than under the bare light. The camera sees the bare environment
or area light.

Pictures are differentiable with respect to what stock integrators support: the light's power and place, and the
surfaces. The shadows of moving lights and surfaces are marched then, unless `visibility` is ``none``. ``prb`` has no
derivative with respect to the place of a light of one point or direction, and is refused there.

Smoke and fog of Mitsuba (``homogeneous``, ``heterogeneous``) have no bounds of their own. In place of an ``nrf`` medium
the emitter then holds the shape that they fill, with the medium called ``interior``. A nested shape is not in the
scene, where stock ``path`` would take it for an opaque surface. If it is there by ``<ref>`` too, change its medium by
the key of an ``ntf``: Mitsuba tells no emitter of changes by the key of the scene's shape.

The ``nrf`` integrator takes the bare light if the medium is in the scene, since it casts the shadows of media itself.
Stock ``volpath`` casts them, too, if the medium fills a shape in the scene: give it the bare light.

Does not support: the field's shadow on reflections in mirrors (delta BSDFs); importance sampling by position (particle
tracers).

.. code-block:: xml

    <emitter type="ntf">
        <emitter type="point"> <point name="position" x="1.5" y="2.6" z="2.7"/> </emitter>
        <medium type="nrf"> <string name="filename" value="scenes/statue/field.safetensors"/> </medium>
    </emitter>

.. code-block:: python

    {
        "type": "ntf",
        "light": {"type": "point", "position": [1.5, 2.6, 2.7]},
        "field": {"type": "nrf", "filename": "scenes/statue/field.safetensors"},
    }
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import TypeVar, cast
from weakref import WeakSet

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.types import Array, Color3, Float, Mask, Visibility
from ...infer.visibility import REGISTRY, names, outside
from ...infer.visibility.method import Options, resolution_for
from ..lights import environment, light_checks, light_rows, scene_lights
from ..lights.emitter_samples import SHARP, fully_sampled
from ..maps import building
from ..scene.media import NRFMedium, medium_inside
from . import properties
from .medium import Follower

T = TypeVar("T")

_emitters_by_caster: dict[int, WeakSet[Follower]] = defaultdict(WeakSet)
"""Emitters by the ``id`` of the medium or shape that casts their shadow. An id is used again once they are gone."""
NEVER = 1e18
"""Density of every direction that emitter sampling reports, in 1/sr. The power heuristic then gives no weight to light
on rays of BSDF samples. Its square is still a float32."""


def emitter_class() -> type:
    """Return the plugin class for the current variant."""

    class NTFEmitter(mi.Emitter):
        __doc__ = __doc__

        def __init__(self, props: mi.Properties) -> None:
            read = properties.Reader(props, "ntf emitter", properties.EMITTER, nested=True)
            self.visibility = read.choice("visibility", "auto", names())
            read.number("sampling_weight", 1.0, 0.0, 1e30)
            self.inner, self._caster = _nested([value for _, value in props.objects()])
            mi.Emitter.__init__(self, props)
            # An environment's flags let the camera see it; the shape that shines asks for those of its emitter.
            self.m_flags = int(self.inner.flags())
            self.m_needs_sample_2 = self.m_needs_sample_3 = False
            self.bare = self._sampled_at_rest = self._changing = False
            _emitters_by_caster[id(self._caster)].add(self)
            self._prepare()

        def _prepare(self) -> None:
            light_checks.check(self.inner, scene_lights.kind(self.inner), sampled=True)
            environment.check_unscaled(self.inner)
            self.medium = medium_inside(self._caster) if isinstance(self._caster, mi.Shape) else self._caster
            if not self.sampling_weight() and not mi.has_flag(self.inner.flags(), mi.EmitterFlags.Delta):
                raise MiNtfError("ntf emitter: sampling_weight is 0, so that BSDF samples alone would find the light, "
                                 "which know nothing of the field's shadow; give it a weight above 0")
            self._fully_sampled = fully_sampled(self.inner)
            self._method = _visibility(self.visibility, self.inner, self.medium)
            if hasattr(self.medium, "followers"):
                self.medium.followers.add(self)
            self._march = building.march(self.medium, None, Options(2 / building.samples(self.medium)))

        def follow(self, field_changed: bool) -> None:
            """Adapt to a medium that has moved. Only the map of the light, if there is one, depends on the place."""
            if field_changed or REGISTRY[_method_name(self.visibility, self.inner)].sampled:
                self._prepare()

        def sample_direction(self, it: mi.Interaction3f, sample: mi.Point2f, active: Mask = True
                             ) -> tuple[mi.DirectionSample3f, Color3]:
            if self.medium.attached_log_density is not None:
                raise MiNtfError("ntf emitter: gradients by the density of its medium: not supported, its shadow would "
                                 "leave them out; detach it, or render with the nrf integrator")
            inner = self.attached()
            self._sampled_at_rest = not _attached_place(inner)
            ds: Array
            weight: Color3
            ds, weight = (inner if self.bare else self._fully_sampled).sample_direction(it, sample, active)
            if _is_far(inner):
                # The nested light does not know the scene's size. It would end shadow rays at a unit sphere.
                frame = self.medium.frame
                reach = dr.norm(it.p - frame.point_to_world((0.0, 0.0, 0.0))) + frame.unit
                ds.dist = dr.maximum(ds.dist, 1000 * reach)
                ds.p = it.p + ds.d * ds.dist
            ds.emitter = mi.EmitterPtr(self)
            if self.bare:
                return ds, weight
            ds.delta = dr.ones(mi.Bool, dr.width(ds.pdf))
            return ds, weight * self._tau(it, ds, active & (ds.pdf > 0))

        def _tau(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask) -> Float:
            if self._method is None:
                return mi.Float(1)
            frame = self.medium.frame
            distance: Float = mi.Float(dr.inf) if _is_far(self.inner) else ds.dist / frame.unit
            x, d = frame.point_to_field(it.p), frame.direction_to_field(ds.d)
            sun = ds.pdf > SHARP
            # Maps and networks belong to fixed places, so rays with gradients are marched.
            method = self._march if dr.grad_enabled(x, d, distance) else self._method
            return outside.tau(method, x, d, distance, mi.UInt32(0), active, sun)

        def attached(self) -> mi.Emitter:
            """Return the nested light; one with a surface shines from the shape to which this emitter belongs."""
            shape = self.get_shape()
            if shape is not None and self.inner.get_shape() is None:
                self.inner.set_shape(shape)
            return self.inner

        def pdf_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True) -> Float:
            if self.bare:
                return self.attached().pdf_direction(it, ds, active)
            density = mi.Float(0 if mi.has_flag(self.inner.flags(), mi.EmitterFlags.Delta) else NEVER)
            return dr.select(active, density, 0)

        def eval_direction(self, it: mi.Interaction3f, ds: mi.DirectionSample3f, active: Mask = True) -> Color3:
            place = _attached_place(self.inner)
            if place and self._sampled_at_rest:
                raise MiNtfError(f"ntf emitter: gradients by {place} of its light: prb leaves them out; render with "
                                 "direct or path, or detach it")
            value: Color3 = self.attached().eval_direction(it, ds, active)
            return value if self.bare else value * self._tau(it, ds, active)

        def eval(self, si: mi.SurfaceInteraction3f, active: Mask = True) -> Color3:
            return self.attached().eval(si, active)

        def bbox(self) -> mi.ScalarBoundingBox3f:
            return self.attached().bbox()

        def traverse(self, callback: mi.TraversalCallback) -> None:
            mi.Emitter.traverse(self, callback)
            callback.put("emitter", self.inner, mi.ParamFlags.Differentiable)
            if isinstance(self._caster, mi.Shape):
                callback.put("shape", self._caster, mi.ParamFlags.NonDifferentiable)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            if self._changing:  # the base class, when it is called from Python, calls this method once more
                mi.Emitter.parameters_changed(self, keys)
                return
            self._changing = True
            mi.Emitter.parameters_changed(self, keys)
            self._changing = False
            before = self.medium.source
            self._prepare()
            if self.medium.source is not before:  # Mitsuba tells one alone of the emitters behind a shape
                for emitter in _emitters_by_caster[id(self._caster)] - {self}:
                    emitter.follow(True)

        def to_string(self) -> str:
            return f"NTFEmitter[\n  visibility = {self.visibility},\n  emitter = {self.inner}\n]"

    return NTFEmitter


def _visibility(name: str, inner: mi.Emitter, medium: NRFMedium) -> Visibility | None:
    """Return the visibility method `name` for the light `inner` behind `medium`; None for ``none``."""
    one, table, method = _is_one(inner), None, _method_name(name, inner)
    if REGISTRY[method].sampled:
        kind = scene_lights.kind(inner)
        if not one:
            raise MiNtfError(
                f"ntf emitter: visibility is {method}, which is made for one light, but {kind} shines from many "
                "places; choose raymarch or transmittance_atlas"
            )
        table = scene_lights.rows([(inner, kind)], 1).table(medium.frame)
    options = Options(2 / building.samples(medium), resolution_for(1, building.texels(medium)), cache=True,
                      map_components=1 if medium.field.softness.opaque else 2)
    visibility = building.build(method, medium, table, options)
    if visibility and REGISTRY[method].per_field and not one:
        return building.with_suns(visibility, None, medium, table, options)
    return visibility


def _method_name(name: str, inner: mi.Emitter) -> str:
    """Return the visibility method `name` for the light `inner`, by name also where it is ``auto``."""
    # A light of one place has a sharp shadow, for which its own map is best.
    auto = "transmittance_map" if _is_one(inner) else "transmittance_atlas"
    return auto if name == "auto" else name


def _is_one(inner: mi.Emitter) -> bool:
    """Return True if a light shines from one point or direction."""
    return light_rows.kind(inner).single and scene_lights.is_discrete(inner)


def _attached_place(inner: mi.Emitter) -> str:
    """Return the name of the parameter that moves a light of one point or direction, if it carries gradients."""
    if not mi.has_flag(inner.flags(), mi.EmitterFlags.Delta):
        return ""
    attached = (key for key, value in mi.traverse(inner)
                if key.split(".")[-1] in ("position", "to_world") and dr.grad_enabled(value))
    return next(attached, "")


def _is_far(emitter: mi.Emitter) -> bool:
    """Return True for lights at infinity: environments and directional lights."""
    return bool(mi.has_flag(emitter.flags(), mi.EmitterFlags.Infinite))


def _nested(objects: Sequence[mi.Object]) -> tuple[mi.Emitter, NRFMedium | mi.Shape]:
    """Return the light to wrap and what casts its shadow: a medium, or a shape with a medium inside."""
    lights = [o for o in objects if isinstance(o, mi.Emitter)]
    casters = [o for o in objects if getattr(o, "is_nrf", False) or isinstance(o, mi.Shape)]
    other = [o for o in objects if o not in lights + casters]
    if other:
        raise MiNtfError(f"ntf emitter: it has no place for a nested {other[0].class_name()}; it takes a light and an "
                         "nrf medium, or a light and a shape with a medium inside")
    light = _single(lights, "emitter", "a light to wrap")
    caster = _single(casters, "medium or shape", "an nrf medium, or a shape with a medium inside")
    return light, cast("NRFMedium | mi.Shape", caster)


def _single(objects: Sequence[T], kind: str, role: str) -> T:
    """Return the only one of `objects`. Raises MiNtfError if there are none or several."""
    if len(objects) != 1:
        raise MiNtfError(f"ntf emitter: found {len(objects)} nested {kind} objects, needs exactly one: {role}")
    return objects[0]

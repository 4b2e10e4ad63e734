"""Ordinary shapes around the fields: their shadows, what rays hit, and how they reflect the scene's light."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Protocol
from weakref import WeakKeyDictionary, WeakMethod

import drjit as dr
import mitsuba as mi

from ...infer.types import Array, Color3, Float, Mask, Ray, Vector3
from ..lights import environment
from ..lights.emitter_samples import sharp
from ..scene.media import lets_light_through, shape_groups
from ..scene.recent import Recent, Version
from ..scene.traversal import traverse

_scenes: WeakKeyDictionary[mi.Integrator, Recent[mi.Scene]] = WeakKeyDictionary()


class Transmittance(Protocol):
    """Function that returns the transmittance of the fields along scene rays."""

    def __call__(self, p: Vector3, d: Vector3, distance: Float, active: Mask, sun: Mask = False) -> Float:
        """Return the transmittance from `p` along `d`, as far as `distance`; `sun`: of a light that is marched."""


class Surfaces:
    """The ordinary shapes of `scene`, without the fields' bounding shapes.

    Direct light is estimated as in ``volpath``: by emitter and BSDF sampling, weighted by the power heuristic (Veach
    1997). Each sample is attenuated by the fields and by the null transmission of shapes on its way.

    shapes         those shapes
    hide_emitters  the camera does not see shapes that emit light
    transmittance  transmittance of the fields, a method of the composition that owns these surfaces
    transmitting   light may cross a shape
    shining        the camera sees a shape that emits light
    """

    def __init__(self, scene: mi.Scene, shapes: Sequence[mi.Shape], hide_emitters: bool,
                 transmittance: Transmittance) -> None:
        environment.check_unscaled(scene.environment())
        # A strong reference would be a cycle, and keep scene and maps in memory until the garbage collector runs.
        self.scene, self._transmittance = scene, WeakMethod(transmittance)
        groups = shape_groups(scene)
        self._all = _scene_of([*groups, *shapes], scene.integrator())
        visible = [s for s in shapes if not (hide_emitters and s.is_emitter())]
        self._visible = self._all
        if len(visible) < len(shapes):
            self._visible = _scene_of([*groups, *visible], scene.integrator())
        self.transmitting = lets_light_through(scene)
        self.shining = any(s.is_emitter() for s in visible)
        deltas = (mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in scene.emitters())
        self.lights_can_be_hit = not all(deltas)

    @property
    def transmittance(self) -> Transmittance:
        """Transmittance of the fields."""
        method = self._transmittance()
        assert method
        return method

    def first(self, ray: Ray) -> Array:
        """Return the first intersection of camera rays, a PreliminaryIntersection3f."""
        coherent: Mask = True
        return self._visible.ray_intersect_preliminary(ray, coherent=coherent)

    def intersect(self, ray: Ray) -> Array:
        """Return the next intersection of rays on their way through the scene, a SurfaceInteraction3f."""
        return self._all.ray_intersect(ray)

    def transmission(self, p: Vector3, d: Vector3, distance: Float, active: Mask) -> Array:
        """Return the transmission of the shapes from `p` along `d`, as far as `distance`.

        It is 0 or 1, or a colour if they are `transmitting`.
        """
        maxt = dr.detach(distance) * (1 - mi.math.ShadowEpsilon)
        arguments: Array = dr.detach(p), dr.detach(d), maxt, 0.0, []
        return self._transmission(mi.Ray3f(*arguments), active)

    def _transmission(self, ray: Ray, active: Mask) -> Array:
        """Return the product of the null transmissions of all shapes that a ray crosses."""
        if not self.transmitting:
            return dr.select(self._all.ray_test(ray, active), mi.Float(0), 1)

        def cross(ray: Ray, through: Color3, active: Mask) -> tuple[Ray, Color3, Mask]:
            si = self._all.ray_intersect(ray, active)
            active = active & si.is_valid()
            value = si.bsdf().eval_null_transmission(si, active)
            through = dr.select(active, through * value, through)
            onward = si.spawn_ray(ray.d)
            onward.maxt = ray.maxt - si.t
            return onward, through, active & (dr.max(through) > 0)

        n = max(dr.width(ray.o), dr.width(ray.d), dr.width(active))
        state: Array = mi.Ray3f(ray), dr.ones(mi.Color3f, n), mi.Bool(active)

        def crossing(ray: Ray, through: Color3, active: Mask) -> Mask:
            return active

        suspended: Array = dr.suspend_grad
        with suspended():
            return dr.while_loop(state=state, cond=crossing, body=cross, label="null surfaces")[1]

    def direct(self, si: Array, rng: Array, active: Mask) -> Color3:
        """Return the reflected radiance of one emitter sample."""
        bsdf = si.bsdf()
        active = active & (mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth))
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        ds, weight = self.scene.sample_emitter_direction(si, u, False, active)
        active = active & (ds.pdf > 0)
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, si.to_local(ds.d), active)
        active = active & (dr.max(value) > 0)
        value = value * weight * dr.select(ds.delta, 1, _power(ds.pdf, pdf))
        value = value * self._transmission(si.spawn_ray_to(ds.p), active)
        return dr.select(active, value * self.transmittance(si.p, ds.d, ds.dist, active, sharp(ds)), 0)

    def scatter(self, si: Array, rng: Array, active: Mask) -> tuple[Ray, Color3, Float, Mask]:
        """Return ``(ray, weight, pdf, crossed)`` of a BSDF sample.

        The pdf is −1 for specular reflection and refraction. `crossed` marks samples of the null component, whose rays
        continue straight on.
        """
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, rng.next_float32(), u, active)
        pdf = dr.select(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), -1, sample.pdf)
        crossed = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        return si.spawn_ray(si.to_world(sample.wo)), dr.select(active, weight, 0), pdf, crossed

    def emission(self, si: Array, ray: Ray, pdf: Float, active: Mask, distance: Float | None = None) -> Color3:
        """Return the radiance along BSDF-sampled rays from the emitter that they reach at `si`.

        `pdf`: density of the sample; `distance`: from the point of that sample to the ray's origin, None for 0.
        """
        emitter = si.emitter(self.scene)
        start = dr.zeros(mi.Interaction3f, dr.width(ray.o))
        start.p = ray.o if distance is None else ray.o - distance * ray.d
        ds = mi.DirectionSample3f(self.scene, si, start)
        other = self.scene.pdf_emitter_direction(start, ds, active & (pdf > 0))
        value = emitter.eval(si, active) * dr.select(pdf < 0, 1, _power(pdf, other))
        active = active & (dr.max(value) > 0)
        return dr.select(active, value * self.transmittance(ray.o, ray.d, si.t, active), 0)


def _scene_of(shapes: list[mi.Shape], integrator: mi.Integrator) -> mi.Scene:
    """Return a scene of these very shapes alone, which rays can intersect.

    Its acceleration structure may take longer to build than the picture, so it is reused until a shape changes. It is
    stored as long as `integrator`, that of the shapes' scene, exists. Mitsuba's own integrators have no weak
    references, so nothing is stored for them.
    """
    if not hasattr(integrator, "__weakref__"):
        return _built(shapes)
    recent = _scenes.setdefault(integrator, Recent(2))
    # The stored scene holds the shapes, so that no other shapes get their addresses.
    return recent.of((*(s.ptr for s in shapes), Version(*shapes, owners=mi.Shape)), lambda: _built(shapes))


@functools.cache
def _unused_emitter(_variant: str) -> mi.Emitter:
    """Return one emitter for all scenes of shapes.

    The number of emitters that exist is part of the code of Dr.Jit's kernels: a further one for each scene would
    compile them again.
    """
    emitter: mi.Emitter = mi.load_dict({"type": "point"})
    return emitter


def _built(shapes: list[mi.Shape]) -> mi.Scene:
    """Return a new scene of `shapes`, which keep their names."""
    # Mitsuba refuses a scene in which all emitters have the weight 0, as those of these shapes may. It also gives
    # objects the names of their keys.
    names = [shape.id() for shape in shapes]
    if str(mi.variant()).startswith("cuda"):
        _mark_groups_changed(shapes)
    objects = {"unused": _unused_emitter(str(mi.variant())), **{f"shape_{i}": s for i, s in enumerate(shapes)}}
    try:
        scene: mi.Scene = mi.load_dict({"type": "scene", **objects}, optimize=False)
        return scene
    finally:
        for shape, name in zip(shapes, names, strict=True):
            shape.set_id(name)


def _mark_groups_changed(shapes: Sequence[mi.Shape]) -> None:
    """Make the next scene of `shapes` build the geometry of their groups.

    Mitsuba 3.9 builds a group on a GPU for the first scene that holds it, and again only if a shape in it has changed
    (`scene_optix.inl`). A second scene of the same group would read outside of its memory.
    """
    for group in (s for s in shapes if s.class_name() == "ShapeGroupPlugin"):
        for part in (node for node in traverse(group).hierarchy if isinstance(node, mi.Shape) and node is not group):
            # Normals are named as well, since a mesh would otherwise compute them anew.
            part.parameters_changed(["to_world", "vertex_positions", "vertex_normals", "positions", "normals"])
        group.parameters_changed([])


def _power(a: Float, b: Float) -> Float:
    """Return the power heuristic's weight of a sample of density `a`; `b`: density of the other technique."""
    return dr.select(a > 0, a * a / (a * a + b * b), 0)

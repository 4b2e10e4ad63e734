"""Ordinary shapes around the fields: what hides them, what shades them, and how they reflect the scene's light."""

from weakref import WeakKeyDictionary

import drjit as dr
import mitsuba as mi

from ..lights import environment
from ..lights.emitter_samples import sharp
from ..lights.recent import Recent, Version
from ..scene.media import lets_light_through, shape_groups

_scenes: WeakKeyDictionary = WeakKeyDictionary()


class Surfaces:
    """The ordinary shapes of `scene`, without the fields' bounding shapes.

    shapes         those shapes
    hide_emitters  whether shapes that shine are left out of what the camera sees
    transmittance  callable ``(p, d, distance, active, sun=False)``: what the fields let through, scene coordinates

    Direct light as stock ``volpath`` estimates it: emitter and BSDF sampling, weighted by the power heuristic (Veach
    1997), each dimmed by the fields on its way and by the null transmission of shapes (`transmitting`: some may have
    any).
    """

    def __init__(self, scene, shapes: list, hide_emitters: bool, transmittance):
        environment.check_unscaled(scene.environment())
        self.scene, self.transmittance = scene, transmittance
        groups = shape_groups(scene)
        self._all = _scene_of(groups + shapes, scene.integrator())
        seen = [s for s in shapes if not (hide_emitters and s.is_emitter())]
        self._seen = self._all if len(seen) == len(shapes) else _scene_of(groups + seen, scene.integrator())
        self.transmitting = lets_light_through(scene)
        self.shining = any(s.is_emitter() for s in seen)
        deltas = (mi.has_flag(e.flags(), mi.EmitterFlags.Delta) for e in scene.emitters())
        self.lights_can_be_hit = not all(deltas)

    def first(self, ray):
        """The camera rays' intersection, a PreliminaryIntersection3f."""
        return self._seen.ray_intersect_preliminary(ray, coherent=True)

    def intersect(self, ray):
        """The next intersection of rays on their way through the scene, a SurfaceInteraction3f."""
        return self._all.ray_intersect(ray)

    def transmission(self, p, d, distance, active):
        """Return the share of the light at `distance` along `d` that the shapes let through to `p`: a Float of 0 or 1,
        or a Color3f where they are `transmitting`."""
        far = dr.detach(distance) * (1 - mi.math.ShadowEpsilon)
        return self._transmission(mi.Ray3f(dr.detach(p), dr.detach(d), far, 0.0, []), active)

    def _transmission(self, ray, active):
        """:meth:`transmission` along a whole ray: the product of the null transmissions of all that it crosses."""
        if not self.transmitting:
            return dr.select(self._all.ray_test(ray, active), mi.Float(0), 1)

        def cross(ray, through, active):
            si = self._all.ray_intersect(ray, active)
            active = active & si.is_valid()
            value = si.bsdf().eval_null_transmission(si, active)
            through = dr.select(active, through * value, through)
            onward = si.spawn_ray(ray.d)
            onward.maxt = ray.maxt - si.t
            return onward, through, active & (dr.max(through) > 0)

        n = max(dr.width(ray.o), dr.width(ray.d), dr.width(active))
        with dr.suspend_grad():
            return dr.while_loop(
                state=(mi.Ray3f(ray), dr.ones(mi.Color3f, n), mi.Bool(active)),
                cond=lambda ray, through, active: active,
                body=cross,
                label="null surfaces",
            )[1]

    def direct(self, si, rng, active):
        """Reflected radiance of one emitter sample."""
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

    def scatter(self, si, rng, active):
        """Return ``(ray, weight, pdf, crossed)`` of a BSDF sample; pdf is −1 for specular reflection and refraction;
        `crossed`: the sample is of the null component, so the ray goes straight on."""
        u = mi.Point2f(rng.next_float32(), rng.next_float32())
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, rng.next_float32(), u, active)
        pdf = dr.select(mi.has_flag(sample.sampled_type, mi.BSDFFlags.Delta), -1, sample.pdf)
        crossed = active & mi.has_flag(sample.sampled_type, mi.BSDFFlags.Null)
        return si.spawn_ray(si.to_world(sample.wo)), dr.select(active, weight, 0), pdf, crossed

    def emission(self, si, ray, pdf, active, way=None):
        """Radiance along BSDF-sampled rays from the emitter that they reach at `si`; `pdf` is that of the sample, `way`
        the distance from the point of that sample to where `ray` begins, None for 0."""
        emitter = si.emitter(self.scene)
        start = dr.zeros(mi.Interaction3f, dr.width(ray.o))
        start.p = ray.o if way is None else ray.o - way * ray.d
        ds = mi.DirectionSample3f(self.scene, si, start)
        other = self.scene.pdf_emitter_direction(start, ds, active & (pdf > 0))
        value = emitter.eval(si, active) * dr.select(pdf < 0, 1, _power(pdf, other))
        active = active & (dr.max(value) > 0)
        return dr.select(active, value * self.transmittance(ray.o, ray.d, si.t, active), 0)


def _scene_of(shapes: list, integrator):
    """Return a scene of these very shapes alone, for the rays' intersections.

    It is built again only when a shape has changed: its acceleration structure may take longer than the picture. It is
    kept as long as `integrator`, the one of the shapes' scene, exists. Nothing is kept for Mitsuba's own integrators,
    which weak references cannot refer to."""
    try:
        kept = _scenes.setdefault(integrator, Recent(2))
    except TypeError:
        return _built(shapes)
    # What is kept holds the shapes, so no others get their addresses.
    return kept.of((*(s.ptr for s in shapes), Version(*shapes, owners=mi.Shape)), lambda: _built(shapes))


def _built(shapes: list):
    """Return a new scene of `shapes`, which keep their names."""
    # Mitsuba refuses a scene in which all emitters have the weight 0, as those of these shapes may. It also renames
    # the objects of a dictionary by its keys.
    names = [shape.id() for shape in shapes]
    objects = {"unused": {"type": "point"}, **{f"shape_{i}": s for i, s in enumerate(shapes)}}
    try:
        return mi.load_dict({"type": "scene", **objects}, optimize=False)
    finally:
        for shape, name in zip(shapes, names, strict=True):
            shape.set_id(name)


def _power(a, b):
    """Weight of a sample of density `a` beside another technique of density `b`."""
    return dr.select(a > 0, a * a / (a * a + b * b), 0)

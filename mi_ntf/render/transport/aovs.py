"""Arbitrary output variables of the ``nrf`` integrator: properties of the camera's samples other than light.

A pixel's value is Σ w v / Σ w over all its samples. The weight w of a sample is the fraction of the view that it
stops. The pixel is 0 where nothing stops the view. Ordinary surfaces take part with the transmittance of the fields
before them.

=================== ================ ==================================================================================
name                channels         value
=================== ================ ==================================================================================
depth               T                distance along the camera ray from the near plane, scene units
normal              X, Y, Z          unit vector, scene coordinates
albedo              R, G, B          diffuse albedo of surfaces, albedo of fields, linear RGB
roughness           Y                of fields
opacity             Y                1 − T: fraction of the view that something stops
visibility          Y                of fields: τ towards a light, mean over the lights of the table
visibility_lights   0.Y, 1.Y, …      of fields: τ towards each light of the table, 128 at most
=================== ================ ==================================================================================
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.lights import LightTable
from ...infer.samples import Samples
from ...infer.shade import Points
from ...infer.types import Array, Float, Mask, Ray, UInt32, Vector, Vector3, Visibility
from ..scene.camera import Camera, Reconstruction
from .shadow import Part

CHANNELS = {
    "depth": ("T",), "normal": ("X", "Y", "Z"), "albedo": ("R", "G", "B"), "roughness": ("Y",), "opacity": ("Y",),
    "visibility": ("Y",), "visibility_lights": (),
}
OF_FIELDS = ("roughness", "visibility", "visibility_lights")
OF_LIGHTS = ("visibility", "visibility_lights")
MAX_LIGHTS = 128
"""Most lights of ``visibility_lights``, each of which takes a float for each camera ray in flight."""


def parse(text: str) -> tuple[str, ...]:
    """Return the names of a comma-separated list. Raises MiNtfError on unknown and repeated names."""
    names = tuple(word for word in (w.strip() for w in text.split(",")) if word)
    for name in names:
        if name not in CHANNELS:
            raise MiNtfError(f'nrf integrator: aovs has "{name}", expected some of {", ".join(CHANNELS)}')
        if names.count(name) > 1:
            raise MiNtfError(f'nrf integrator: aovs has "{name}" twice; name each once')
    return names


def channel_names(outputs: tuple[str, ...], lights: int) -> list[str]:
    """Return the names of the film's extra channels, in order, with `lights` lights in the table."""
    if "visibility_lights" in outputs and not 0 < lights <= MAX_LIGHTS:
        raise MiNtfError(
            f"aovs=visibility_lights needs 1 to {MAX_LIGHTS} lights that are points or directions, this scene has "
            f'{lights}; ask for "visibility", their mean, or set environment_lights to {MAX_LIGHTS} at most'
        )
    if "visibility" in outputs and not lights:
        raise MiNtfError(
            "aovs=visibility needs lights that are points or directions, this scene has none (light_samples draws "
            "lights instead: set it to 0)"
        )
    return [f"{name}.{channel}" for name in outputs for channel in _channels(name, lights)]


def _channels(name: str, lights: int) -> tuple[str, ...]:
    return tuple(f"{i}.Y" for i in range(lights)) if name == "visibility_lights" else CHANNELS[name]


def _tau(shadow: Visibility | None, table: LightTable, x: Vector, light: UInt32, active: Mask) -> Float:
    """Return τ from the field points `x` to a light of the table; of a coloured τ the mean."""
    sample = table.sample(light, x, True)
    tau = shadow.tau(x, sample.wi, sample.distance, light, active) if shadow else mi.Float(1)
    return dr.mean(tau) if dr.depth_v(tau) > 1 else tau


class Sums:
    """Sums Σ w v and Σ w over the samples of camera rays.

    outputs    names of the outputs
    lights     number of lights of the table
    rays       number of camera rays
    first      row of the first light of the present run
    later_run  it is not the first run: the same rays add the visibility of these lights alone
    """

    def __init__(self, outputs: tuple[str, ...], lights: int, rays: int, first: int = 0,
                 later_run: bool = False) -> None:
        self.outputs, self.lights, self.rays, self.first, self.later_run = outputs, lights, rays, first, later_run
        self.sums: dict[str, list[Float]] = {n: [dr.zeros(mi.Float, rays) for _ in _channels(n, lights)]
                                             for n in outputs if n not in ("opacity", "visibility_lights")}
        self.layers = dr.zeros(mi.Float, rays * lights) if "visibility_lights" in outputs else None
        self.opacity = dr.zeros(mi.Float, rays)
        self.stopped: list[Float] = [dr.zeros(mi.Float, rays) for _ in range(2)]  # by anything, by fields

    @property
    def needs_points(self) -> bool:
        """True if an output needs more than :meth:`add_opacity` receives."""
        return any(name != "opacity" for name in self.outputs)

    def add_field(self, i: int, part: Part, points: Points, samples: Samples, in_field: UInt32 | None,
                  distance: Float, shadow: Visibility | None) -> None:
        """Add the camera's samples in the field `part`, strand `i`.

        `points`: points of the samples in this field, whose indices are `in_field` (None: all); `distance`: from the
        camera, scene units; `shadow`: visibility of the run's lights, if it is not the view's transmittance.
        """
        values: list[tuple[list[Float], list[Float]]] = []
        if self.layers is not None:
            self._add_layers(i, part.table, samples, shadow)
        elif "visibility" in self.sums:
            values.append((self.sums["visibility"], [self._visibility(points, part.table, samples, in_field, shadow)]))
        if not self.later_run:
            of_points: dict[str, Callable[[], Iterable[Float]]] = {
                "depth": lambda: [distance], "normal": lambda: part.frame.direction_to_world(points.normal),
                "albedo": lambda: points.albedo, "roughness": lambda: [points.roughness]}
            values += [(self.sums[name], list(of_points[name]())) for name in of_points if name in self.sums]
            values.append((self.stopped, [mi.Float(1)] * 2))
        self._add(values, samples, samples.weights[i], in_field)

    def add_opacity(self, opacity: Float) -> None:
        """Add the opacity along the rays."""
        if not self.later_run:
            self.opacity = opacity

    def of_rays(self, rays: int) -> Sums:
        """Return empty sums of the same outputs for other rays, so many of them."""
        return Sums(self.outputs, self.lights, rays, self.first, self.later_run)

    def add_behind(self, other: Sums, transmittance: Float, index: UInt32) -> None:
        """Add the sums `other` of the rays that continue where the rays `index` cross a surface.

        `transmittance`: of the fields before that surface, for each of `index`.
        """

        def add(sums: list[Float], values: list[Float], where: UInt32, weight: Float) -> None:
            for total, value in zip(sums, values, strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, value * weight, where, mode=dr.ReduceMode.NoConflicts)

        for name, sums in self.sums.items():
            add(sums, other.sums[name], index, transmittance)
        add(self.stopped, other.stopped, index, transmittance)
        if self.layers is not None:
            lights = dr.opaque(mi.UInt32, self.lights)
            lane = dr.arange(mi.UInt32, dr.width(other.layers))
            ray = lane // lights
            layer = dr.gather(mi.UInt32, index, ray) * lights + (lane - ray * lights)
            add([self.layers], [other.layers], layer, dr.gather(mi.Float, transmittance, ray))
        if not self.later_run:
            opacity = 1 - transmittance * (1 - other.opacity)
            dr.scatter(self.opacity, opacity, index)

    def add_surface(self, ray: Ray, hit: Array, transmittance: Float, distance: Float) -> None:
        """Add the surfaces behind the fields.

        `hit`: preliminary intersections of the rays; `transmittance`: fraction of each ray's light that starts there;
        `distance`: from the camera to the rays' origins.
        """
        if self.later_run:
            return
        si, valid = hit.compute_surface_interaction(mi.Ray3f(ray)), hit.is_valid()
        weight = dr.select(valid, transmittance, 0)
        values: dict[str, Callable[[], Iterable[Float]]] = {
            "depth": lambda: [si.t + distance], "normal": lambda: si.sh_frame.n,
            "albedo": lambda: si.bsdf().eval_diffuse_reflectance(si, valid)}
        for name in (n for n in values if n in self.sums):
            self.sums[name] = [total + dr.select(valid, value, 0) * weight
                               for total, value in zip(self.sums[name], values[name](), strict=True)]
        self.stopped[0] = self.stopped[0] + weight

    def _add(self, pairs: Sequence[tuple[list[Float], list[Float]]], samples: Samples, weight: Float,
             in_field: UInt32 | None) -> None:
        """Add to each sum of the `pairs` its values at the samples `in_field`, times their weight."""
        if in_field is not None:
            weight = dr.gather(mi.Float, weight, in_field)
        weighted = []
        for value in (v for _, values in pairs for v in values):
            value = value * weight
            if in_field is not None:
                of_all = dr.zeros(mi.Float, dr.width(samples.t))
                dr.scatter(of_all, value, in_field)
                value = of_all
            weighted.append(value)
        dr.eval(weighted)
        totals = iter(samples.totals(weighted, dr.grad_enabled(weighted)))
        for sums, _ in pairs:
            sums[:] = [total + next(totals) for total in sums]

    def _visibility(self, points: Points, table: LightTable, samples: Samples, in_field: UInt32 | None,
                    shadow: Visibility | None) -> Float:
        """Return the sum of τ at `points` over the lights of `table`, divided by the number of all lights."""
        count = dr.opaque(mi.UInt32, table.count)
        if samples.view is not None:
            view = samples.view if in_field is None else dr.gather(mi.Float, samples.view, in_field)
            return view * (mi.Float(count) / dr.opaque(mi.Float, self.lights))

        def body(i: UInt32, total: Float) -> tuple[UInt32, Float]:
            return i + 1, total + _tau(shadow, table, points.x, i, mi.Bool(True))

        n = dr.width(points.x[0])
        state: Array = dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n)
        def more(i: UInt32, total: Float) -> Mask:
            return i < count

        _, total = dr.while_loop(state=state, cond=more, body=body, label="visibility")
        return total / dr.opaque(mi.Float, self.lights)

    def _add_layers(self, strand: int, table: LightTable, samples: Samples, shadow: Visibility | None) -> None:
        """Add Σ w τ of strand `strand` to each light's layer, with a lane for each ray and light of the run."""
        lights, first = (dr.opaque(mi.UInt32, n) for n in (self.lights, self.first))
        lane = dr.arange(mi.UInt32, self.rays * table.count)
        ray = lane // dr.opaque(mi.UInt32, table.count)
        light = lane - ray * dr.opaque(mi.UInt32, table.count)
        begin, count = (dr.gather(mi.UInt32, a, ray) for a in (samples.first, samples.count))
        line = samples.line(strand, ray)

        def body(k: UInt32, total: Float) -> tuple[UInt32, Float]:
            sample = begin + k
            weight = dr.gather(mi.Float, samples.weights[strand], sample)
            if samples.view is None:
                x = samples.along(strand, line, dr.gather(mi.Float, samples.t, sample))
                tau = _tau(shadow, table, x, light, weight > 0)
            else:
                tau = dr.gather(mi.Float, samples.view, sample)
            return k + 1, total + dr.select(weight > 0, weight * tau, 0)

        state: Array = dr.zeros(mi.UInt32, dr.width(lane)), dr.zeros(mi.Float, dr.width(lane))
        def more(k: UInt32, total: Float) -> Mask:
            return k < count

        _, total = dr.while_loop(state=state, cond=more, body=body, label="visibility of each light")
        dr.scatter_reduce(dr.ReduceOp.Add, self.layers, total, ray * lights + first + light,
                          mode=dr.ReduceMode.NoConflicts)  # fmt: skip

    def _mean_of_layers(self, layers: list[Float]) -> Float:
        total = layers[0]
        for layer in layers[1:]:
            total = total + layer
        return total / dr.opaque(mi.Float, self.lights)

    def values(self) -> list[Float]:
        """Return Σ w v of every channel, in the order of :func:`channel_names`, then Σ w of all and Σ w of fields."""
        ray = dr.arange(mi.UInt32, self.rays)
        count = dr.opaque(mi.UInt32, self.lights)
        values: list[Float] = []
        layers: list[Float] = []
        if self.layers is not None:
            layers = [dr.gather(mi.Float, self.layers, ray * count + dr.opaque(mi.UInt32, i))
                      for i in range(self.lights)]  # fmt: skip
        for name in self.outputs:
            if name == "opacity":
                values.append(self.opacity)
            elif name == "visibility_lights":
                values += layers
            elif name == "visibility" and layers:
                values.append(self._mean_of_layers(layers))
            else:
                values += self.sums[name]
        return [*values, *self.stopped]


class Picture:
    """Sums of each pixel, from which the film's extra channels are computed."""

    def __init__(self, camera: Camera, outputs: tuple[str, ...], lights: int) -> None:
        self.outputs, self.lights = outputs, lights
        self.names = channel_names(outputs, lights)
        film = camera.film
        offset = mi.ScalarPoint2i(film.crop_offset())
        self.block = mi.ImageBlock(film.crop_size(), offset, len(self.names) + 2, film.rfilter())
        self._pixels = Reconstruction(self.block, camera)

    def begin_pass(self, camera: Camera) -> None:
        """Expect samples of another `camera`."""
        self._pixels = Reconstruction(self.block, camera)

    def sums(self, rays: int, run: int, lights: tuple[int, int] | None) -> Sums | None:
        """Return empty sums for camera rays lit by the lights (first, end) of run `run`, None: all lights.

        Returns None if a later run has nothing to add.
        """
        if run and not any(name in self.outputs for name in OF_LIGHTS):
            return None
        return Sums(self.outputs, self.lights, rays, lights[0] if lights else 0, run > 0)

    def put(self, first: int, position: Vector3, sums: Sums) -> None:
        """Add the rays' sums, as :meth:`mi_ntf.render.scene.camera.Reconstruction.add`."""
        self._pixels.add(first, position, sums.values())

    def write_to(self, block: mi.ImageBlock, weights: Sequence[Float]) -> None:
        """Fill the extra channels of the film's `block`.

        The film divides all channels by the sum of its filter's weights, over all blocks: `weights`. Values are
        multiplied by this sum.
        """
        ours, theirs = self.block.tensor(), block.tensor()
        width, base = theirs.shape[2], theirs.shape[2] - len(self.names)
        pixel = dr.arange(mi.UInt32, theirs.shape[0] * theirs.shape[1])
        filtered = sum(weights)
        sums = [dr.gather(mi.Float, ours.array, pixel * ours.shape[2] + i) for i in range(ours.shape[2])]
        *sums, stopped, stopped_by_fields = sums
        first = 0
        for name in self.outputs:
            channels = sums[first : first + len(_channels(name, self.lights))]
            weight = stopped_by_fields if name in OF_FIELDS else stopped
            for i, value in enumerate(_expectation(name, channels, weight, filtered)):
                dr.scatter(theirs.array, value, pixel * width + (base + first + i))
            first += len(channels)


def _expectation(name: str, channels: list[Float], weight: Float, filtered: Float) -> list[Float]:
    """Return Σ w v over Σ w, times the sum of the filter's weights."""
    if name == "opacity":
        return channels
    if name == "normal":
        length = dr.sqrt(channels[0] * channels[0] + channels[1] * channels[1] + channels[2] * channels[2])
        weight = dr.select(weight > 0, length, 0)
    return [dr.select(weight > 1e-6 * dr.abs(filtered), c / weight * filtered, 0) for c in channels]

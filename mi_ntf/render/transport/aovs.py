"""Arbitrary output variables of the ``nrf`` integrator: what the camera's samples mean besides light.

A pixel's value is the expectation over all its samples by their weights w, the share of the view that each stops:
Σ w v / Σ w. What stops nothing has none, and the pixel is 0 there. Ordinary surfaces take part with the share that the
fields in front of them let through.

=================== ================ ==================================================================================
name                channels         value
=================== ================ ==================================================================================
depth               T                distance along the camera ray from the near plane on, scene units
normal              X, Y, Z          unit vector, scene coordinates
albedo              R, G, B          diffuse albedo of surfaces, albedo of fields, linear RGB
roughness           Y                of fields
opacity             Y                1 − T: share of the view that ends on something
visibility          Y                of fields: τ towards a light, mean over the lights of the table
visibility_lights   0.Y, 1.Y, …      of fields: τ towards each light of the table
=================== ================ ==================================================================================
"""

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ..scene.camera import Camera, Reconstruction

CHANNELS = {
    "depth": ("T",), "normal": ("X", "Y", "Z"), "albedo": ("R", "G", "B"), "roughness": ("Y",), "opacity": ("Y",),
    "visibility": ("Y",), "visibility_lights": (),
}
OF_FIELDS = ("roughness", "visibility", "visibility_lights")
OF_LIGHTS = ("visibility", "visibility_lights")
MAX_LIGHTS = 128
"""Layers of ``visibility_lights``: each is a float a camera ray in flight."""


def parse(text: str) -> tuple[str, ...]:
    """The names of a comma-separated list. Raises MiNtfError on unknown and repeated ones."""
    names = tuple(word for word in (w.strip() for w in text.split(",")) if word)
    for name in names:
        if name not in CHANNELS:
            raise MiNtfError(f'nrf integrator: aovs has "{name}", expected some of {", ".join(CHANNELS)}')
        if names.count(name) > 1:
            raise MiNtfError(f'nrf integrator: aovs has "{name}" twice; name each once')
    return names


def channel_names(wanted: tuple[str, ...], lights: int) -> list[str]:
    """Names of the film's extra channels, in order, with `lights` lights in the table."""
    if "visibility_lights" in wanted and not 0 < lights <= MAX_LIGHTS:
        raise MiNtfError(
            f"aovs=visibility_lights needs 1 to {MAX_LIGHTS} lights that are points or directions, this scene has "
            f'{lights}; ask for "visibility", their mean, or set environment_lights to {MAX_LIGHTS} at most'
        )
    if "visibility" in wanted and not lights:
        raise MiNtfError(
            "aovs=visibility needs lights that are points or directions, this scene has none (light_samples draws "
            "lights instead: set it to 0)"
        )
    return [f"{name}.{channel}" for name in wanted for channel in _channels(name, lights)]


def _channels(name: str, lights: int) -> tuple[str, ...]:
    return tuple(f"{i}.Y" for i in range(lights)) if name == "visibility_lights" else CHANNELS[name]


def _tau(shadow, table, x, light, active):
    """τ from field points `x` to light `light` of the table, the mean of a coloured one."""
    wi, _, distance = table.sample(light, x, True)
    tau = shadow.tau(x, wi, distance, light, active) if shadow else mi.Float(1)
    return dr.mean(tau) if dr.depth_v(tau) > 1 else tau


class Sums:
    """Σ w v and Σ w of `rays` camera rays, for the `wanted` names and `lights` lights in all.

    `first`, `later`: where a run of the lights begins, and whether it is not the first: then the same rays have been
    here before, and add the visibility of these lights alone.
    """

    def __init__(self, wanted: tuple[str, ...], lights: int, rays: int, first: int = 0, later: bool = False):
        self.wanted, self.lights, self.rays, self.first, self.later = wanted, lights, rays, first, later
        self.sums = {n: [dr.zeros(mi.Float, rays) for _ in _channels(n, lights)]
                     for n in wanted if n not in ("opacity", "visibility_lights")}
        self.layers = dr.zeros(mi.Float, rays * lights) if "visibility_lights" in wanted else None
        self.opacity = dr.zeros(mi.Float, rays)
        self.stopped = [dr.zeros(mi.Float, rays) for _ in range(2)]  # by anything, by fields

    @property
    def needs_points(self) -> bool:
        """True if an output needs more than :meth:`add_opacity` receives."""
        return any(name != "opacity" for name in self.wanted)

    def add_field(self, i: int, part, points, samples, kept, distance, shadow) -> None:
        """Add the camera's samples in the field `part`, strand `i`.

        `points`: those of the `samples` that lie in this field, in order; `kept`: which these are, None: all of them;
        `distance`: theirs from the rays' origins, scene units. `shadow`: visibility method of the run's lights, None
        where nothing is dimmed; lights at the camera share the view's transmittance."""
        values = []
        if self.layers is not None:
            self._add_layers(i, part.table, samples, shadow)
        elif "visibility" in self.sums:
            values.append((self.sums["visibility"], [self._visibility(points, part.table, samples, kept, shadow)]))
        if not self.later:
            of_points = {"depth": lambda: [distance], "normal": lambda: part.frame.direction_to_world(points.normal),
                         "albedo": lambda: points.albedo, "roughness": lambda: [points.roughness]}
            values += [(self.sums[name], list(of_points[name]())) for name in of_points if name in self.sums]
            values.append((self.stopped, [mi.Float(1)] * 2))
        self._add(values, samples, samples.weights[i], kept)

    def add_opacity(self, opacity) -> None:
        """Share of each ray that ends on something."""
        if not self.later:
            self.opacity = opacity

    def of_rays(self, rays: int) -> "Sums":
        """Empty sums of the same outputs for so many other rays."""
        return Sums(self.wanted, self.lights, rays, self.first, self.later)

    def add_behind(self, other: "Sums", transmittance, index) -> None:
        """Add the sums `other` of the rays that continue where the rays `index` cross a surface.

        `transmittance`: of the fields before that surface, one number for each of `index`."""

        def add(sums, values, where, weight) -> None:
            for total, value in zip(sums, values, strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, value * weight, where, mode=dr.ReduceMode.NoConflicts)

        for name, sums in self.sums.items():
            add(sums, other.sums[name], index, transmittance)
        add(self.stopped, other.stopped, index, transmittance)
        if self.layers is not None:
            lights = dr.opaque(mi.UInt32, self.lights)
            lane = dr.arange(mi.UInt32, dr.width(other.layers))
            ray = lane // lights
            there = dr.gather(mi.UInt32, index, ray) * lights + (lane - ray * lights)
            add([self.layers], [other.layers], there, dr.gather(mi.Float, transmittance, ray))
        if not self.later:
            opacity = 1 - transmittance * (1 - other.opacity)
            dr.scatter(self.opacity, opacity, index)

    def add_surface(self, ray, hit, transmittance, way) -> None:
        """Add the surfaces behind the fields.

        `hit`: preliminary intersections of the rays; `transmittance`: the share of each ray that ends there; `way`:
        distance from the camera to the rays' origins."""
        if self.later:
            return
        si, hit = hit.compute_surface_interaction(mi.Ray3f(ray)), hit.is_valid()
        weight = dr.select(hit, transmittance, 0)
        values = {"depth": lambda: [si.t + way], "normal": lambda: si.sh_frame.n,
                  "albedo": lambda: si.bsdf().eval_diffuse_reflectance(si, hit)}
        for name in (n for n in values if n in self.sums):
            self.sums[name] = [total + dr.select(hit, value, 0) * weight
                               for total, value in zip(self.sums[name], values[name](), strict=True)]
        self.stopped[0] = self.stopped[0] + weight

    def _add(self, pairs, samples, weight, kept) -> None:
        """Add to each sum of the `pairs` its values at the samples `kept`, times their weight."""
        if kept is not None:
            weight = dr.gather(mi.Float, weight, kept)
        spread = []
        for value in (v for _, values in pairs for v in values):
            value = value * weight
            if kept is not None:
                whole = dr.zeros(mi.Float, dr.width(samples.t))
                dr.scatter(whole, value, kept)
                value = whole
            spread.append(value)
        dr.eval(spread)
        totals = iter(samples.totals(spread, dr.grad_enabled(spread)))
        for sums, _ in pairs:
            sums[:] = [total + next(totals) for total in sums]

    def _visibility(self, points, table, samples, kept, shadow):
        """Σ of the table's lights of τ at `points`, over the number of all."""
        count = dr.opaque(mi.UInt32, table.count)
        if samples.view is not None:
            view = samples.view if kept is None else dr.gather(mi.Float, samples.view, kept)
            return view * (mi.Float(count) / dr.opaque(mi.Float, self.lights))

        def body(i, total):
            return i + 1, total + _tau(shadow, table, points.x, i, mi.Bool(True))

        n = dr.width(points.x[0])
        _, total = dr.while_loop(
            state=(dr.zeros(mi.UInt32, n), dr.zeros(mi.Float, n)), cond=lambda i, total: i < count, body=body,
            label="visibility",
        )  # fmt: skip
        return total / dr.opaque(mi.Float, self.lights)

    def _add_layers(self, strand: int, table, samples, shadow) -> None:
        """Add Σ w τ of strand `strand` to each light's layer: a lane for each ray and light of the run."""
        everything, first = (dr.opaque(mi.UInt32, n) for n in (self.lights, self.first))
        lane = dr.arange(mi.UInt32, self.rays * table.count)
        ray = lane // dr.opaque(mi.UInt32, table.count)
        light = lane - ray * dr.opaque(mi.UInt32, table.count)
        begin, count = (dr.gather(mi.UInt32, a, ray) for a in (samples.first, samples.count))
        line = samples.line(strand, ray)

        def body(k, total):
            sample = begin + k
            weight = dr.gather(mi.Float, samples.weights[strand], sample)
            if samples.view is None:
                x = samples.along(strand, line, dr.gather(mi.Float, samples.t, sample))
                tau = _tau(shadow, table, x, light, weight > 0)
            else:
                tau = dr.gather(mi.Float, samples.view, sample)
            return k + 1, total + dr.select(weight > 0, weight * tau, 0)

        _, total = dr.while_loop(
            state=(dr.zeros(mi.UInt32, dr.width(lane)), dr.zeros(mi.Float, dr.width(lane))),
            cond=lambda k, total: k < count, body=body, label="visibility of each light",
        )  # fmt: skip
        dr.scatter_reduce(dr.ReduceOp.Add, self.layers, total, ray * everything + first + light,
                          mode=dr.ReduceMode.NoConflicts)  # fmt: skip

    def _mean_of_layers(self, layers: list):
        total = layers[0]
        for layer in layers[1:]:
            total = total + layer
        return total / dr.opaque(mi.Float, self.lights)

    def values(self) -> list:
        """Σ w v of every channel, in the order of :func:`channel_names`, then Σ w of all and Σ w of fields."""
        ray = dr.arange(mi.UInt32, self.rays)
        count = dr.opaque(mi.UInt32, self.lights)
        found, layers = [], []
        if self.layers is not None:
            layers = [dr.gather(mi.Float, self.layers, ray * count + dr.opaque(mi.UInt32, i))
                      for i in range(self.lights)]  # fmt: skip
        for name in self.wanted:
            if name == "opacity":
                found.append(self.opacity)
            elif name == "visibility_lights":
                found += layers
            elif name == "visibility" and layers:
                found.append(self._mean_of_layers(layers))
            else:
                found += self.sums[name]
        return [*found, *self.stopped]


class Picture:
    """Sums over pixels, beside the film's own block, until each pixel's expectation can be taken."""

    def __init__(self, camera: Camera, wanted: tuple[str, ...], lights: int):
        self.wanted, self.lights = wanted, lights
        self.names = channel_names(wanted, lights)
        film = camera.film
        self.block = mi.ImageBlock(film.crop_size(), film.crop_offset(), len(self.names) + 2, film.rfilter())
        self._pixels = Reconstruction(self.block, camera)

    def seen_by(self, camera: Camera) -> "Picture":
        """Return this picture, for the samples of another pass."""
        self._pixels = Reconstruction(self.block, camera)
        return self

    def sums(self, rays: int, run: int, lights: tuple[int, int] | None) -> Sums | None:
        """For camera rays lit by the run `run` of lights (first, last), None: all of them; None where a later run has
        nothing to add."""
        if run and not any(name in self.wanted for name in OF_LIGHTS):
            return None
        return Sums(self.wanted, self.lights, rays, lights[0] if lights else 0, run > 0)

    def put(self, first: int, position, sums: Sums) -> None:
        """Add the rays' sums, as :meth:`mi_ntf.render.scene.camera.Reconstruction.add`."""
        self._pixels.add(first, position, sums.values())

    def write_to(self, block, weights: list) -> None:
        """Fill the extra channels of the film's `block`. The film divides all by the sum of its filter's weights, those
        of `block` and of others, `weights` in all, so values are written times that."""
        ours, theirs = self.block.tensor(), block.tensor()
        width, base = theirs.shape[2], theirs.shape[2] - len(self.names)
        pixel = dr.arange(mi.UInt32, theirs.shape[0] * theirs.shape[1])
        filtered = sum(weights)
        sums = [dr.gather(mi.Float, ours.array, pixel * ours.shape[2] + i) for i in range(ours.shape[2])]
        *sums, stopped, by_fields = sums
        first = 0
        for name in self.wanted:
            channels = sums[first : first + len(_channels(name, self.lights))]
            whole = by_fields if name in OF_FIELDS else stopped
            for i, value in enumerate(_expectation(name, channels, whole, filtered)):
                dr.scatter(theirs.array, value, pixel * width + (base + first + i))
            first += len(channels)


def _expectation(name: str, channels: list, whole, filtered) -> list:
    if name == "opacity":
        return channels
    if name == "normal":
        length = dr.sqrt(channels[0] * channels[0] + channels[1] * channels[1] + channels[2] * channels[2])
        whole = dr.select(whole > 0, length, 0)
    return [dr.select(whole > 1e-6 * dr.abs(filtered), c / whole * filtered, 0) for c in channels]

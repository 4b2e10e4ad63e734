"""The ``nrf`` integrator."""

import time

import drjit as dr
import mitsuba as mi

from ..core.errors import MiNtfError
from ..infer import march, shade
from ..infer.visibility import METHODS
from . import effects, lights, visibility

CHUNK = 1 << 18
"""Camera rays in flight: bounds the memory at some hundred MiB whatever the image and the number of lights."""


def integrator_class() -> type:
    """The plugin class for the current variant."""

    class NRFIntegrator(mi.SamplingIntegrator):
        """Volumetric integrator of neural reflectance fields (``nrf``).

        =================== ======= ===================================================================================
        parameter           type    meaning
        =================== ======= ===================================================================================
        visibility          string  how light reaches a point: ``raymarch``, ``neural_transmittance``,
                                    ``transmittance_map``, ``none``, or ``auto``, which picks the cheaper of the first
                                    and third (default: auto)
        samples             integer steps across the unit sphere's diameter (default: 384)
        light_samples       integer lights per shading point, drawn from Mitsuba's emitter sampling and resampled, from
                                    any emitters; 0: all lights, every environment texel one, and 2 drawn ones (1 of a
                                    projector or textured spot) of each emitter that is no finite set of lights, such
                                    as an area; these need no map and are marched under ``transmittance_map``
                                    (default: 0)
        environment_lights  integer most directional lights that stand for an environment (default: 512)
        map_resolution      integer texels per side of a light's transmittance map (default: 128)
        map_source          string  ``field``: marched once per texel; ``network``: one query per texel (default: field)
        hide_emitters       boolean leave the environment out of the picture (default: false)
        timeout             float   seconds after which rendering ends with what is there; below 0: never (default: -1)
        =================== ======= ===================================================================================

        Light scatters once: camera ray → point → light, with L = ∫ τ σ h dt (Bi et al. 2020, eq. 2). Alpha is the
        opacity. Every camera ray carries its whole distribution of depths, so 16 samples per pixel look like thousands
        of a path tracer.

        Does not support: more than one ``nrf`` medium; ordinary surfaces (left out with a warning); multiple
        scattering; spectral and polarised variants.
        """

        def __init__(self, props):
            # Kept here: Mitsuba's own clock would count from the construction of the plugin.
            self.timeout = float(props.get("timeout", -1.0))
            self.visibility = _choice(props, "visibility", "auto", METHODS)
            self.map_source = _choice(props, "map_source", "field", ("field", "network"))
            self.samples = _whole(props, "samples", 384, 8, 8192)
            self.light_samples = _whole(props, "light_samples", 0, 0, 65536)
            self.environment_lights = _whole(props, "environment_lights", 512, 1, 65536)
            self.map_resolution = _whole(props, "map_resolution", 128, 4, 4096)
            props["timeout"] = -1.0
            mi.SamplingIntegrator.__init__(self, props)

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            return _render(self, scene, sensor, seed, spp, develop)

        def to_string(self):
            return (
                f"NRFIntegrator[\n  visibility = {self.visibility},\n  samples = {self.samples},\n"
                f"  light_samples = {self.light_samples},\n  environment_lights = {self.environment_lights},\n"
                f"  map_resolution = {self.map_resolution},\n  map_source = {self.map_source},\n"
                f"  hide_emitters = {self.hide_emitters},\n  timeout = {self.timeout}\n]"
            )

    return NRFIntegrator


def _choice(props, name: str, default: str, legal: tuple[str, ...]) -> str:
    value = props.get(name, default)
    if value not in legal:
        raise MiNtfError(f'nrf integrator: {name} is "{value}", expected one of {", ".join(legal)}')
    return value


def _whole(props, name: str, default: int, low: int, high: int) -> int:
    value = int(props.get(name, default))
    if not low <= value <= high:
        raise MiNtfError(f"nrf integrator: {name} is {value}, expected {low} to {high}")
    return value


def _render(self, scene, sensor, seed: int, spp: int, develop: bool):
    """Camera rays in chunks of pixels → radiance and opacity → film."""
    start = time.monotonic()
    film = sensor.film()
    sampler = sensor.sampler().clone()
    if spp:
        sampler.set_sample_count(spp)
    spp = sampler.sample_count()
    sampler.set_samples_per_wavefront(spp)
    size = mi.ScalarVector2u(film.crop_size()) + (2 * film.rfilter().border_size() if film.sample_border() else 0)
    pixels = size.x * size.y
    scene_light = SceneLight(self, scene, pixels, spp)
    film.prepare([])
    block = film.create_block()
    block.set_offset(film.crop_offset())
    per_chunk = max(1, CHUNK // spp)
    for first in range(0, pixels, per_chunk):
        if self.should_stop() or (self.timeout > 0 and time.monotonic() - start > self.timeout):
            mi.Log(mi.LogLevel.Warn, f"nrf integrator: stopped after {first} of {pixels} pixels")
            break
        count = min(per_chunk, pixels - first)
        # Another stream for each chunk and seed; opaque, so that no seed is compiled into a kernel.
        stream = mi.sample_tea_32(_opaque(seed), dr.opaque(mi.UInt32, first))[0]
        sampler.seed(stream, count * spp)
        pixel = dr.arange(mi.UInt32, count * spp) // dr.opaque(mi.UInt32, spp) + dr.opaque(mi.UInt32, first)
        ray, weight, position = _camera_rays(sensor, film, sampler, pixel, size.x)
        radiance, opacity = scene_light.trace(ray, sampler, stream)
        value = radiance * weight
        channels = (
            [value.x, value.y, value.z] + ([opacity] if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else []) + [1.0]
        )
        block.put(position, [mi.Float(c) for c in channels])
        dr.eval(block.tensor())
    film.put_block(block)
    return film.develop() if develop else mi.TensorXf()


def _opaque(seed):
    """A seed, Python number (from Python) or array (from the stock program), as a value that no kernel contains."""
    value = mi.UInt32(seed)
    dr.make_opaque(value)
    return value


def _camera_rays(sensor, film, sampler, pixel, width: int):
    """Primary rays of the given pixel indices, their weights and film positions (as Mitsuba's own integrators do)."""
    border = film.rfilter().border_size() if film.sample_border() else 0
    y = pixel // dr.opaque(mi.UInt32, width)
    corner = mi.Vector2f(mi.Float(pixel - y * width), mi.Float(y)) - border + mi.Vector2f(film.crop_offset())
    inside = corner + sampler.next_2d()
    scaled = (inside - mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.crop_size())
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    moment = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        moment += sampler.next_1d() * sensor.shutter_open_time()
    ray, weight = sensor.sample_ray(moment, 0.0, mi.Point2f(scaled), aperture)
    return ray, weight, corner if film.rfilter().is_box_filter() else inside


class SceneLight:
    """The scene prepared for one render: medium, lights, visibility. What the scene lacks is not built."""

    def __init__(self, integrator, scene, pixels: int, spp: int):
        self.scene, self.integrator = scene, integrator
        self.medium = effects.find_medium(scene)
        self.effects = effects.describe(scene, integrator, pixels, spp)
        self.step = 2 / integrator.samples
        if len(scene.shapes()) > 1:
            mi.Log(
                mi.LogLevel.Warn,
                f"nrf integrator: {len(scene.shapes()) - 1} ordinary shapes are left out of the picture",
            )
        self.lights = lights.Lights(scene, [self.medium], integrator.light_samples, integrator.environment_lights)
        self.table = self.lights.table(self.medium.frame)
        options = visibility.Options(self.step, integrator.map_resolution, integrator.map_source)
        method = self.effects.visibility
        self.visibility = visibility.build(method, self.medium, self.table, options)
        # Maps know the table's lights alone.
        drawn = lights.method_for_drawn(method)
        self.drawn_visibility = (
            self.visibility if drawn == method else visibility.build(drawn, self.medium, self.table, options)
        )

    def trace(self, ray, sampler, stream):
        """``(radiance, opacity)`` of camera rays."""
        frame, source, grid = self.medium.frame, self.medium.source, self.medium.field.grid
        o, d = frame.point_to_field(ray.o), frame.direction_to_field(ray.d)
        step = dr.opaque(mi.Float, self.step)
        index, t, w, transmittance = march.camera_samples(
            source.density, grid, o, d, ray.maxt / frame.length, step, sampler.next_1d(), sampler.next_1d()
        )
        sums = [dr.zeros(mi.Float, dr.width(ray.o)) for _ in range(3)]
        if dr.width(index) > 0 and (self.table.count or self.lights.sampled):
            light = self._light(index, t, o, d, stream)
            for total, value in zip(sums, light, strict=True):
                dr.scatter_reduce(dr.ReduceOp.Add, total, value * w, index)
        radiance = mi.Color3f(*sums)
        opacity = 1 - transmittance
        if self.effects.background:
            si = dr.zeros(mi.SurfaceInteraction3f, dr.width(ray.o))
            si.wi = -ray.d
            radiance += transmittance * self.scene.environment().eval(si)
            opacity = dr.ones(mi.Float, dr.width(ray.o))
        return radiance, opacity

    def _light(self, index, t, o, d, stream):
        """Reflected radiance at the samples (ray `index`, distance `t`)."""
        along = tuple(dr.gather(mi.Float, c, index) for c in d)
        x = tuple(dr.gather(mi.Float, a, index) + t * b for a, b in zip(o, along, strict=True))
        points = shade.Points(x, tuple(-c for c in along), self.medium.source.reflectance(x))
        dr.eval(points.x, points.wo, points.normal, points.albedo, points.roughness, points.specular)
        total = [dr.zeros(mi.Float, dr.width(t)) for _ in range(3)]
        for source, mapped in self.lights.sources(self.table, self.medium.frame, points, stream):
            part = shade.reflect(points, source, self.visibility if mapped else self.drawn_visibility)
            total = [a + b for a, b in zip(total, part, strict=True)]
        return total

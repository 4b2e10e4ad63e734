"""The ``nrf`` integrator."""

import mitsuba as mi

from ...core.errors import MiNtfError, root
from ...infer.visibility import names
from ..scene.settings import Limits
from ..transport import aovs, rendering
from . import properties


def integrator_class() -> type:
    """The plugin class for the current variant."""

    class NRFIntegrator(mi.SamplingIntegrator):
        """Volumetric integrator of neural reflectance fields (``nrf``).

        =================== ======= ===================================================================================
        parameter           type    meaning
        =================== ======= ===================================================================================
        visibility          string  how light reaches a point: ``raymarch``, ``transmittance_map``,
                                    ``transmittance_atlas``, ``neural_transmittance``, ``ray_network``,
                                    ``transmittance_volume``, ``visibility_mlp``, ``none``, or ``auto``:
                                    ``transmittance_atlas`` where camera rays times lights a point (times `frames`) are
                                    more than the 3.4 million rays that fill an atlas, else ``raymarch``; by a pilot
                                    under `max_error` or `time_budget` (default: auto)
        samples             integer steps across the unit sphere's diameter (default: 384); flights of further bounces
                                    take 128 at most, between patches 256
        light_samples       integer lights per shading point, drawn from Mitsuba's emitter sampling and resampled, from
                                    any emitters; 0: all lights, cells of environments among them, and 2 drawn (1 of a
                                    projector or textured spot) of each emitter that is no finite set of lights, such
                                    as an area; no map serves these: they are marched under ``transmittance_map``
                                    (default: 0)
        environment_lights  integer most directional lights that stand for an environment (default: 512)
        map_resolution      integer texels per side of a light's transmittance map; 0: as fine as the field's voxels for
                                    up to 4 lights, whose texels more lights share, but 192 at least (default: 0)
        map_source          string  ``field``: marched once per texel; ``network``: one query per texel (default: field)
        map_components      integer logistics per texel of a marched map, 1 or 2: two err less on maps of 256² or more
                                    and on what is not opaque, and take four times the memory (default: 1)
        map_memory          float   MiB that maps or volumes may take: more lights are rendered in several runs
                                    (default: 1024)
        map_file            string  EXR of ``mi-ntf bake`` that holds the maps or the atlas (default: none)
        max_depth           integer longest path in edges: 1 shows emitters alone, 2 is single scattering, more is
                                    multiple scattering in fields and between surfaces, −1 has no limit and ends paths
                                    by Russian roulette from depth 5 on (default: 2)
        bounces             string  how light of `max_depth` > 2 is found: ``paths``, traced, exact and noisy;
                                    ``radiosity``, without noise and biased, between opaque fields alone, whose
                                    skins count as diffuse; ``auto``: ``radiosity`` where nothing else takes part
                                    (default: auto)
        unbiased            boolean march to a sixteenth of the pairs of point and light, drawn at random, to correct
                                    what maps and atlases err by: the mean over seeds is that of ``raymarch``, and
                                    their error becomes noise (default: false)
        aovs                string  further outputs, a comma-separated list of ``depth``, ``normal``, ``albedo``,
                                    ``roughness``, ``opacity``, ``visibility``, ``visibility_lights``: see
                                    :mod:`mi_ntf.render.transport.aovs` (default: none)
        hide_emitters       boolean leave the environment and shapes that shine out of the picture (default: false)
        noise_threshold     float   Monte Carlo noise to render down to, on the scale of Cycles: |I − A| over √I, A of
                                    half of the samples, summed over the picture; 0: the sampler's sample_count
                                    (default: 0)
        max_error           float   relative RMSE against ``raymarch`` that the picture may have: by a pilot of 2048
                                    camera rays ``auto`` takes the fastest method whose error is below it with a chance
                                    of 97.5 %, and what the picture hardly shows is left out; 0: nothing is (default: 0)
        time_budget         float   seconds that a render may take, maps and compilation included: ``auto`` takes the
                                    method with the least error by then; 0 or below: any (default: 0)
        frames              integer pictures that will be rendered of the same fields: ``auto`` shares among them what
                                    is built for a field (default: 1)
        timeout             float   seconds after which rendering ends with what is there; below 0: never (default: -1)
        =================== ======= ===================================================================================

        At `max_depth` 2 light scatters once: camera ray → point → light, with L = ∫ τ σ h dt (Bi et al. 2020, eq. 2).
        Alpha is the opacity. Every camera ray carries its whole distribution of depths, so 16 samples per pixel look
        like thousands of a path tracer.

        With `noise_threshold` or `time_budget`, samples are added in passes until the first of them is reached,
        whatever `sample_count` says; the film is right after every pass. What came of it is logged and is the attribute
        ``achieved``.

        Any number of ``nrf`` media, which may overlap, and ordinary shapes with any BSDF: all hide, shade and, from
        `max_depth` 3 on, light each other. Where media overlap, densities add; stock ``volpath`` knows one medium at a
        time and is no reference there. Light crosses surfaces whose BSDF has a null component (``null``, ``mask``,
        ``thindielectric``), as under ``volpath``. Shadow rays of surfaces are marched where `visibility` is a method of
        maps or volumes. With ``none`` fields cast no shadows and receive none, and light that one scatters meets no
        field again.

        The image can be differentiated by the lights: power, an environment's texels, and, of at most 32 lights in the
        scene, position and direction, whose shadows are then marched whatever the method; and by the reflectance of
        diffuse surfaces. Other parameters with gradients are refused, and so are places of lights beside surfaces that
        let light through.

        Does not support: media other than ``nrf``; fields in a ``shapegroup``; a place inside another integrator, such
        as ``aov`` or ``moment``, since it has `aovs` of its own; spectral and polarised variants; derivatives by the
        fields and by environments that turn; ``timed_sunsky``; environments whose `to_world` shears or, among surfaces,
        scales.
        """

        def __init__(self, props):
            read = properties.Reader(props, "nrf integrator", properties.INTEGRATOR)
            # Kept here: Mitsuba's own clock would count from the construction of the plugin.
            self.timeout = read.number("timeout", -1.0)
            self.visibility = read.choice("visibility", "auto", names())
            self.map_source = read.choice("map_source", "field", ("field", "network"))
            self.samples = read.whole("samples", 384, 8, 8192)
            self.light_samples = read.whole("light_samples", 0, 0, 65536)
            self.environment_lights = read.whole("environment_lights", 512, 1, 65536)
            self.map_resolution = read.whole("map_resolution", 0, 0, 4096)
            self.map_components = read.whole("map_components", 1, 1, 2)
            self.map_memory = read.number("map_memory", 1024.0, 0.0, 2.0**24)
            self.map_file = read.text("map_file", "")
            self.max_depth = read.whole("max_depth", 2, -1, 1 << 20)
            self.bounces = read.choice("bounces", "auto", ("auto", "paths", "radiosity"))
            self.unbiased = read.flag("unbiased", False)
            self.aovs = aovs.parse(read.text("aovs", ""))
            read.flag("hide_emitters", False)
            self.limits = Limits(noise=read.number("noise_threshold", 0.0, 0.0, 1e6),
                                 error=read.number("max_error", 0.0, 0.0, 1e6),
                                 seconds=max(read.number("time_budget", 0.0), 0.0))
            self.frames = read.whole("frames", 1, 1, 1 << 20)
            self.chosen = None  # under limits, for the next frame
            self.achieved = {}  # by the last render
            self.lights_seen = 0
            self.share = (0, 1)  # of the lights: all (Settings)
            self.patches = None  # of the fields rendered last, by radiosity
            props["timeout"] = -1.0
            mi.SamplingIntegrator.__init__(self, props)

        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            try:
                return rendering.render(self, scene, sensor, seed, spp, develop)
            except RuntimeError as error:
                raise root(error) from None

        def sample(self, *_):
            raise MiNtfError("nrf integrator: it renders whole pictures and cannot stand inside another one, such "
                             "as aov or moment; make it the scene's own, and ask it for channels by its property "
                             '"aovs" (depth, normal, albedo, …)')

        def aov_names(self):
            """Return the names of the further channels of the last render, which tells the number of lights."""
            known = [name for name in self.aovs if name not in aovs.OF_LIGHTS or self.lights_seen]
            return aovs.channel_names(tuple(known), self.lights_seen)

        def to_string(self):
            limits = self.limits
            shown = {"aovs": ", ".join(self.aovs), "noise_threshold": limits.noise, "max_error": limits.error,
                     "time_budget": limits.seconds}
            lines = (f"  {name} = {shown[name] if name in shown else getattr(self, name)}"
                     for name in properties.INTEGRATOR)
            return "NRFIntegrator[\n" + ",\n".join(lines) + "\n]"

    return NRFIntegrator

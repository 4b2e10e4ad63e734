"""Volumetric integrator of neural reflectance fields (``nrf``).

================== ======= ======= ============== ======================================================================
parameter          type    default range          meaning
================== ======= ======= ============== ======================================================================
visibility         string  auto    see meaning    visibility method of shadow rays: ``raymarch``, ``transmittance_map``,
                                                  ``transmittance_atlas``, ``neural_transmittance``, ``ray_network``,
                                                  ``transmittance_volume``, ``visibility_mlp``, ``none`` or ``auto``.
                                                  ``auto`` takes ``transmittance_atlas`` if camera rays times lights per
                                                  point times `frames` exceed the 3.4 million rays that fill an atlas,
                                                  else ``raymarch``. Under `max_error` or `time_budget` a pilot decides.
samples            integer 0       0, 8 to 8192   steps across the diameter of the unit sphere. 0: 384, more where steps
                                                  would be longer than 1.3 scale heights of a field's thin skins, up to
                                                  two for each voxel, and one for each voxel of fields without networks.
                                                  Paths of further bounces take at most a third of this default, light
                                                  between patches two thirds.
light_samples      integer 0       0 to 65536     sampled lights per shading point, of all emitters together. 0: sum
                                                  over point, spot and directional lights and environment cells, and two
                                                  samples of each other emitter (one of a projector or textured spot).
                                                  ``transmittance_map`` and ``transmittance_volume`` refuse other values
                                                  than 0; with 0 they march the shadows of emitters that are always
                                                  sampled.
environment_lights integer 512     1 to 65536     largest number of directional lights that represent an environment
map_resolution     integer 0       0 to 4096      texels along a side of a light's map. 0: as many as the field has
                                                  voxels along a side, or more for thin skins. More than 16 lights share
                                                  the texels of 16 such maps, but each has 192 a side at least.
map_source         string  field   field, network ``field``: a texel is marched; ``network``: it is one query of the ray
                                                  network
map_components     integer 0       0, 1, 2        logistics per texel of a marched map; 0: one for fields with opaque
                                                  skins, two for smoke. Two are more accurate on maps of 256² or more,
                                                  and take four times the memory.
map_memory         float   1024    0 to 2²⁴       MiB of maps or volumes in memory at once. More lights are rendered in
                                                  several runs.
map_file           string  none    a path         EXR file of ``mi-ntf bake`` with the maps or the atlas
max_depth          integer 2       −1 to 2²⁰      longest path in edges. 1: visible emitters; 2: single scattering;
                                                  more: multiple scattering in fields and between surfaces; −1: no
                                                  limit.
rr_depth           integer 5       1 to 2²⁰       depth from which Russian roulette may end paths
bounces            string  auto    see meaning    method for light of `max_depth` > 2. ``paths``: traced paths, unbiased
                                                  and noisy. ``radiosity``: patches of skins exchange light as diffuse
                                                  surfaces, biased, without noise, between opaque fields alone.
                                                  ``auto``: ``radiosity`` in scenes of opaque fields alone, else
                                                  ``paths``.
unbiased           boolean false                  march a sixteenth of the pairs of point and light, chosen at random,
                                                  to correct the error of maps and atlases. Their error becomes noise,
                                                  and the expected picture is that of ``raymarch``.
shadow_gradients   string  exact   exact, none    ``exact``: derivatives by a density include its shadows, whose
                                                  derivative is marched, whatever `visibility` says; ``none``: these
                                                  derivatives hold shadows fixed
aovs               string  none    see meaning    comma-separated further outputs: ``depth``, ``normal``, ``albedo``,
                                                  ``roughness``, ``opacity``, ``visibility``, ``visibility_lights``
                                                  (:mod:`mi_ntf.render.transport.aovs`)
hide_emitters      boolean false                  leave the environment and shining shapes out of the picture
noise_threshold    float   0       0 to 10⁶       Monte Carlo noise at which rendering ends, on the scale of Cycles: Σ
                                                  |I − A| over Σ √I of the picture, A being half of the samples. 0: no
                                                  limit.
max_error          float   0       0 to 10⁶       relative RMSE of the picture against ``raymarch``. ``auto`` takes the
                                                  fastest method whose error is below it with a probability of 97.5 %,
                                                  by a pilot of 2048 camera rays. Effects that the picture hardly shows
                                                  are left out. 0: no limit.
time_budget        float   0       any            seconds of the render, with compilation and maps. ``auto`` takes the
                                                  method with the least error by then. 0 or less: no limit.
frames             integer 1       1 to 2²⁰       pictures that will be rendered of the same fields. ``auto`` divides
                                                  among them the time to build an atlas.
timeout            float   −1      any            seconds after which rendering ends with an unfinished picture. Less
                                                  than 0: no limit.
================== ======= ======= ============== ======================================================================

No parameter is exposed to ``mi.traverse``.

At `max_depth` 2 light scatters once: camera ray, point, light, with L = ∫ τ σ h dt (Bi et al. 2020, eq. 2). Alpha is
the opacity. A camera ray has samples over its whole distribution of depths, so a picture needs few samples per pixel.

Under `noise_threshold` or `time_budget` samples are added in passes until the first limit is reached, whatever the
sampler's ``sample_count`` is. The film is complete after each pass. The attribute ``achieved`` describes the result.

A scene may hold any number of ``nrf`` media, which may overlap, and ordinary shapes with any BSDF. They hide and shadow
each other, and light each other from `max_depth` 3 on. Densities of overlapping media add; stock ``volpath`` knows one
medium at a time and is no reference there. Light crosses surfaces whose BSDF has a null component (``null``, ``mask``,
``thindielectric``), as under ``volpath``. Shadow rays of surfaces are marched if `visibility` is a method of maps or
volumes. Under ``none`` fields neither cast nor receive shadows, and light that one scatters meets no other field.

An ``instance`` of a ``shapegroup`` places the fields of the group, which share their voxels and their atlas; stock
``volpath`` does not move media. Four or more fields that are opaque surfaces, or of one file, are one medium of the
kernels if their sizes differ by a factor of two at most. Kernels then do not grow with their number. This holds under
``raymarch``, ``transmittance_atlas``, ``none`` and ``auto``. It does not hold for derivatives, `unbiased`, `map_file`
and ``bounces=radiosity``, which treat each field by itself. Light of further bounces is then that of ``paths``. Each
different field has an atlas of its own, 51 MiB, and `map_memory` has to hold all of them.

The picture is differentiable with respect to the power of lights, an environment's texels, and the reflectance of
diffuse surfaces. With at most 32 lights it is differentiable with respect to their position and direction as well;
their shadows are marched then. At `max_depth` 2 it is differentiable with respect to density, albedo, emission,
roughness and specular weight of fields, and to ``sigma_t``, ``scale`` and ``albedo`` of Mitsuba's own media. Other
parameters with gradients are refused. So are places of lights beside surfaces that let light through, and parameters of
fields with `aovs` or `unbiased`.

Mitsuba's ``homogeneous`` and ``heterogeneous`` media are lit in the same way, inside spheres, meshes and other closed
shapes, with any phase function: under single scattering and more, the picture is that of ``volpath``. A shape whose
BSDF is not ``null`` is a surface, too. Their extinction is sampled at the voxels of their grid. Spheres and convex
meshes of up to 16 planes bound it exactly, other closed meshes to a part of a voxel, with 192 of them across. Maps,
volumes and atlases follow smoke. Where two of their texels are thicker than a mean free path, this part of a ray is
marched.

Does not support: media with another extinction in each colour or, as by ``sggx``, in each direction; exterior media,
media in a ``shapegroup`` other than ``nrf``; a ``shapegroup`` of fields and other shapes; a place inside another
integrator, such as ``aov`` or ``moment`` (use `aovs`); spectral and polarised variants; derivatives with respect to
normals and places of fields, phase functions and turning environments; ``timed_sunsky``; environments whose `to_world`
shears or, among surfaces, scales.

.. code-block:: xml

    <integrator type="nrf">
        <string name="visibility" value="transmittance_map"/>
        <integer name="max_depth" value="4"/>
    </integrator>

.. code-block:: python

    {"type": "nrf", "visibility": "transmittance_map", "max_depth": 4}
"""

from __future__ import annotations

from typing import NoReturn

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError, root
from ...infer.types import Array
from ...infer.visibility import names
from ..scene.settings import Limits, Settings
from ..transport import aovs, rendering
from ..transport.context import RenderContext
from . import properties


def integrator_class() -> type:
    """Return the plugin class for the current variant."""

    class NRFIntegrator(mi.SamplingIntegrator):
        __doc__ = __doc__

        def __init__(self, props: mi.Properties) -> None:
            self.context = _context(properties.Reader(props, "nrf integrator", properties.INTEGRATOR))
            props["timeout"] = -1.0  # Mitsuba's own clock would start with the construction of the plugin
            mi.SamplingIntegrator.__init__(self, props)

        def render(self, scene: mi.Scene, sensor: mi.Sensor | int = 0, seed: Array = 0, spp: int = 0,
                   develop: bool = True, evaluate: bool = True) -> Array:
            sensor = scene.sensors()[sensor] if isinstance(sensor, int) else sensor
            try:
                return rendering.render(self.context, scene, sensor, seed, spp, develop, self.should_stop)
            except RuntimeError as error:
                raise root(error) from None

        def render_backward(self, scene: mi.Scene, params: object, grad_in: Array, sensor: mi.Sensor | int = 0,
                            seed: Array = 0, spp: int = 0) -> None:
            image = self.render(scene, sensor, seed, spp)  # Mitsuba's own would run all loops step by step
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)

        def render_forward(self, scene: mi.Scene, params: object, sensor: mi.Sensor | int = 0, seed: Array = 0,
                           spp: int = 0) -> Array:
            return dr.forward_to(self.render(scene, sensor, seed, spp))

        def sample(self, *_: object) -> NoReturn:
            raise MiNtfError("nrf integrator: it renders whole pictures and cannot stand inside another one, such "
                             "as aov or moment; make it the scene's own, and ask it for channels by its property "
                             '"aovs" (depth, normal, albedo, …)')

        def aov_names(self) -> list[str]:
            """Return the names of the further channels of the last render."""
            lights = self.context.light_count
            known = [name for name in self.context.aovs if name not in aovs.OF_LIGHTS or lights]
            return aovs.channel_names(tuple(known), lights)

        @property
        def achieved(self) -> dict[str, object]:
            """Result of the last render (:class:`mi_ntf.render.transport.context.RenderContext`)."""
            return self.context.achieved

        def to_string(self) -> str:
            context = self.context
            limits = context.limits
            values = vars(context.settings) | {
                "aovs": ", ".join(context.aovs), "noise_threshold": limits.noise, "max_error": limits.error,
                "time_budget": limits.seconds, "timeout": context.timeout}
            lines = (f"  {name} = {values[name]}" for name in properties.INTEGRATOR)
            return "NRFIntegrator[\n" + ",\n".join(lines) + "\n]"

    return NRFIntegrator


def _context(read: properties.Reader) -> RenderContext:
    """Return the state of an integrator with these properties."""
    settings = Settings(
        visibility=read.choice("visibility", "auto", names()),
        map_source=read.choice("map_source", "field", ("field", "network")),
        samples=read.whole("samples", 0, 8, 8192),
        light_samples=read.whole("light_samples", 0, 0, 65536),
        environment_lights=read.whole("environment_lights", 512, 1, 65536),
        map_resolution=read.whole("map_resolution", 0, 0, 4096),
        map_components=read.whole("map_components", 0, 0, 2),
        map_memory=read.number("map_memory", 1024.0, 0.0, 2.0**24),
        map_file=read.text("map_file", ""),
        max_depth=read.whole("max_depth", 2, -1, 1 << 20),
        rr_depth=read.whole("rr_depth", 5, 1, 1 << 20),
        bounces=read.choice("bounces", "auto", ("auto", "paths", "radiosity")),
        unbiased=read.flag("unbiased", False),
        shadow_gradients=read.choice("shadow_gradients", "exact", ("exact", "none")),
        hide_emitters=read.flag("hide_emitters", False),
        frames=read.whole("frames", 1, 1, 1 << 20),
    )
    limits = Limits(
        noise=read.number("noise_threshold", 0.0, 0.0, 1e6),
        error=read.number("max_error", 0.0, 0.0, 1e6),
        seconds=max(read.number("time_budget", 0.0), 0.0),
    )
    return RenderContext(settings, limits, read.number("timeout", -1.0), aovs.parse(read.text("aovs", "")))

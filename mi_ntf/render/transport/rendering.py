"""From a scene to its film: passes of camera rays, in chunks of pixels and runs of lights."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ...infer.types import Array, Float, UInt32
from .. import log
from ..scene.camera import Camera, Reconstruction
from ..scene.settings import NO_LIMITS, Limits
from ..scene.traversal import traverse
from . import aovs, camera_light, passes
from .choosing import Choice, Chooser
from .composition import IN_SMOKE, Composition
from .context import RenderContext

CHUNK = 1 << 18
"""Camera rays in flight, which bounds the memory at about half a GiB for any image and number of lights."""


def render(context: RenderContext, scene: mi.Scene, sensor: mi.Sensor, seed: int | UInt32, spp: int, develop: bool,
           should_stop: Callable[[], bool]) -> Array:
    """Render `scene` into the film of `sensor`, and show the progress; see :func:`_render`."""
    with log.Work("nrf integrator", "rendering", context.limits.seconds) as work:
        return _render(context, scene, sensor, seed, spp, develop, should_stop, work)


def _render(context: RenderContext, scene: mi.Scene, sensor: mi.Sensor, seed: int | UInt32, spp: int, develop: bool,
            should_stop: Callable[[], bool], work: log.Work) -> Array:
    """Render `scene` into the film of `sensor`, in one pass unless a limit decides on the samples.

    Parameters
    ----------
    context
        Settings of the render; it receives the result.
    spp
        Samples per pixel; 0: the sampler's own number.
    develop
        Return the developed image; it is empty otherwise.
    should_stop
        Called before each chunk of pixels; True ends the render.
    work
        The progress.
    """
    if dr.flag(dr.JitFlag.FreezingScope):
        raise MiNtfError(
            "nrf integrator: dr.freeze cannot record a render whose number of shading points is known only while it "
            "runs; call mi.render outside of frozen functions (its kernels are cached all the same)"
        )
    limits = context.limits
    progress = passes.Passes(limits)
    camera = Camera(sensor, spp)
    film = camera.film
    composition, choice = Chooser(
        scene, context.settings, limits, sensor, camera.spp, patches=context.patches, elapsed=progress.elapsed,
        previous=context.choice, complete=any(name in aovs.OF_LIGHTS for name in context.aovs)).choose()
    context.choice, context.patches = choice, composition.patches
    context.light_count = len(composition.lights.rows.power)
    attached = [name for m in composition.media for name in m.attached]
    if attached and context.aovs:
        raise MiNtfError(f"gradients by {attached[0]} of a field: not supported with aovs, which would leave them out; "
                         "detach it, or render without aovs")
    if 0 <= context.settings.max_depth < 2 and any(name in aovs.OF_LIGHTS for name in context.aovs):
        raise MiNtfError(f"nrf integrator: max_depth is {context.settings.max_depth}, at which fields scatter no light "
                         "and aovs of visibility have no value; give 2 or more, or -1")
    picture = aovs.Picture(camera, context.aovs, context.light_count) if context.aovs else None
    film.prepare(picture.names if picture else [])
    halves = _Halves(film, len(picture.names) if picture else 0)
    samples = progress.first(camera.spp, len(composition.runs))
    while samples:
        if samples != camera.spp:
            camera = Camera(sensor, samples)
        if picture:
            picture.begin_pass(camera)
        block = halves.block()
        complete = _trace(context, composition, Reconstruction(block, camera), picture, _seed(seed, progress.passes),
                          progress, should_stop, work)
        if complete or not progress.passes or (progress.count and len(composition.runs) == 1):
            halves.add(block, camera.spp, picture)
        if not complete:
            break
        if limits.of_samples:
            halves.wait()
        progress.done(camera.spp, halves.noise() if limits.noise > 0 else math.nan)
        samples = progress.next() if limits.of_samples else 0
    work.ended = ""
    if not composition.effects.gradients:
        halves.wait()  # the program develops the film next
        width, height = film.crop_size()
        work.ended = f"done, {width} × {height} pixels with {progress.count} samples each"
    context.achieved = _achieved(limits, composition, choice, progress)
    if not develop:
        return mi.TensorXf()
    image: Array = film.develop()
    return image + _zero_gradient(scene) if composition.effects.gradients and not dr.grad_enabled(image) else image


class _Halves:
    """Two halves of the passes, from which noise is measured; the film shows their sum after every pass.

    `extra`: number of channels behind the film's own, the last of which are the filter's weights.
    """

    def __init__(self, film: mi.Film, extra: int) -> None:
        self._film, self._extra, self._samples = film, extra, [0, 0]
        self._blocks: list[mi.ImageBlock] = []

    def block(self) -> mi.ImageBlock:
        """Return an empty block for a pass."""
        block, offset = self._film.create_block(), self._film.crop_offset()
        block.set_offset(mi.ScalarPoint2i(offset))
        return block

    def add(self, block: mi.ImageBlock, samples: int, picture: aovs.Picture | None) -> None:
        """Add a pass of so many samples per pixel to the half that has fewer."""
        half = int(self._samples[0] > self._samples[1])
        self._samples[half] += samples
        if half < len(self._blocks):
            self._blocks[half].put_block(block)
        else:
            self._blocks.append(block)
        if picture:
            picture.write_to(self._blocks[0], [self._weight(b) for b in self._blocks])
        self._film.clear()
        for each in self._blocks:
            self._film.put_block(each)

    def wait(self) -> None:
        """Wait for all kernels, whose time would be measured in the next pass otherwise."""
        dr.eval([block.tensor() for block in self._blocks])
        dr.sync_thread()

    def _weight(self, block: mi.ImageBlock) -> Float:
        """Return the sum of the filter's weights for each pixel."""
        tensor = block.tensor()
        pixel = dr.arange(mi.UInt32, tensor.shape[0] * tensor.shape[1])
        return dr.gather(mi.Float, tensor.array, pixel * tensor.shape[2] + (tensor.shape[2] - self._extra - 1))

    def noise(self) -> float:
        """Return the noise (:func:`mi_ntf.render.transport.passes.noise`), nan before the second pass."""
        if len(self._blocks) < 2:
            return math.nan
        pictures = []
        for block in self._blocks:
            tensor, weight = dr.detach(block.tensor()).numpy(), dr.detach(self._weight(block)).numpy()
            weight = weight.reshape(tensor.shape[:2])[..., None]
            pictures.append(np.where(weight > 0, tensor[..., :3] / np.where(weight > 0, weight, 1), 0))
        one, other = pictures
        return passes.noise(one, other, (self._samples[0], self._samples[1]))


def _trace(context: RenderContext, composition: Composition, pixels: Reconstruction, picture: aovs.Picture | None,
           seed: UInt32, progress: passes.Passes, should_stop: Callable[[], bool], work: log.Work) -> bool:
    """Trace one pass: for each run of lights all camera rays, in chunks of pixels; return False if it was stopped."""
    camera = pixels.camera
    alpha = mi.has_flag(camera.film.flags(), mi.FilmFlags.Alpha)
    rays_in_flight = (context.rays_in_flight or CHUNK) // (IN_SMOKE if composition.smoke else 1)
    chunks = range(0, camera.count, max(1, rays_in_flight // camera.spp))
    runs, cache = range(len(composition.runs)), context.sample_cache
    for number, (run, first) in enumerate(itertools.product(runs, chunks)):
        done = number / (len(runs) * len(chunks))
        if progress.limits.of_samples:
            work.update(0, f"pass {progress.passes + 1} of {camera.spp} samples, {done:.0%}")
        else:
            work.update(done)
        if should_stop() or progress.overtime(context.timeout):
            _stop(pixels, run, first, len(runs))
            progress.ended = "timeout"
            return False
        composition.select(run)
        # An independent stream for each chunk and seed; opaque, so that no seed is compiled into a kernel.
        stream = mi.sample_tea_32(seed, _opaque(first))[0]
        ray, weight, position, quadrature = camera.rays(first, min(chunks.step, camera.count - first), stream)
        sums = picture.sums(dr.width(ray), run, composition.runs[run]) if picture else None
        with composition.lights.bare():
            radiance, opacity = camera_light.trace(composition, ray, quadrature, stream, sums,
                                                   cache.chunk(first) if cache else None)
        # The first run adds the opacity and the filter's weights.
        once = [None, None] if run else [opacity, dr.ones(mi.Float, dr.width(ray))]
        pixels.add(first, position, [*(radiance * weight), *(once if alpha else once[1:])])
        if picture and sums:
            picture.put(first, position, sums)
    return True


def _zero_gradient(scene: mi.Scene) -> Float:
    """Return 0, attached to every attached parameter of `scene`.

    It is added to a picture that depends on none of them, since Dr.Jit refuses to differentiate a detached picture.
    """
    zero: Float = dr.opaque(mi.Float, 0)  # a literal one would detach
    total = zero
    for _, value in traverse(scene):
        if dr.grad_enabled(value):
            flat: Array = dr.ravel(getattr(value, "matrix", value))
            total = total + zero * dr.sum(flat)
    return total


def _stop(pixels: Reconstruction, run: int, first: int, runs: int) -> None:
    """Clear the pixels that some run of lights has not reached, and warn; `first`: source pixel where `run` stopped."""
    last = run == runs - 1
    if runs > 1:
        pixels.clear_unfinished(first if last else 0)
    log.warn(
        f"nrf integrator: stopped after {first if last else 0} of {pixels.camera.count} pixels"
        + ("" if last else f", in run {run + 1} of {runs} of the lights: more map_memory needs fewer runs")
    )


def _achieved(limits: Limits, composition: Composition, choice: Choice, progress: passes.Passes) -> dict[str, Any]:
    """Return the result of a render, and log it if there are limits."""
    best, visibility = choice.best, composition.effects.visibility
    if limits != NO_LIMITS:
        error = f", error below {best.bound:.1%}" if best else ""
        noise = "" if math.isnan(progress.noise) else f", noise {progress.noise:.3g}"
        log.info(f"nrf integrator: {best.name if best else visibility}{error}{noise}, {progress.count} samples, ended "
                 f"by {progress.ended}")
        for trial in choice.trials:
            log.debug(f"nrf integrator: {trial}")
    return {
        "visibility": visibility, "reason": best.why if best else composition.effects.reason, "spp": progress.count,
        "passes": progress.passes, "noise": progress.noise, "seconds": progress.seconds, "ended": progress.ended,
        "predicted": choice.predicted, "trials": [vars(t) for t in choice.trials],
    }


def _seed(seed: int | UInt32, number: int) -> UInt32:
    """Return the seed of pass `number`; the first pass has the user's own."""
    return mi.sample_tea_32(_opaque(seed), _opaque(number))[0] if number else _opaque(seed)


def _opaque(number: int | UInt32) -> UInt32:
    """Return a number as a value that no kernel contains.

    It is a Python number, or an array from the stock program.
    """
    value: UInt32 = mi.UInt32(number)
    dr.make_opaque(value)
    return value

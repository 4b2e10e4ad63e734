"""From a scene to its film: passes of camera rays, in chunks of pixels and runs of lights."""

import itertools
import math

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from .. import log
from ..scene.camera import Camera, Reconstruction
from ..scene.settings import Limits, Settings
from . import aovs, camera_light, choosing, passes
from .choosing import Choice
from .composition import IN_SMOKE

CHUNK = 1 << 18
"""Camera rays in flight: bounds the memory at about half a GiB whatever the image and the number of lights."""


def render(integrator, scene, sensor, seed, spp: int, develop: bool):
    """Camera rays → radiance and opacity → film. Without limits all samples are one pass.

    `integrator` is the plugin, or what has its attributes, and maybe ``seen``
    (:class:`mi_ntf.render.transport.seen.Seen`) of an earlier render of the same rays, and ``chunk``, camera rays in
    flight."""
    if dr.flag(dr.JitFlag.FreezingScope):
        raise MiNtfError(
            "nrf integrator: dr.freeze cannot record a render whose number of shading points is known only while it "
            "runs; call mi.render outside of frozen functions (its kernels are cached all the same)"
        )
    counted = passes.Passes(integrator.limits)
    camera = Camera(sensor, spp)
    film = camera.film
    chooser = choosing.Chooser(
        scene, Settings.of(integrator), integrator.limits, sensor, camera.spp, integrator.patches, counted.gone,
        integrator.chosen, whole=any(name in aovs.OF_LIGHTS for name in integrator.aovs))
    choice = chooser.choose()
    composition, integrator.chosen = choice.composition, choice.kept()
    integrator.patches = composition.patches
    picture = None
    if integrator.aovs:
        integrator.lights_seen = len(composition.lights.rows.power)
        picture = aovs.Picture(camera, integrator.aovs, integrator.lights_seen)
    film.prepare(picture.names if picture else [])
    halves = _Halves(film, len(picture.names) if picture else 0)
    samples = counted.first(camera.spp, len(composition.runs))
    while samples:
        if samples != camera.spp:
            camera = Camera(sensor, samples)
        block = halves.block()
        whole = _trace(integrator, composition, Reconstruction(block, camera), picture and picture.seen_by(camera),
                       _seed(seed, counted.passes), counted)  # fmt: skip
        if whole or not counted.passes or (counted.count and len(composition.runs) == 1):
            halves.add(block, camera.spp, picture)
        if not whole:
            break
        if integrator.limits.of_samples:
            halves.wait()
        counted.done(camera.spp, halves.noise() if integrator.limits.noise > 0 else math.nan)
        samples = counted.next() if integrator.limits.of_samples else 0
    if not composition.effects.gradients:
        halves.wait()  # the program develops the film next
        width, height = film.crop_size()
        log.info(f"nrf integrator: done, {width} × {height} pixels with {counted.count} samples each "
                 f"({counted.gone():.2g} s)")
    integrator.achieved = _achieved(integrator.limits, choice, counted)
    if not develop:
        return mi.TensorXf()
    image = film.develop()
    return image + _no_slope(scene) if composition.effects.gradients and not dr.grad_enabled(image) else image


class _Halves:
    """Two halves of the passes, which tell noise, and the film, which shows their sum after every pass."""

    def __init__(self, film, extra: int):
        """`extra`: channels behind the film's own, the last of which are the filter's weights."""
        self._film, self._extra, self._samples = film, extra, [0, 0]
        self._blocks: list = []

    def block(self):
        """An empty one for a pass."""
        block = self._film.create_block()
        block.set_offset(self._film.crop_offset())
        return block

    def add(self, block, samples: int, picture) -> None:
        """A pass of so many samples a pixel, to the half that has fewer."""
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
        """Until all is computed: kernels run beside the program, and a clock would see them in the next pass."""
        dr.eval([block.tensor() for block in self._blocks])
        dr.sync_thread()

    def _weight(self, block):
        """Return the sum of the filter's weights for each pixel."""
        tensor = block.tensor()
        pixel = dr.arange(mi.UInt32, tensor.shape[0] * tensor.shape[1])
        return dr.gather(mi.Float, tensor.array, pixel * tensor.shape[2] + (tensor.shape[2] - self._extra - 1))

    def noise(self) -> float:
        """:func:`mi_ntf.render.transport.passes.noise`; nan before the second pass."""
        if len(self._blocks) < 2:
            return math.nan
        pictures = []
        for block in self._blocks:
            tensor, weight = dr.detach(block.tensor()).numpy(), dr.detach(self._weight(block)).numpy()
            weight = weight.reshape(tensor.shape[:2])[..., None]
            pictures.append(np.where(weight > 0, tensor[..., :3] / np.where(weight > 0, weight, 1), 0))
        one, other = pictures
        return passes.noise(one, other, (self._samples[0], self._samples[1]))


def _trace(integrator, composition, pixels: Reconstruction, picture, seed, counted: passes.Passes) -> bool:
    """Camera rays in chunks of pixels: lights in runs whose maps fit into memory, and for each the same rays. False:
    it was told to stop."""
    camera = pixels.camera
    alpha = mi.has_flag(camera.film.flags(), mi.FilmFlags.Alpha)
    rays = getattr(integrator, "chunk", CHUNK) // (IN_SMOKE if composition.smoke else 1)
    chunks = range(0, camera.count, max(1, rays // camera.spp))
    seen = getattr(integrator, "seen", None)
    progress, parts = log.Progress("nrf integrator: rendering"), len(composition.own) * len(chunks)
    for number, (run, first) in enumerate(itertools.product(composition.own, chunks)):
        progress(number / parts)
        if integrator.should_stop() or counted.overtime(integrator.timeout):
            _stop(pixels, run, first, len(composition.runs))
            counted.ended = "timeout"
            return False
        composition.select(run)
        count = min(chunks.step, camera.count - first)
        # Another stream for each chunk and seed; opaque, so that no seed is compiled into a kernel.
        stream = mi.sample_tea_32(seed, _opaque(first))[0]
        ray, weight, position = camera.rays(first, count, stream)
        sums = picture and picture.sums(dr.width(ray), run, composition.runs[run])
        with composition.lights.bare():
            radiance, opacity = camera_light.trace(composition, ray, camera.quadrature(count), stream, sums,
                                                   seen and seen.chunk(first))
        # Opacity comes with the scene's first run, the filter's weights with the first that is rendered here.
        begins = run == composition.own[0]
        once = [*([None if run else opacity] if alpha else []), dr.ones(mi.Float, dr.width(ray)) if begins else None]
        pixels.add(first, position, [*(radiance * weight), *once])
        if picture and sums:
            picture.put(first, position, sums)
    return True


def _no_slope(scene):
    """0, attached to every attached parameter of `scene`: of a picture in which none of them shows, derivatives are 0;
    Dr.Jit would take a detached one for a mistake of the caller."""
    attached = [value for _, value in mi.traverse(scene) if dr.grad_enabled(value)]
    zero = dr.opaque(mi.Float, 0)  # a literal one would detach
    return sum((zero * dr.sum(dr.ravel(getattr(value, "matrix", value))) for value in attached), zero)


def _stop(pixels: Reconstruction, run: int, first: int, runs: int) -> None:
    """Rendering ends before source pixel `first` of `run`: pixels that not all runs of lights have reached stay
    empty."""
    last = run == runs - 1
    if runs > 1:
        pixels.keep(first if last else 0)
    mi.Log(  # type: ignore[operator]  # an object in the stub
        mi.LogLevel.Warn,
        f"nrf integrator: stopped after {first if last else 0} of {pixels.camera.count} pixels"
        + ("" if last else f", in run {run + 1} of {runs} of the lights: more map_memory needs fewer runs"),
    )


def _achieved(limits: Limits, choice: Choice, counted: passes.Passes) -> dict:
    """Return the result of a render under limits, and log it if there are any."""
    effects = choice.effects
    found = {
        "visibility": effects.visibility, "reason": effects.reason, "spp": counted.count, "passes": counted.passes,
        "noise": counted.noise, "seconds": counted.seconds, "ended": counted.ended,
        "predicted": choice.predicted, "trials": [vars(t) for t in choice.trials],
    }
    if limits != Limits():
        taken = [t for t in choice.trials if t.taken]
        error = f", error below {taken[-1].bound:.1%}" if taken else ""
        noise = "" if math.isnan(counted.noise) else f", noise {counted.noise:.3g}"
        log.info(f"nrf integrator: {taken[-1].name if taken else found['visibility']}{error}{noise}, "
                 f"{counted.count} samples, ended by {counted.ended}")
        for trial in choice.trials:
            mi.Log(mi.LogLevel.Debug, f"nrf integrator: {trial}")  # type: ignore[operator]  # an object in the stub
    return found


def _seed(seed, number: int):
    """Return the seed of pass `number`: the first has the user's own."""
    return mi.sample_tea_32(_opaque(seed), _opaque(number))[0] if number else _opaque(seed)


def _opaque(seed):
    """A seed, Python number (from Python) or array (from the stock program), or the number of a pixel, as a value that
    no kernel contains."""
    value = mi.UInt32(seed)
    dr.make_opaque(value)
    return value

"""Camera rays for a chunk of pixels, and the reconstruction of pixels from their samples."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from ...infer.types import Array, Color3, Float, Ray, UInt32, Vector3

LATTICE = 3242174889, 2447445414
"""2³² over ρ and ρ², ρ³ = ρ + 1: steps of a sequence that fills the unit square evenly (Roberts 2018, R₂)."""
CHANNELS = 8
"""Channels that one kernel sums, each in a register of its loop."""


class Quadrature(NamedTuple):
    """Numbers in [0, 1) for each camera ray that place its samples (:func:`mi_ntf.infer.march.camera_samples`).

    cell_offset  start of the ray's lattice of cells
    light_share  position of the samples within the shares of the light that the ray loses
    """

    cell_offset: Float
    light_share: Float

    def take(self, index: UInt32) -> Quadrature:
        """Return the numbers of the given rays."""
        return Quadrature(*(dr.gather(mi.Float, number, index) for number in self))


class CameraRays(NamedTuple):
    """Camera rays, the samples of one pixel side by side; `position` is on the film, in pixels."""

    ray: Ray
    weight: Color3
    position: Vector3
    quadrature: Quadrature


class Camera:
    """Source pixels and samples of one render.

    The film's border has source pixels, too, if it is sampled. There are `count` source pixels with `spp` samples each.

    spp  samples a pixel, which samplers that need a square or a power of two round up; 0: the sampler's own number
    """

    def __init__(self, sensor: mi.Sensor, spp: int) -> None:
        self.sensor, self.film = sensor, sensor.film()
        self.sampler = sensor.sampler().clone()
        if spp:
            self.sampler.set_sample_count(spp)
        self.spp = self.sampler.sample_count()
        if self.spp < 1:  # Mitsuba's samplers divide by it
            raise MiNtfError("nrf integrator: the sampler's sample_count is 0, expected 1 or more samples a pixel")
        self.sampler.set_samples_per_wavefront(self.spp)
        self.border = self.film.rfilter().border_size() if self.film.sample_border() else 0
        width, height = (int(n) + 2 * self.border for n in self.film.crop_size())
        self.width, self.count = width, width * height

    def rays(self, first: int, count: int, stream: UInt32) -> CameraRays:
        """Return `spp` rays for each of `count` source pixels from `first` on; `stream`: opaque seed."""
        n = count * self.spp
        self.sampler.seed(stream, n)
        pixel = dr.arange(mi.UInt32, n) // dr.opaque(mi.UInt32, self.spp) + dr.opaque(mi.UInt32, first)
        y = pixel // dr.opaque(mi.UInt32, self.width)
        corner: Vector3 = mi.Vector2f(mi.Float(pixel - y * self.width), mi.Float(y)) - self.border
        inside = corner + self.sampler.next_2d()
        aperture = self.sampler.next_2d() if self.sensor.needs_aperture_sample() else mi.Point2f(0.5)
        moment: Float = mi.Float(self.sensor.shutter_open())
        wavelength: Float = 0.0
        if self.sensor.shutter_open_time() > 0:
            moment += self.sampler.next_1d() * self.sensor.shutter_open_time()
        scaled = mi.Point2f(inside / mi.Vector2f(self.film.crop_size()))
        # Every sensor implements this one of Mitsuba's two calls.
        differential, weight = self.sensor.sample_ray_differential(moment, wavelength, scaled, aperture)
        ray = mi.Ray3f(differential)
        if dr.width(ray) < n:  # a sensor whose rays are all the same
            ray = dr.gather(mi.Ray3f, ray, dr.zeros(mi.UInt32, n))
        # The sampler gives the numbers of a pixel's first sample, and the lattice spreads the others evenly. The noise
        # depends on where in the skin the samples of a ray lie.
        index, spp = dr.arange(mi.UInt32, n), dr.opaque(mi.UInt32, self.spp)
        first_sample = index // spp * spp
        numbers = []
        for step in LATTICE:
            start = mi.UInt32(dr.gather(mi.Float, self.sampler.next_1d(), first_sample) * 2**24) << 8
            # Integers wrap around; the upper 24 bits are a float's.
            numbers.append(mi.Float((start + (index - first_sample) * step) >> 8) * 2**-24)
        return CameraRays(ray, weight, inside + mi.Vector2f(self.film.crop_offset()), Quadrature(*numbers))


class Reconstruction:
    """Pixels of an image block, each the sum of the samples around it, weighted by the film's reconstruction filter.

    Mitsuba's ``ImageBlock.put`` adds samples to pixels atomically, so that float32 sums differ in their last bits from
    run to run. Here pixels gather their samples in a fixed order: the same seed gives the same bits.
    """

    def __init__(self, block: mi.ImageBlock, camera: Camera) -> None:
        self.block, self.camera = block, camera
        self._filter = camera.film.rfilter()
        # Source pixels on each side whose samples the filter may weight.
        self._reach = 0 if self._filter.is_box_filter() else math.ceil(self._filter.radius() - 0.5)

    def add(self, first: int, position: Vector3, values: Sequence[Float | None]) -> None:
        """Add samples in the order of :meth:`Camera.rays`, from source pixel `first` on.

        `values`: an array for each channel, with a number for each `position` on the film; None adds nothing.
        """
        camera, reach = self.camera, self._reach
        height, width, channels = self.block.tensor().shape
        last = first + dr.width(position) // camera.spp
        # Source rows lie `border` above the block's.
        top = max(first // camera.width - camera.border - reach, 0)
        bottom = min((last - 1) // camera.width - camera.border + reach + 1, height)
        dr.eval(position, values)
        if bottom <= top:
            return
        pixel = dr.arange(mi.UInt32, (bottom - top) * width) + dr.opaque(mi.UInt32, top * width)
        present = [c for c, value in enumerate(values) if value is not None]
        for k in range(0, len(present), CHANNELS):
            group = present[k : k + CHANNELS]
            sums = self._sums(pixel, width, first, last, position, [mi.Float(values[c]) for c in group])
            for c, value in zip(group, sums, strict=True):
                dr.scatter_reduce(
                    dr.ReduceOp.Add, self.block.tensor().array, value, pixel * channels + c,
                    mode=dr.ReduceMode.NoConflicts,
                )  # fmt: skip
        dr.eval(self.block.tensor())

    def _sums(self, pixel: UInt32, width: int, first: int, last: int, position: Vector3,
              values: list[Float]) -> list[Float]:
        """Return the weighted sums of `values` over the samples around the block's pixels `pixel`.

        The rounding error of a sum is added with the next sample (Kahan 1965), since 10⁶ samples would lose five of
        float32's seven digits.
        """
        spp, columns, count = (dr.opaque(mi.UInt32, n) for n in (self.camera.spp, self.camera.width, last - first))
        begin = dr.opaque(mi.UInt32, first)
        y = pixel // dr.opaque(mi.UInt32, width)
        x = pixel - y * dr.opaque(mi.UInt32, width)
        corner: Vector3 = mi.Point2f(mi.Float(x), mi.Float(y))
        centre = corner + 0.5 + mi.Vector2f(self.block.offset())
        side = dr.opaque(mi.UInt32, 2 * self._reach + 1)
        # Below 0 it wraps around to a number that is no column and no source pixel.
        shift = dr.opaque(mi.UInt32, (self.camera.border - self._reach) % 2**32)
        one = mi.Float(1)

        def more_rows(i: UInt32, j: UInt32, k: UInt32, sums: list[Float], rounding: list[Float]) -> Array:
            return j < side

        def body(i: UInt32, j: UInt32, k: UInt32, sums: list[Float], rounding: list[Float]) -> Array:
            column = x + shift + i
            source = (y + shift + j) * columns + column - begin
            active = (column < columns) & (source < count)
            index = source * spp + k
            weight: Float = one
            if self._reach:
                place = dr.gather(type(position), position, index, active)
                weight = self._filter.eval(place.x - centre.x) * self._filter.eval(place.y - centre.y)
            more = [weight * dr.gather(mi.Float, v, index, active) + r for v, r in zip(values, rounding, strict=True)]
            before = dr.detach(sums)
            sums = [s + m for s, m in zip(sums, more, strict=True)]
            rounding = [dr.detach(m - (s - b)) for m, s, b in zip(more, sums, before, strict=True)]
            k = k + 1
            i = dr.select(k == spp, i + 1, i)
            k = dr.select(k == spp, 0, k)
            j = dr.select(i == side, j + 1, j)
            return dr.select(i == side, 0, i), j, k, sums, rounding

        n = dr.width(pixel)
        zeros = [dr.zeros(mi.UInt32, n) for _ in range(3)]
        state: Array = (*zeros, *([dr.zeros(mi.Float, n) for _ in values] for _ in range(2)))
        sums: list[Float] = dr.while_loop(
            state=state,
            cond=more_rows,
            body=body,
            label="reconstruction",
            max_iterations=-1 if dr.grad_enabled(values) else None,  # a sum
        )[3]
        return sums

    def clear_unfinished(self, first: int) -> None:
        """Set the pixels to 0 that samples of source pixels from `first` on would reach."""
        tensor, reach, border = self.block.tensor(), self._reach, self.camera.border
        height, width, channels = tensor.shape
        entry = dr.arange(mi.UInt32, height * width * channels)
        pixel = entry // channels
        y = pixel // width
        x = pixel - y * width
        size = self.camera.count // self.camera.width
        last = dr.minimum(y + border + reach, size - 1) * self.camera.width
        last += dr.minimum(x + border + reach, self.camera.width - 1)
        dr.scatter(tensor.array, mi.Float(0), entry, last >= first)

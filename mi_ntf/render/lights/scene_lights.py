"""Emitters of a scene as lights of its fields: rows of a light table, or sampled at random by Mitsuba."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, Protocol, cast

import mitsuba as mi
import numpy as np

from ...infer.lights import LightSource, LightTable
from ...infer.shade import Points
from ...infer.types import UInt32
from .. import log
from ..scene.frame import Frame
from ..scene.media import NRFMedium
from . import light_checks, light_gradients, light_rows
from .emitter_samples import EmitterSamples, fully_sampled
from .light_rows import Discrete

SUN_FRACTION = 0.1
"""Fraction of the power of all lights above which a light is a sun."""
LIGHTS_PER_SUN = 16
"""Least number of lights for each sun, so that marches to suns cost little beside lookups for the other lights."""


class LightGroup(NamedTuple):
    """Lights to sum over. `in_table`: the source is the light table, for which maps are made."""

    source: LightSource
    in_table: bool


class Lights:
    """The emitters of a scene, sorted once per render.

    media               the scene's ``nrf`` media. An ``ntf`` emitter with one of them is replaced by the light that it
                        wraps, since the integrator casts the shadows of these media itself.
    light_samples       0: every discrete light at every point, environments by cells, and a few samples of each other
                        emitter; n: n samples per point of all emitters together
    environment_lights  largest number of directional lights that represent an environment
    brightest           number of rows that shine, those that bring most light to the fields; 0: all
    only                numbers of the emitters that shine; None: all

    kinds       plugin name of each emitter
    sampled     emitters that are sampled at random
    discrete    the others, each with its rows
    rows        all rows in scene coordinates
    background  True if one of the emitters is an environment, which is visible behind everything else in the
                scene

    Raises MiNtfError if an emitter has non-finite values, or cannot be sampled.
    """

    def __init__(self, scene: mi.Scene, media: Sequence[NRFMedium] = (), light_samples: int = 0,
                 environment_lights: int = 512, brightest: int = 0, only: tuple[int, ...] | None = None) -> None:
        self._wrappers: list[NTFEmitter] = []
        outer = [e for i, e in enumerate(scene.emitters()) if (only is None or i in only) and _has_samples(e)]
        emitters = [self._unwrap(e, scene, media) for e in outer]
        self.background = scene.environment() is not None and any(e.is_environment() for e in outer)
        self.kinds = [kind(e) for e in emitters]
        self.light_samples = light_samples
        for e, k in zip(emitters, self.kinds, strict=True):
            light_checks.check(e, k, light_samples > 0 or not is_discrete(e))
        discrete = [(e, k) for e, k in zip(emitters, self.kinds, strict=True) if not light_samples and is_discrete(e)]
        self.discrete = [Discrete.of(e, k, environment_lights) for e, k in discrete]
        # Lights of zero power stay if they carry gradients.
        dark = light_gradients.attached([e for e, _ in discrete])
        self.rows = light_rows.join([d.rows for d in self.discrete], dark)
        self._strength = self.rows.strength([m.frame.origin for m in media])
        if brightest:
            selected = np.sort(np.argsort(-self._strength, kind="stable")[:brightest])
            self.rows, self._strength = self.rows.part(selected), self._strength[selected]
        pairs = [(e, w) for e, w in zip(emitters, outer, strict=True) if light_samples or not is_discrete(e)]
        self.sampled = [_fully_sampled(e, scene) for e, _ in pairs if _shines(e)]
        # Mitsuba leaves emitters of weight 0 to BSDF samples. Points of fields have emitter samples alone, so these
        # emitters get a weight.
        self._weights = [w.sampling_weight() or 1.0 for e, w in pairs if _shines(e)]

    def suns(self) -> np.ndarray:
        """Return the mask (n,) of lights with a large fraction of all light each, few of many rows."""
        strength = self._strength
        brightest = np.argsort(-strength, kind="stable")[: len(strength) // LIGHTS_PER_SUN]
        suns = np.zeros(len(strength), bool)
        suns[brightest] = strength[brightest] > SUN_FRACTION * strength.sum()
        return suns

    def _unwrap(self, emitter: mi.Emitter, scene: mi.Scene, media: Sequence[NRFMedium]) -> mi.Emitter:
        """Return the light that an ``ntf`` emitter wraps, if its medium is one of `media`; any other emitter itself."""
        bare, inner = emitter, emitter
        while hasattr(inner, "attached"):
            before, outer = inner, cast(NTFEmitter, inner)
            inner = outer.attached()
            inner.set_scene(scene)  # or a nested environment would not know the size of the scene
            if any(_same(outer.medium, m) for m in media):
                self._wrappers.append(outer)
                bare = inner if bare is before else bare
        return bare

    @contextmanager
    def bare(self) -> Iterator[None]:
        """Let Mitsuba's emitter sampling ignore, within the block, the shadows that the integrator casts itself."""
        for emitter in self._wrappers:
            emitter.bare = True
        try:
            yield
        finally:
            for emitter in self._wrappers:
                emitter.bare = False

    def table(self, frame: Frame) -> LightTable:
        """Return the discrete lights in the field coordinates of `frame`."""
        table = self.rows.table(frame)
        light_gradients.attach(table, self.rows, self.discrete, frame)
        return table

    def sources(self, table: LightTable, frame: Frame, points: Points, seed: UInt32, least_samples: int,
                gradients: bool = False) -> list[LightGroup]:
        """Return the light sources to sum over at `points`, in the coordinates of `frame`.

        `table`: lights of the table that shine; `least_samples`, `gradients`: as for :class:`EmitterSamples`.
        """
        groups = [LightGroup(table, True)] if table.count else []
        if self.sampled:
            samples = EmitterSamples(self.sampled, self._weights, frame, points, seed, self.light_samples,
                                     least_samples, gradients=gradients)
            groups.append(LightGroup(samples, False))
        return groups


class NTFEmitter(Protocol):
    """Attributes of the ``ntf`` emitter plugin, whose class exists once a variant is set.

    `bare`: the emitter casts no shadow of its medium.
    """

    bare: bool
    medium: NRFMedium

    def attached(self) -> mi.Emitter:
        """Return the light that the emitter wraps."""


def kind(emitter: mi.Emitter) -> str:
    """Return the plugin name of an emitter, or the class name of an unknown one; ``ntf`` has that of its light."""
    return light_rows.kind(emitter).name


def is_discrete(emitter: mi.Emitter) -> bool:
    """Return True if the light is a finite set of points and directions.

    Examples are a spot without texture and the cells of an environment. A light inside an ``ntf`` emitter is not.
    """
    known = light_rows.KINDS.get(str(emitter.class_name()))
    return bool(known and known.rows) and not _is_textured_spot(emitter)


def _is_textured_spot(emitter: mi.Emitter) -> bool:
    return kind(emitter) == "spot" and mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def _has_samples(emitter: mi.Emitter) -> bool:
    """Return False for a light of one point or direction whose `sampling_weight` is 0.

    No ray can hit such a light, so the stock integrators do not show it.
    """
    return bool(emitter.sampling_weight() > 0) or not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)


def _fully_sampled(emitter: mi.Emitter, scene: mi.Scene) -> mi.Emitter:
    """Return :func:`.fully_sampled` of an emitter of `scene`."""
    result = fully_sampled(emitter)
    if result is not emitter:
        result.set_scene(scene)
    return result


def _shines(emitter: mi.Emitter) -> bool:
    """Return False, with a warning, for an emitter without light for Mitsuba's emitter sampling."""
    if kind(emitter) == "directionalarea":
        log.warn(f"directionalarea emitter ({emitter.id()}) lights no field: only Mitsuba's particle tracers see its "
                 "light")
        return False
    return True


def _same(medium: NRFMedium | None, other: NRFMedium) -> bool:
    """Return True if both are one medium, or two media of one field in one place."""
    if medium is other:
        return True
    if medium is None or medium.field.digest != other.field.digest:
        return False
    a, b = medium.frame, other.frame
    near = np.allclose(a.origin, b.origin, atol=1e-4 * a.length) and np.isclose(a.length, b.length, rtol=1e-4)
    return bool(near and np.allclose(a.world_to_field_numpy(np.eye(3), True), b.world_to_field_numpy(np.eye(3), True)))


def rows(emitters: Sequence[tuple[mi.Emitter, str]], environment_lights: int) -> light_rows.Rows:
    """Return the rows of discrete `emitters`, each with its kind, without lights of zero power."""
    return light_rows.join([Discrete.of(e, k, environment_lights).rows for e, k in emitters])

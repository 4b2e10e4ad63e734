"""The scene's emitters as lights of the field: which are rows of a table, which are drawn by Mitsuba's sampling."""

from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from ...infer.lights import LightTable
from ..scene.frame import Frame
from . import environment, light_checks, light_gradients, light_rows
from .emitter_samples import EmitterSamples

SUN, AMONG = 0.1, 16
"""Share of all light from which on a light is a sun; lights for each sun at least: a march costs as much as five to
seven lookups in an atlas."""


@dataclass(frozen=True)
class Discrete:
    """An emitter of a finite set of lights: itself, its kind, its rows, and the cells of an environment."""

    emitter: object
    kind: str
    rows: light_rows.Rows
    cells: Any = None

    @property
    def shining(self) -> int:
        """Cells of an environment that have power."""
        return int((self.cells.weight > 0).sum()) if self.cells else 0

    @classmethod
    def of(cls, emitter, kind: str, environment_lights: int) -> "Discrete":
        """`environment_lights`: most rows of an environment, which has those without power, too."""
        rows = light_rows.kind(emitter).rows
        assert rows is not None  # see is_discrete
        return cls(emitter, kind, *rows(emitter, kind, environment_lights))


class Lights:
    """The emitters of a scene, sorted once per render.

    media               the scene's ``nrf`` media: what an ``ntf`` emitter with one of them wraps is taken without its
                        shadow, which the integrator casts itself
    light_samples       0: every discrete light at every point, environments by texels, and a few samples of each
                        emitter that is no finite set of lights; n: n samples a point of all emitters together
    environment_lights  most directional lights that stand for an environment
    brightest           number of rows that shine, those that bring most light to the fields; 0: all
    only                numbers of the emitters that shine; None: all

    kinds    plugin name of each emitter
    sampled  emitters that are drawn at random
    discrete the others, each with its rows (:class:`Discrete`)
    rows     all of those in scene coordinates
    background  whether one of them is an environment, which is seen behind all else

    Raises MiNtfError where an emitter has numbers that are none, or cannot be drawn.
    """

    def __init__(self, scene, media=(), light_samples: int = 0, environment_lights: int = 512,
                 brightest: int = 0, only: tuple[int, ...] | None = None):
        self._wrapped: list = []
        outer = [e for i, e in enumerate(scene.emitters()) if (only is None or i in only) and _is_found(e)]
        emitters = [self._unwrap(e, scene, media) for e in outer]
        self.background = scene.environment() is not None and any(e.is_environment() for e in outer)
        self.kinds = [kind(e) for e in emitters]
        self.light_samples = light_samples
        for e, k in zip(emitters, self.kinds, strict=True):
            light_checks.check(e, k, light_samples > 0 or not is_discrete(e))
        discrete = [(e, k) for e, k in zip(emitters, self.kinds, strict=True) if not light_samples and is_discrete(e)]
        self.discrete = [Discrete.of(e, k, environment_lights) for e, k in discrete]
        # What is dark now may be the parameter that is to become light.
        dark = light_gradients.attached([e for e, _ in discrete])
        every = light_rows.join([d.rows for d in self.discrete], dark)
        self._strength = every.strength([m.frame.origin for m in media])
        self.rows = every
        if brightest:
            kept = np.sort(np.argsort(-self._strength, kind="stable")[:brightest])
            self.rows, self._strength = every.part(kept), self._strength[kept]
        pairs = [(e, w) for e, w in zip(emitters, outer, strict=True) if light_samples or not is_discrete(e)]
        self.sampled = [_drawable(e, scene) for e, _ in pairs if _shines(e)]
        # Mitsuba leaves emitters of weight 0 to BSDF samples. Points of fields have emitter samples alone, so these
        # emitters get a weight.
        self._weights = [w.sampling_weight() or 1.0 for e, w in pairs if _shines(e)]

    def suns(self) -> np.ndarray:
        """(n,) which few of many rows bring a large share of all light each."""
        strength = self._strength
        most = len(strength) // AMONG
        brightest = np.argsort(-strength, kind="stable")[:most]
        found = np.zeros(len(strength), bool)
        found[brightest] = strength[brightest] > SUN * strength.sum()
        return found

    def _unwrap(self, emitter, scene, media):
        """Return the light that an ``ntf`` emitter wraps, if its medium is one of `media`; any other emitter itself."""
        bare, inner = emitter, emitter
        while hasattr(inner, "attached"):
            outer, inner = inner, inner.attached()
            # Nobody else tells a nested environment how large the scene is, and where its shadow rays end.
            inner.set_scene(scene)
            if any(_same(outer.medium, m) for m in media):
                self._wrapped.append(outer)
                bare = inner if bare is outer else bare
        return bare

    @contextmanager
    def bare(self):
        """Inside, ``scene.sample_emitter_direction`` and its kin see the light of ``ntf`` emitters without the shadows
        that the integrator casts."""
        for emitter in self._wrapped:
            emitter.bare = True
        try:
            yield
        finally:
            for emitter in self._wrapped:
                emitter.bare = False

    def table(self, frame: Frame) -> LightTable:
        """The discrete lights, in the field coordinates of `frame`."""
        table = self.rows.table(frame)
        light_gradients.attach(table, self.rows, self.discrete, frame)
        return table

    def sources(self, table: LightTable, frame: Frame, points, seed, draws: int, gradients: bool = False) -> list:
        """Return the light sources to sum over at `points`, in the coordinates of `frame`.

        They are pairs of a source, which has ``count`` and ``sample``, and a flag: its index is a row of `table`, which
        maps are made for. `draws`: least number of lights drawn; `gradients`: lights are attached
        (:class:`EmitterSamples`)."""
        result: list[tuple[Any, bool]] = [(table, True)] if table.count else []
        if self.sampled:
            drawn = EmitterSamples(self.sampled, self._weights, frame, points, seed, self.light_samples, draws,
                                   gradients=gradients)
            result.append((drawn, False))
        return result


def kind(emitter) -> str:
    """Plugin name of an emitter, ``ntf`` that of what it wraps; the class name where Mitsuba has a new one."""
    return light_rows.kind(emitter).name


def is_discrete(emitter) -> bool:
    """Return True if the light is a finite set of points and directions, such as a spot without texture or the cells of
    an environment. A light inside an ``ntf`` emitter is not."""
    known = light_rows.KINDS.get(emitter.class_name())
    return bool(known and known.rows) and not _is_textured_spot(emitter)


def _is_textured_spot(emitter) -> bool:
    return kind(emitter) == "spot" and mi.has_flag(emitter.flags(), mi.EmitterFlags.SpatiallyVarying)


def _is_found(emitter) -> bool:
    """Return False for a light of one point or direction whose `sampling_weight` is 0.

    No ray can hit such a light, so the stock integrators never find it."""
    return emitter.sampling_weight() > 0 or not mi.has_flag(emitter.flags(), mi.EmitterFlags.Delta)


def _drawable(emitter, scene):
    """Return :func:`mi_ntf.render.lights.environment.drawable` of an emitter of `scene`."""
    found = environment.drawable(emitter)
    if found is not emitter:
        found.set_scene(scene)
    return found


def _shines(emitter) -> bool:
    """False with a warning for what Mitsuba's own emitter sampling never finds."""
    if kind(emitter) == "directionalarea":
        mi.Log(  # type: ignore[operator]  # an object in the stub
            mi.LogLevel.Warn,
            f"directionalarea emitter ({emitter.id()}) lights no field: only Mitsuba's particle tracers see its light",
        )
        return False
    return True


def _same(medium, other) -> bool:
    """Return True if both are one medium, or two media of one field in one place."""
    if medium is other:
        return True
    if medium is None or medium.path != other.path:
        return False
    a, b = medium.frame, other.frame
    near = np.allclose(a.origin, b.origin, atol=1e-4 * a.length) and np.isclose(a.length, b.length, rtol=1e-4)
    return bool(near and np.allclose(a.world_to_field_numpy(np.eye(3), True), b.world_to_field_numpy(np.eye(3), True)))


def rows(emitters: list, environment_lights: int) -> light_rows.Rows:
    """Discrete `emitters`, each with its kind, as rows in scene coordinates. Lights without power are dropped."""
    return light_rows.join([Discrete.of(e, k, environment_lights).rows for e, k in emitters])

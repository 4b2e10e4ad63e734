"""Gradient descent on the difference between photographs and pictures of a field."""

from __future__ import annotations

import math
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import files, interruption, progress
from ..core.errors import MiNtfError
from ..core.json_values import Json
from ..data.readers import load_dataset
from ..data.schema import Split, fingerprint
from ..infer.tuning import STEP_LENGTHS
from ..infer.types import Array, Float
from ..render.scene.environment_option import Environment
from . import checkpoint, page, saving
from .comparison import Comparison, compare, difference
from .gains import Gains, products
from .photographs import Camera, Photographs, joined
from .subject import Subject
from .voxels import LINEAR, Descended, Linear, Voxels

TILE = 64
"""Side of the parts of photographs that steps compare, in pixels."""
RAYS = {"compared": 1 << 14, "checked": 1 << 14, "differentiated": 1 << 12}
"""Camera rays of the pictures of a step: the one that is compared with the photograph, those that check it, and the one
that is differentiated."""
DENSE_TILE, DENSE_RAYS = 256, {"compared": 1 << 18, "checked": 1 << 16, "differentiated": 1 << 18}
"""Both for runs that change the density. Its many voxels take time at each step, however few the rays are, so each step
has more of them."""
DARK = 0.05
"""Brightness, relative to the bright parts of the photographs, below which errors count absolutely."""
INTERVAL = 50.0
"""Seconds between two checkpoints."""
AVERAGE = 0.95
"""Decay per step of running means."""


@dataclass(frozen=True)
class Refined:
    """Figures of a refinement: relative RMSE of held-back photographs before and after it."""

    file: str
    parameters: list[str]
    steps: int
    seconds: float
    before: float
    after: float
    photographs: int
    improved: bool = True
    """False: the result was no better, and the file holds the field as it was."""
    gains: dict[str, list[float]] = field(default_factory=dict)


def refine(scene: Path, dataset: Path, output: Path, *, parameters: tuple[str, ...] = ("albedo",),
           minutes: float | None = None, steps: int | None = None, seed: int = 0, gains: bool = True,
           size: int | None = None, masks: Path | None = None, background: str | None = None,
           defined: dict[str, str] | None = None, environment: Environment | None = None) -> Refined:
    """Refine the field of a scene by photographs under the scene's light, and write it as a field file.

    Parameters
    ----------
    scene
        Scene with one ``nrf`` medium and the light of the photographs. In place of it a field file, with the flash of
        each photograph as the light.
    dataset
        Folder of the photographs (:func:`mi_ntf.data.readers.load_dataset`), whose world is that of the field's own.
    output
        Field file to write.
    parameters
        Names of the parameters under ``mi.traverse`` that may change.
    minutes, steps
        Limit of the run, one of them; 2 minutes by default.
    seed
        Seed of the parts and of the samples.
    gains
        Estimate the exposure and white balance of each photograph where the data set has no intensity of lights.
    size, masks, background
        Options of the reader.
    defined, environment
        Values of the scene's $names, and changes of its environment.

    Raises
    ------
    MiNtfError
        If scene, photographs and parameters do not fit together.

    Notes
    -----
    A checkpoint ``OUTPUT.ckpt`` is written every minute. The same command continues it, and it is deleted at the end.

    A step compares a picture A with the photograph t, and differentiates another picture B, so that the product of
    error and derivative has no bias. The product (A − t)(B − t) has the expected value of the squared error without its
    noise. For parameters to which light is proportional, a picture with these at 0 tells how much of A is their light.
    Light that was scattered more than once is in A, and has no derivative. That changes the way, not the end.
    """
    if minutes is not None and steps is not None:
        raise MiNtfError(f"both --minutes {minutes:g} and --steps {steps} are given; a run is limited by one of them")
    limit = steps if steps is not None else 2.0 if minutes is None else minutes
    if not (limit > 0 and math.isfinite(limit)):
        raise MiNtfError(f"--{'minutes' if steps is None else 'steps'} is {limit:g}; it must be positive")
    files.check(output, (".safetensors",))
    with progress.Stage(f"reading {scene}"):
        subject = Subject(Path(scene), defined or {}, environment or Environment())
    names = subject.names(parameters)
    notes: list[str] = []
    splits = load_dataset(dataset, notes.append, size=size, masks=masks, background=background, flash=subject.flash)
    for note in notes:
        progress.say(note)
    run = Run(subject, splits, names, output, seed, gains and not splits["train"].calibrated)
    run.limit(60 * limit if steps is None else math.inf, steps or math.inf)
    return run.run()


class Run:
    """A refinement in progress."""

    def __init__(self, subject: Subject, splits: dict[str, Split], names: list[str], output: Path, seed: int,
                 gains: bool) -> None:
        self._subject, self._output, self._seed = subject, output, seed
        to_scene = subject.to_scene()
        self._pool = Photographs(joined(splits["train"], splits["val"]), to_scene, subject.solid)
        self._held = Photographs(splits["test"], to_scene, subject.solid)
        dense = any(name in names for name in ("density", "log_density"))
        # A picture without the linear parameters and a second projection cost more than they bring beside a density.
        self._linear = [name for name in names if name in LINEAR and not (dense and name in STEP_LENGTHS)]
        self._voxels: dict[str, Voxels] = {
            name: (Linear if name in self._linear else Descended)(name, subject.get(name), subject.lattice(name))
            for name in names}
        self._gains, self._with_gains = Gains(self._pool.views, not gains), gains
        side = min(DENSE_TILE if dense else TILE, self._pool.height, self._pool.width)
        self._spp = {name: max(1, rays // side**2) for name, rays in (DENSE_RAYS if dense else RAYS).items()}
        self._camera, self._side = Camera(side, side), side
        self._covered = [self._pool.covered(view) for view in range(self._pool.views)]
        self._exposure = self._bright()
        self.step, self._seconds, self._reserve = 0, 0.0, 0.0
        self._began = time.monotonic()
        self._sums = np.zeros(2)
        self.trace: list[tuple[int, float]] = []
        self._identity = {"parameters": names, "seed": seed, "gains": gains, "data": fingerprint(splits),
                          "field": subject.medium.field.digest, "scene": subject.digest}
        self._checkpoint = Path(f"{output}.ckpt")

    def limit(self, seconds: float, steps: float) -> None:
        """Set the limit of the run."""
        self._limits = seconds, steps
        self._identity |= {"limit": [str(seconds), str(steps)]}

    @property
    def seconds(self) -> float:
        """Seconds of work, those of interrupted runs included."""
        return self._seconds + time.monotonic() - self._began

    @property
    def progress(self) -> float:
        """Fraction of the run that is done."""
        seconds, steps = self._limits
        return max((self.seconds + self._reserve) / seconds, self.step / steps)

    def run(self) -> Refined:
        """Continue a checkpoint if there is one, refine to the limit, write the field and its page."""
        seconds = self._limits[0]
        with progress.Stage("refining", seconds=0.0 if seconds == math.inf else seconds,
                            then="the same command goes on") as stage:
            started = self.seconds
            before = compare(self._subject, self._held, self._with_gains)
            self._reserve = 1.5 * (self.seconds - started)
            original = {name: voxels.tensor() for name, voxels in self._voxels.items()}
            self._resume()
            if self._with_gains and not self.step:
                for view in range(self._pool.views):
                    self._measure(view)
                self._gains.settle()
            saved = time.monotonic()
            try:
                while self.progress < 1 or not self.step:
                    self._turn()
                    stage.update(min(self.progress, 1.0), f"step {self.step}, difference {self.trace[-1][1]:.1%}")
                    if time.monotonic() - saved > INTERVAL:
                        self._save()
                        saved = time.monotonic()
            except Exception as error:  # Mitsuba turns Ctrl-C into errors of its own
                if interruption.caused(error):
                    self._save()
                raise
            except KeyboardInterrupt:
                self._save()
                raise
            self._subject.set({name: voxels.tensor() for name, voxels in self._voxels.items()})
            after = compare(self._subject, self._held, self._with_gains)
            return self._finish(original, before, after)

    def _finish(self, original: dict[str, mi.TensorXf], before: list[Comparison], after: list[Comparison]) -> Refined:
        """Write field and page, delete the checkpoint, and return the figures."""
        errors = [difference(pictures) for pictures in (before, after)]
        improved = errors[1] <= errors[0]
        if not improved:
            self._subject.set(original)
        gains = {}
        if self._with_gains:
            gains = {name: [round(float(g), 4) for g in row]
                     for name, row in zip(self._pool.names, self._gains.all(), strict=True)}
        report = Refined(str(self._output), list(self._voxels), self.step, round(self.seconds, 1), errors[0], errors[1],
                         self._pool.views, improved, gains)
        record: Json = {k: v for k, v in asdict(report).items() if k not in ("file", "gains")}
        saving.save(self._subject, self._output, record)
        page.write(self._output, report, before, after, self.trace)
        checkpoint.delete(self._checkpoint)
        return report

    def _turn(self) -> None:
        """Take one step."""
        rng = np.random.default_rng([self._seed, self.step])
        view = int(rng.integers(self._pool.views))
        corner = self._aim(view, rng)
        target, weight = self._pool.part(view, corner, (self._side, self._side))
        self._subject.set({name: voxels.attach() for name, voxels in self._voxels.items()})
        one = self._render(3 * self.step)
        without = self._without(3 * self.step) if self._linear else one
        seed = self._seeded(3 * self.step + 1)
        direct = self._subject.render_direct(self._camera.sensor, seed, self._spp["differentiated"])
        other = self._render(3 * self.step + 2, "checked") if self._subject.bounces else direct.numpy()
        self._gains.add(view, products(one, other, target, weight))
        gain = self._gains.all()[view].astype(np.float32)
        error = gain * one - target
        self._sums = AVERAGE * self._sums + [(weight * error * (gain * other - target)).sum(),
                                             (weight * target**2).sum()]
        weight = gain * weight / (self._exposure * np.maximum(target, 0) + DARK)
        light = gain * np.maximum(one - without, 0)
        # The graph of derivatives is needed twice.
        errors = self._back_projected(direct, weight * error,
                                      dr.ADFlag.ClearVertices if self._linear else dr.ADFlag.Default)
        lights = self._back_projected(direct, weight * light, dr.ADFlag.Default) if self._linear else errors
        rate = max(min(2 - 2 * self.progress, 1.0), 0.0)
        for name, voxels in self._voxels.items():
            voxels.step(errors[name], lights[name], rate)
        self.step += 1
        self.trace.append((self.step, math.sqrt(max(self._sums[0], 0) / max(self._sums[1], 1e-30))))

    def _without(self, number: int) -> np.ndarray:
        """Return a picture with the linear parameters at 0."""
        self._subject.set({name: 0 * self._voxels[name].tensor() for name in self._linear})
        picture = self._render(number, "checked")
        self._subject.set({name: self._voxels[name].attach() for name in self._linear})
        return picture

    def _back_projected(self, picture: Array, values: np.ndarray, flags: dr.ADFlag) -> dict[str, Float]:
        """Return Jᵀ `values` (h, w, 3) by parameter, J being the derivative of `picture`."""
        dr.set_grad(picture, mi.TensorXf(np.ascontiguousarray(values, np.float32)))
        dr.enqueue(dr.ADMode.Backward, picture)
        dr.traverse(dr.ADMode.Backward, flags)
        return {name: voxels.projected() for name, voxels in self._voxels.items()}

    def _aim(self, view: int, rng: np.random.Generator) -> tuple[int, int]:
        """Move the camera to a random part of a photograph, around a pixel of the object; return the part's corner."""
        pool, side = self._pool, self._side
        row, column = self._covered[view][rng.integers(len(self._covered[view]))]
        shift = rng.integers(side, size=2)
        corner = (int(np.clip(row - shift[0], 0, pool.height - side)),
                  int(np.clip(column - shift[1], 0, pool.width - side)))
        pool.aim(self._camera, view, corner)
        self._subject.light(pool, view)
        return corner

    def _measure(self, view: int) -> None:
        """Compare a part of a photograph for its gain alone."""
        corner = self._aim(view, np.random.default_rng([self._seed, view, 1]))
        target, weight = self._pool.part(view, corner, (self._side, self._side))
        one, other = (self._render(-2 * view - k - 1) for k in range(2))
        self._gains.add(view, products(one, other, target, weight))

    def _render(self, number: int, use: str = "compared") -> np.ndarray:
        picture: np.ndarray = self._subject.render(self._camera.sensor, self._seeded(number), self._spp[use]).numpy()
        return picture

    def _seeded(self, number: int) -> int:
        return (number + 1000003 * self._seed) % (1 << 32)

    def _bright(self) -> float:
        """Return the exposure that brings bright parts of the object to 1."""
        values = []
        for view, pixels in enumerate(self._covered):
            row, column = pixels[len(pixels) // 2]
            corner = (int(min(row, self._pool.height - self._side)), int(min(column, self._pool.width - self._side)))
            colour, weight = self._pool.part(view, corner, (self._side, self._side))
            values.append(colour[weight[..., 0] > 0].mean(-1))
        bright = np.concatenate(values)
        return float(1 / max(np.quantile(bright, 0.95) if len(bright) else 1.0, 1e-6))

    def _resume(self) -> None:
        """Continue the checkpoint if there is one. Raises MiNtfError."""
        state = checkpoint.read(self._checkpoint, self._identity)
        if state is None:
            return
        head, arrays = state
        self.step, self._seconds, self._began = head["step"], head["seconds"], time.monotonic()
        self.trace = [(int(step), value) for step, value in head["trace"]]
        self._sums, self._gains.sums, self._gains.level = arrays["sums"], arrays["gains"], arrays["level"]
        for name, voxels in self._voxels.items():
            voxels.resume({k.removeprefix(f"{name}."): v for k, v in arrays.items() if k.startswith(f"{name}.")})

    def _save(self) -> None:
        """Write the checkpoint."""
        arrays = {"sums": self._sums, "gains": self._gains.sums, "level": self._gains.level}
        for name, voxels in self._voxels.items():
            arrays |= {f"{name}.{k}": v for k, v in voxels.state().items()}
        checkpoint.write(self._checkpoint, self._identity,
                         {"step": self.step, "seconds": self.seconds, "trace": self.trace}, arrays)

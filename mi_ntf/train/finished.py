"""Finished fields that a run begins with: all of them is trained further, or their transmittance alone anew."""

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..core import field_file
from ..core.architecture import Header
from ..core.errors import MiNtfError
from .config import Config, FastConfig
from .training_data import TrainingData

LATEST = 0.5
"""Latest time of the schedule, as a fraction of a run, at which further training begins. Its learning rates are a
seventh of the first ones, enough to change what a short earlier run has left coarse."""


@dataclass(frozen=True)
class FinishedField:
    """Field file that a run begins with.

    `further`: the run trains all of it; otherwise it keeps density and reflectance, and trains new transmittance
    networks.
    """

    path: Path
    header: Header
    tensors: dict[str, np.ndarray]
    further: bool

    @classmethod
    def load(cls, path: Path, further: bool = False) -> "FinishedField":
        """Read the field file `path`. Raises MiNtfError."""
        header, tensors = field_file.load(path)
        if any(field_file.refinement(tensors, quantity) for quantity in ("reflectance", "density")):
            raise MiNtfError(f"{path} was refined with `mi-ntf refine`, which training would undo; train the field "
                             "that it was made of, and refine the result again")
        return cls(path, header, tensors, further)

    @property
    def steps(self) -> int:
        """Number of steps that it was trained for, as far as they count as a part of the run."""
        return int(self.header.provenance.get("steps_done", 0)) if self.further else 0

    @property
    def seconds(self) -> float:
        """Seconds that it was trained for, as far as they count as a part of the run."""
        return float(self.header.provenance.get("seconds", 0.0)) if self.further else 0.0

    def begin(self, minutes: float | None, steps: int | None) -> float:
        """Return the time of the schedule, as a fraction of a run, at which a run of `minutes` or `steps` begins.

        It is that of one run as long as the field's and this one together, but at most LATEST.
        """
        if not self.further:
            return 0.0
        before, more = (self.steps, steps) if steps is not None else (self.seconds, 60 * (minutes or 0.0))
        return min(before / (before + more), LATEST)

    def configured(self, config: Config, ntf: str | None) -> FastConfig:
        """Return the settings for this field; `ntf` is the name of the transmittance network that the user asks for."""
        option = "--continue" if self.further else "--field"
        if not isinstance(config, FastConfig):
            raise MiNtfError(f"{option} goes with the preset 'fast' alone: the paper's learns field and transmittance "
                             "as one")
        field, phase = self.header.architecture, config.architecture.phase
        if phase not in (None, field.phase):
            learned = "surfaces" if field.phase is None else f"smoke of the asymmetry {field.phase:g}"
            raise MiNtfError(f"{self.path} was trained as {learned}, and {option} keeps that; leave --smoke and "
                             "--asymmetry out")
        if self.further and field.density.encoding.kind != "planes":
            raise MiNtfError(f"{self.path} was trained with another preset; --continue takes fields of the preset "
                             "'fast' further")
        architecture = replace(config.architecture, density=field.density, reflectance=field.reflectance,
                               fresnel=field.fresnel, retro=field.retro, tail=field.tail, phase=field.phase,
                               specular_channels=field.specular_channels)
        if not self.further:
            return replace(config, architecture=architecture, ntf_from=0.0, ntf_alone=0.0)
        if ntf is None:
            architecture = replace(architecture, transmittance=field.transmittance)
        return replace(config, architecture=replace(architecture,
                                                    visibility=architecture.visibility or field.visibility))

    def check(self, data: TrainingData) -> None:
        """Raise MiNtfError if the field was not trained on the data set `data`."""
        here, there = ((*s.center, s.radius) for s in (data.similarity, self.header.similarity))
        if max(abs(a - b) for a, b in zip(here, there, strict=True)) > 1e-4 * data.similarity.radius:
            option = "--continue" if self.further else "--field"
            raise MiNtfError(f"{self.path} has its unit sphere (centre, radius) at {there}, the data set has it at "
                             f"{here}; {option} needs the data set that the field was trained on")

    def digest(self) -> str:
        """Return a hash of the file."""
        return hashlib.sha256(self.path.read_bytes()).hexdigest()

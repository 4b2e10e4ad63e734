"""Photographs of all splits, and what is known of them before training."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, TypedDict

import torch

from ..core.architecture import Similarity
from ..data.readers import load_dataset
from ..data.schema import Split
from . import device, rays
from .monitor import Notes
from .rays import Photographs

SOLID = 0.5
"""Fraction of opaque pixels on the object above which it has a skin; below, it is smoke."""
SURVEYED = 1 << 18
"""Pixels from which brightness and opacity are measured."""


class Reading(TypedDict, total=False):
    """Options of :func:`mi_ntf.data.readers.load_dataset`."""

    size: int | None
    masks: Path | None
    background: str | None
    flash_offset: tuple[float, float, float] | Literal["estimate"] | None


@dataclass(frozen=True)
class TrainingData:
    """Photographs by the name of their split, and their brightness and opacity."""

    splits: dict[str, Split]
    photographs: dict[str, Photographs]
    opaque: float
    """Fraction of the object's pixels that nothing shines through: 0.9 and more of solid objects, 0.01 of a cloud."""
    exposure: float  # Factor that brings the bright parts of the object to 1
    on_lens: bool  # True if all lights are at their lenses, as far as the data set tells
    posed: bool  # True if the poses are exact, since `mi-ntf capture` has rendered the photographs

    @classmethod
    def load(cls, folder: Path, notes: Notes, reading: Reading) -> "TrainingData":
        """Read the data set in `folder`. Raises MiNtfError."""
        splits = load_dataset(folder, notes.add, **reading)
        photographs, views = {}, 0
        for name, split in splits.items():
            photographs[name] = Photographs(split, views)
            views += len(split.images)
        pool = photographs["train"]
        pick = torch.randint(len(pool), (min(len(pool), SURVEYED),), generator=device.generator(5))
        pixels = pool.pixels(pick)
        matter = pixels[pixels[:, 3] > (0.01 if pool.masked else 0.99)]
        opaque = float((matter[:, 3] > 0.99).float().mean()) if len(matter) else 1.0
        bright = matter[matter[:, 3] > 0.5][:, :3].mean(1)
        exposure = 1 / max(float(bright.quantile(0.95)) if 0 < len(bright) else 1.0, 1e-6)
        return cls(splits, photographs, opaque, exposure, all(p.on_lens for p in photographs.values()),
                   (folder / "capture.json").is_file())

    @property
    def solid(self) -> bool:
        """True if the object has a skin."""
        return self.opaque > SOLID

    @property
    def train(self) -> Photographs:
        """Photographs of the training split."""
        return self.photographs["train"]

    @property
    def all(self) -> list[Photographs]:
        """Photographs of all splits, in the order of their numbers."""
        return list(self.photographs.values())

    @property
    def similarity(self) -> Similarity:
        """Similarity transform between the world and the field."""
        split = self.splits["train"]
        x, y, z = map(float, split.center)
        return Similarity((x, y, z), float(split.radius))

    @property
    def pixel_width(self) -> float:
        """Width of a pixel at the centre of the unit sphere, field units."""
        return rays.pixel_width(self.splits["train"])

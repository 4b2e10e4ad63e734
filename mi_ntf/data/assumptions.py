"""Assumptions about a data set that its files decide, made once for all photographs, with a sentence for each.

    lights    a split whose frames all lack what the training split's have is left out
    names     a photograph may have another extension than the data set says (`file_names`)
    scale     all photographs may be scaled by one factor against the cameras' sizes
"""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_ntf.data import images
from mi_ntf.data.file_names import SUFFIXES
from mi_ntf.data.schema import View

PREFIX = "assumed: "
"""Beginning of each sentence by which `load_dataset` tells an assumption."""
UNSCALED = (0.9, 1.1)
"""Photographs whose size differs by a factor between these bounds count as cropped or foreign, not as scaled copies."""

Views = dict[str, list[View]]


class Assumed:
    """Assumptions about photographs: each sentence once, with the number of photographs that it holds for."""

    def __init__(self):
        self._found: dict[str, list[Path]] = {}

    def add(self, sentence: str | None, image: Path) -> None:
        """Note `sentence` of the photograph `image`; None: nothing was assumed."""
        if sentence is not None:
            self._found.setdefault(sentence, []).append(image)

    def sentences(self) -> list[str]:
        """The sentences in the order in which they came up."""
        return [f"{sentence} ({len(found)} photograph{'s' * (len(found) > 1)}, first {found[0]})"
                for sentence, found in self._found.items()]


def every(views: Views) -> list[View]:
    """The views of all splits."""
    return [view for split in views.values() for view in split]


def settle(views: Views) -> tuple[Views, list[str]]:
    """``(views, what was assumed)``."""
    views, notes = _lights(views)
    assumed = Assumed()
    for view in every(views):
        named = Path(view.name).suffix.lower()
        if named in SUFFIXES and view.image.suffix.lower() != named:
            assumed.add(f"a photograph that the data set calls {named} is the {view.image.suffix} of the same name",
                        view.image)
    views, scaled = _scaled(views)
    return views, [*notes, *assumed.sentences(), *scaled]


def _lights(views: Views) -> tuple[Views, list[str]]:
    """Remove the splits without light entries, if all frames for training have these entries."""
    kept, notes = dict(views), []
    for key, name in (("light_pos", "pl_pos"), ("light_intensity", "pl_intensity")):
        if any(getattr(view, key) is None for view in views["train"]):
            continue
        for split in [split for split, rest in kept.items() if all(getattr(view, key) is None for view in rest)]:
            del kept[split]
            notes.append(f"the {split} split is left out: none of its {len(views[split])} frames has '{name}', which "
                         "the frames for training have; write it there to use them")
    return kept, notes


def _scaled(views: Views) -> tuple[Views, list[str]]:
    """Scale the cameras to the photographs, if all photographs are copies scaled by one factor."""
    sized = [view for view in every(views) if view.size is not None and not view.rescaled]
    if not sized or _size(sized[0]) in (None, sized[0].size):
        return views, []
    sizes = [size for view in sized if (size := _size(view))]
    if len(sizes) < len(sized):  # reading it raises the error
        return views, []
    old, new = (np.array(s, np.float64) for s in ([view.size for view in sized], sizes))
    factor = float(np.median(np.sqrt(new.prod(1) / old.prod(1))))
    if UNSCALED[0] < factor < UNSCALED[1] or np.abs(new - factor * old).max() > 1:  # a pixel for rounding
        return views, []
    changed = {split: [replace(view, rescaled=True) for view in rest] for split, rest in views.items()}
    return changed, [f"photographs are copies scaled by {factor:.4g}, and so the cameras are scaled by that "
                     f"({sizes[0][0]}x{sizes[0][1]}, {sized[0].where} says {old[0, 0]:g}x{old[0, 1]:g})"]


def _size(view: View) -> tuple[int, int] | None:
    """(width, height) of the photograph as its camera sees it."""
    size = images.size_of(view.image)
    return size[::-1] if size and view.upright and view.orientation > 4 else size


def said(sentences: Iterable[str]) -> list[str]:
    """Return those of the `sentences` that tell an assumption."""
    return [sentence for sentence in sentences if sentence.startswith(PREFIX)]

"""Assumptions about a data set, made once for all photographs, with a sentence for each.

    orientation    pixels, poses and masks may be turned by the photographs' Exif orientation
    lights         a split without the light entries of the training split is dropped
    names          a photograph may have another extension than the data set says (`file_names`)
    scale          all photographs may be scaled by one factor against the cameras' sizes

Some programs turn a photograph as its Exif tag says, others use the pixels as stored. Sizes show what happened if a
quarter turn changes them. Photographs whose size does not tell (half turns, square pictures) follow the rest. If no
size tells, poses belong to the pixels as stored, and a mask is refused.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images
from mi_ntf.data.exif import Header, read_header
from mi_ntf.data.file_names import SUFFIXES, first
from mi_ntf.data.schema import View

PREFIX = "assumed: "  # beginning of each sentence by which `load_dataset` reports an assumption
UNSCALED = (0.9, 1.1)  # sizes that differ by a factor in this range belong to cropped or foreign photographs

Views = dict[str, list[View]]


class Assumptions:
    """Assumptions about photographs: each sentence once, with the number of photographs to which it applies."""

    def __init__(self) -> None:
        self._images: dict[str, list[Path]] = {}

    def add(self, sentence: str | None, image: Path) -> None:
        """Note `sentence` for the photograph `image`; None is ignored."""
        if sentence is not None:
            self._images.setdefault(sentence, []).append(image)

    def sentences(self) -> list[str]:
        """Return the sentences in the order of their first use."""
        return [f"{sentence} ({len(paths)} photograph{'s' * (len(paths) > 1)}, first {paths[0]})"
                for sentence, paths in self._images.items()]


def every(views: Views) -> list[View]:
    """Return the views of all splits."""
    return [view for split in views.values() for view in split]


def settle(views: Views, masked: bool) -> tuple[Views, list[str]]:
    """Return the views with all assumptions applied, and the assumptions.

    `masked` says that masks are read for photographs without alpha. Raises MiNtfError.
    """
    views, turns = turn(views, masked)
    views, notes = _drop_unlit(views)
    names = Assumptions()
    for view in every(views):
        suffix = Path(view.name).suffix.lower()
        if suffix in SUFFIXES and view.image.suffix.lower() != suffix:
            names.add(f"a photograph that the data set calls {suffix} is the {view.image.suffix} of the same name",
                      view.image)
    views, scales = _scale(views)
    return views, [*turns, *notes, *names.sentences(), *scales]


def _drop_unlit(views: Views) -> tuple[Views, list[str]]:
    """Remove the splits without light entries, if all frames for training have these entries."""
    lit, notes = dict(views), []
    for key, name in (("light_pos", "pl_pos"), ("light_intensity", "pl_intensity")):
        if any(getattr(view, key) is None for view in views["train"]):
            continue
        for split in [split for split, rest in lit.items() if all(getattr(view, key) is None for view in rest)]:
            del lit[split]
            notes.append(f"the {split} split is left out: none of its {len(views[split])} frames has '{name}', which "
                         "the frames for training have; write it there to use them")
    return lit, notes


def _scale(views: Views) -> tuple[Views, list[str]]:
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
    """Return (width, height) of the photograph as its camera sees it."""
    size = images.size_of(view.image)
    return size[::-1] if size and view.upright and view.orientation > 4 else size


class _Turned(NamedTuple):
    """Photograph with an Exif orientation. `pose` and `mask_turned` are None if the sizes do not tell."""

    view: View
    orientation: int
    pose: bool | None
    mask: Path | None
    mask_turned: bool | None


def turn(views: Views, masked: bool) -> tuple[Views, list[str]]:
    """Return the views with the orientation of photographs, poses and masks, and assumptions; see :func:`settle`."""
    tagged = [_inspect(view, header, masked) for view in every(views)
              if (header := read_header(view.image)) is not None and header.orientation != 1]
    pose = _common([photograph.pose for photograph in tagged]) or False
    mask = _common([photograph.mask_turned for photograph in tagged])
    assumed = Assumptions()
    settled = {id(photograph.view): _oriented(photograph, pose, mask, assumed) for photograph in tagged}
    return ({split: [settled.get(id(view), view) for view in rest] for split, rest in views.items()},
            assumed.sentences())


def _inspect(view: View, header: Header, masked: bool) -> _Turned:
    mask = first(view.masks) if masked and (view.mask_first or not header.has_alpha) else None
    of_mask = read_header(mask) if mask else None
    if of_mask is None:
        mask, mask_turned = None, None
    elif of_mask.orientation == header.orientation:  # it was stored with the same tag
        mask_turned = False
    else:
        mask_turned = _is_turned(of_mask.size, header)
    return _Turned(view, header.orientation, _is_turned(view.size, header), mask, mask_turned)


def _is_turned(size: tuple[int, int] | None, header: Header) -> bool | None:
    """Return True if (width, height) `size`, or a multiple of it, is that of the turned picture."""
    if size is None or header.orientation < 5:
        return None
    width, height = header.size
    stored, upright = (abs(size[0] * h / (size[1] * w) - 1) < 0.02 for w, h in ((width, height), (height, width)))
    return upright if stored != upright else None


def _common(votes: list[bool | None]) -> bool | None:
    """Return the value that all known entries share; None if they differ or nothing is known."""
    values = {vote for vote in votes if vote is not None}
    return values.pop() if len(values) == 1 else None


def _oriented(photograph: _Turned, pose: bool, mask: bool | None, assumed: Assumptions) -> View:
    """Return the view of a photograph; `pose` and `mask` say whether those of the rest are turned."""
    image = photograph.view.image
    upright = pose if photograph.pose is None else photograph.pose
    mask_upright = mask if photograph.mask_turned is None else photograph.mask_turned
    assumed.add(f"poses belong to the photographs {'turned as' if upright else 'as stored, not turned as'} their Exif "
                "orientation says", image)
    if photograph.mask is None:
        return replace(photograph.view, orientation=photograph.orientation, upright=upright)
    if mask_upright is None:
        raise MiNtfError(f"{photograph.mask}: its photograph {image} has Exif orientation {photograph.orientation}, "
                         "and nothing tells whether the mask is turned by that; turn it as the pixels are stored, "
                         f"and take the tag out with `exiftool -Orientation= {image}`")
    assumed.add(f"masks are {'turned as' if mask_upright else 'as stored, not turned as'} the Exif orientation of "
                "their photographs says", image)
    return replace(photograph.view, orientation=photograph.orientation, upright=upright, mask_upright=mask_upright)

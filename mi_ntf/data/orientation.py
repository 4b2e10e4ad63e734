"""Exif orientations: which of pixels, poses and masks are turned by them.

Some programs turn a photograph as its tag says, others read the pixels as they are stored. Sizes tell what happened
where a quarter turn changes them. What is the same either way (half turns, square pictures) follows the other
photographs; else poses belong to the pixels as stored, and a mask is refused.
"""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.assumptions import Assumed, Views, every
from mi_ntf.data.exif import Head, head
from mi_ntf.data.file_names import first
from mi_ntf.data.schema import View


class Turned(NamedTuple):
    """A photograph with an Exif orientation, and what the sizes say; None: they do not tell."""

    view: View
    head: Head
    pose: bool | None
    mask: Path | None
    mask_turned: bool | None


def settle(views: Views, masked: bool) -> tuple[Views, list[str]]:
    """``(views, what was assumed)``: the views with how their photographs and masks are turned. `masked`: masks are
    read where a photograph has no alpha. Raises MiNtfError."""
    found = [_looked_at(view, told, masked) for view in every(views)
             if (told := head(view.image)) is not None and told.orientation != 1]
    pose = _common([one.pose for one in found]) or False
    mask = _common([one.mask_turned for one in found])
    assumed = Assumed()
    settled = {id(one.view): _settled(one, pose, mask, assumed) for one in found}
    return ({split: [settled.get(id(view), view) for view in rest] for split, rest in views.items()},
            assumed.sentences())


def _looked_at(view: View, told: Head, masked: bool) -> Turned:
    wanted = masked and (view.mask_first or not told.has_alpha)
    mask = first(view.masks) if wanted else None
    of_mask = head(mask) if mask else None
    if of_mask is None:
        mask_turned = None
    elif of_mask.orientation == told.orientation:  # it was stored with the same tag
        mask_turned = False
    else:
        mask_turned = _is_turned(of_mask.size, told)
    return Turned(view, told, _is_turned(view.size, told), mask if of_mask else None, mask_turned)


def _is_turned(size: tuple[int, int] | None, told: Head) -> bool | None:
    """Return True if (width, height) `size`, or a multiple of it, is that of the turned picture."""
    if size is None or told.orientation < 5:
        return None
    width, height = told.size
    stored, upright = (abs(size[0] * h / (size[1] * w) - 1) < 0.02 for w, h in ((width, height), (height, width)))
    return upright if stored != upright else None


def _common(votes: list[bool | None]) -> bool | None:
    """Return the value that all known entries share; None where they differ or nothing is known."""
    said = {vote for vote in votes if vote is not None}
    return said.pop() if len(said) == 1 else None


def _settled(one: Turned, pose: bool, mask: bool | None, assumed: Assumed) -> View:
    """The view of a photograph; `pose`, `mask`: whether those of the others are turned."""
    image, orientation = one.view.image, one.head.orientation
    upright = pose if one.pose is None else one.pose
    mask_upright = mask if one.mask_turned is None else one.mask_turned
    assumed.add(f"poses belong to the photographs {'turned as' if upright else 'as stored, not turned as'} their Exif "
                "orientation says", image)
    if one.mask is None:
        return replace(one.view, orientation=orientation, upright=upright)
    if mask_upright is None:
        raise MiNtfError(f"{one.mask}: its photograph {image} has Exif orientation {orientation}, and nothing tells "
                         "whether the mask is turned by that or lies as the pixels are stored; make it so that it lies "
                         f"as they are stored, and take the tag out with `exiftool -Orientation= {image}`")
    assumed.add(f"masks are {'turned as' if mask_upright else 'as stored, not turned as'} the Exif orientation of "
                "their photographs says", image)
    return replace(one.view, orientation=orientation, upright=upright, mask_upright=mask_upright)

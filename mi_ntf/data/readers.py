"""Everything that training reads, behind one function: :func:`load_dataset` tells a folder's form by its files.

    transforms_train.json    captures of `mi-ntf capture`, NeRF-synthetic (Blender), NRHints: `transforms_json`
    transforms.json          nerfstudio, instant-ngp: `nerfstudio`
    a COLMAP model           cameras, images, points3D (.bin or .txt) and `images/`: `colmap`
    poses_bounds.npy         LLFF, with `images/`: `llff`

What a form leaves open is decided here, alike for all, and said aloud: held-back views are split off, the object's
sphere is found (`bounds`), the light is put at the camera or beside it, its intensity estimated (`light`). Every fault
raises MiNtfError.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import (
    assumptions,
    bounds,
    colmap,
    file_names,
    images,
    lens,
    light,
    llff,
    nerfstudio,
    orientation,
    photographs,
    poses,
    transforms_json,
)
from mi_ntf.data.assumptions import PREFIX, Assumed
from mi_ntf.data.schema import Found, Split, View

FORMS = (
    ("transforms_<split>.json", lambda folder: (folder / "transforms_train.json").is_file(), transforms_json.read),
    (nerfstudio.FORM, lambda folder: (folder / "transforms.json").is_file(), nerfstudio.read),
    (colmap.FORM, lambda folder: bool(colmap.models(folder)), colmap.read),
    (llff.FORM, lambda folder: (folder / "poses_bounds.npy").is_file(), llff.read),
)
"""Name, whether a folder is of the form, reader. Where a folder is of several, the first is the one that says most."""
BACKGROUNDS = ("black",)
SMALLEST = 8
"""Pixels of the longer side that photographs may be scaled down to."""


def load_dataset(folder: Path, say: Callable[[str], None] = print, *, size: int | None = None,
                 masks: Path | None = None, background: str | None = None,
                 flash_offset: tuple[float, float, float] | None = None) -> dict[str, Split]:
    """The splits `train`, `val` and `test` with all their images, in one similarity. Raises MiNtfError.

    `say` is called with one sentence on what was found, and one for each thing that the data set left open.

    `size`: longer side, pixels, that photographs are scaled down to, in linear light. `masks`: folder of masks by the
    photographs' names, instead of alpha channels and what the form says. `background` "black": no masks, the
    photographs were taken with a flash in a dark room (:attr:`Split.masked`). `flash_offset`: the flash's place (right,
    up, forward) from the lens in the data set's own lengths, for one that says no `pl_pos`.
    """
    folder = Path(folder)
    _check_options(size, masks, background, flash_offset)
    form, reader, notes = _find(folder)
    try:
        found = reader(folder)
        form = found.form
        views = _with_options(found.views, masks, flash_offset)
        views, turned = orientation.settle(views, background is None)
        views, settled = assumptions.settle(views)
        say(_summary(found, folder, size, background))
        for note in [*notes, *found.notes, *(PREFIX + text for text in [*found.assumed, *turned, *settled])]:
            say(note)
        return _load(folder, found, split_off(views, say), say, size, background == "black", flash_offset)
    except MiNtfError as error:
        raise MiNtfError(f"{error} (read as {form})") from error


def _load(folder: Path, found: Found, views: dict[str, list[View]], say: Callable[[str], None], size: int | None,
          black: bool, flash_offset: tuple[float, float, float] | None) -> dict[str, Split]:
    """The splits of `views` with their images, and what the data set leaves open."""
    every = [view for split in views.values() for view in split]
    _check_lights(every)
    poses.check_views(views["train"], None if found.sphere is None else found.sphere[0])
    for view in every:  # before an hour is spent on those that are there
        images.check_exists(view.image)
    assumed = Assumed()
    loaded = {name: photographs.load(split, size, black, assumed) for name, split in views.items()}
    for text in assumed.sentences():
        say(PREFIX + text)
    _check_masks(views["train"], loaded["train"][0])
    _say_pixels(loaded["train"][0], size, black, say)
    if found.sphere is None:
        center, radius, how = bounds.find(*loaded["train"], found.points, "lit regions" if black else "masks")
        say(f"the object's sphere is found {how}: center {center.round(4).tolist()}, radius {radius:.4g}")
    else:
        (center, radius), how = found.sphere, "'unit_sphere' of the data set"
    poses.check_outside(every, center, radius, how)
    places = {name: _light_positions(split) for name, split in views.items()}
    if flash_offset is not None:
        say("the flash is taken to be {:g} right, {:g} up, {:g} forward of the lens, in the data set's lengths".format(
            *flash_offset))
    elif every[0].light_pos is None:
        say("no light positions given ('pl_pos'): a flash at the lens is assumed; under any other light the "
            "reflectance comes out wrong (--flash-offset says where it is)")
    intensity = None
    if every[0].light_intensity is None:
        intensity = light.estimate(loaded["train"][0], places["train"], center, radius)
        say(f"no light intensity given ('pl_intensity'): {intensity:.4g} W/sr estimated, so that bright surfaces have "
            f"albedo {light.ALBEDO}; photographs determine intensity times albedo alone")
    return {name: Split(*loaded[name], places[name], _intensities(split, intensity), center, radius,
                        tuple(_name(view, folder) for view in split), not black, intensity is None,
                        every[0].light_pos is not None)
            for name, split in views.items()}


def _check_options(size: int | None, masks: Path | None, background: str | None, flash_offset) -> None:
    if size is not None and size < SMALLEST:
        raise MiNtfError(f"size is {size}, must be {SMALLEST} or more: the pixels of the photographs' longer side")
    if background is not None and background not in BACKGROUNDS:
        raise MiNtfError(f"background is {background!r}, must be {' or '.join(map(repr, BACKGROUNDS))}, for "
                         "photographs with a flash in a dark room; leave it out where there are masks")
    if background is not None and masks is not None:
        raise MiNtfError(f"masks ({masks}) and background {background!r} are both given; before a black background no "
                         "masks are looked for: leave one of the two out")
    if masks is not None and not Path(masks).is_dir():
        raise MiNtfError(f"{masks} does not exist or is no folder; name the folder that holds the masks, named as the "
                         "photographs are (white: object)")
    if flash_offset is not None and not (len(flash_offset) == 3 and np.isfinite(flash_offset).all()):
        raise MiNtfError(f"flash_offset is {flash_offset}, expected three numbers: right, up, forward of the lens")


def _find(folder: Path) -> tuple[str, Callable[[Path], Found], list[str]]:
    """``(form, reader, notes)`` of what lies in `folder`."""
    if not folder.is_dir():
        raise MiNtfError(f"{folder} does not exist or is no folder; make a data set with "
                         f"`mi-ntf capture SCENE.xml {folder}`")
    there = [(form, reader) for form, is_there, reader in FORMS if is_there(folder)]
    if not there:
        raise MiNtfError(f"{folder}: no data set is here: neither transforms_train.json (capture, NeRF-synthetic, "
                         "NRHints) nor transforms.json (nerfstudio) nor a COLMAP model (cameras and images, .bin or "
                         ".txt, in sparse/0, sparse or the folder itself) nor poses_bounds.npy (LLFF); "
                         f"make one with `mi-ntf capture SCENE.xml {folder}`")
    notes = [f"also in the folder, and left aside: {form}" for form, _ in there[1:]]
    return *there[0], notes


def _with_options(views: dict[str, list[View]], masks: Path | None, flash_offset) -> dict[str, list[View]]:
    """`views` with the user's folder of masks and place of the flash."""
    every = [view for split in views.values() for view in split]
    alone = Counter(Path(view.name).stem for view in every)

    def change(view: View) -> View:
        if masks is not None:
            base = Path(view.name).name
            places = file_names.mask_places(Path(masks), view.name)
            if alone[Path(base).stem] == 1:  # else a mask could be another photograph's
                places += file_names.mask_places(Path(masks), base)
            view = replace(view, masks=places, mask_first=True)
        if flash_offset is None:
            return view
        if view.light_pos is not None:
            raise MiNtfError(f"{view.where}: 'pl_pos' says where the light is, and so does a flash offset of "
                             f"{list(flash_offset)}; leave one of the two out")
        right, up, forward = flash_offset
        return replace(view, light_pos=(view.c2w @ (right, up, -forward, 1.0))[:3])

    return {name: [change(view) for view in split] for name, split in views.items()}


def _summary(found: Found, folder: Path, size: int | None, background: str | None) -> str:
    """Describe the data set in one line."""
    every = [view for split in found.views.values() for view in split]
    pixels, told = images.size_of(every[0].image), ""
    if pixels is not None:
        told = ", {}x{} pixels".format(*pixels)
        if lens.shrunk(*pixels, size) != pixels:
            told += ", scaled to {}x{}".format(*lens.shrunk(*pixels, size))
    bent = any(getattr(view.camera, "distortion", ()) for view in every)
    return (f"{found.form} in {folder}: {len(every)} photographs{told}{', lens distortion undone' if bent else ''}"
            f"{f', {background} background' if background else ''}")


def _say_pixels(stored: np.ndarray, size: int | None, black: bool, say: Callable[[str], None]) -> None:
    height, width = stored.shape[1:3]
    if size is not None and max(height, width) < size:
        say(f"size {size} is more than the photographs have ({width}x{height}): they are left as they are")
    if black:
        empty, matter = (np.mean([np.mean(image[..., 3] == v) for image in stored])
                         for v in (0, stored.dtype.type(255 if stored.dtype == np.uint8 else 1)))
        say(f"black background: of a photograph for training {empty:.0%} is known to be empty, {matter:.0%} lit; what "
            "is between is learned. Everything that the flash lights is taken for the object")


def _check_lights(every: list[View]) -> None:
    for key, alone in (("light_pos", "pl_pos"), ("light_intensity", "pl_intensity")):
        lacking = [view for view in every if getattr(view, key) is None]
        if 0 < len(lacking) < len(every):
            raise MiNtfError(f"{lacking[0].where}: '{alone}' is missing, {len(every) - len(lacking)} other frames have "
                             f"it; give it in all frames (for a flash on the camera, pl_pos is the camera's position) "
                             "or in none")


def split_off(views: dict[str, list[View]], say: Callable[[str], None]) -> dict[str, list[View]]:
    """`views` with the splits it lacks taken from `train`: a tenth for test, a twentieth for val, one at least, evenly
    spaced in their order, hence the same in every run."""
    views = dict(views)
    for name, share in (("test", 10), ("val", 20)):
        if name in views:
            continue
        train = views["train"]
        count = max(1, len(train) // share)
        if len(train) <= count:
            raise MiNtfError(f"{train[0].where}: there is no {name} split and {len(train)} photograph for training, "
                             "too few to hold one back; add photographs")
        held = {int((i + 0.5) * len(train) / count) for i in range(count)}
        views[name] = [view for i, view in enumerate(train) if i in held]
        views["train"] = [view for i, view in enumerate(train) if i not in held]
        say(f"no {name} split: {count} of {len(train)} photographs for training are held back for it")
    return {name: views[name] for name in ("train", "val", "test")}


def _check_masks(views: list[View], stored: np.ndarray) -> None:
    """A photograph for training that shows nothing would empty the whole space."""
    for view, image in zip(views, stored, strict=True):
        if not bounds.covered(image).any():
            most = float(image[..., 3].max()) / (255 if image.dtype == np.uint8 else 1)
            raise MiNtfError(f"{view.image}: its alpha is {most:.2g} at most, so it shows no object; repair its mask "
                             "(white: object) or take the photograph out")


def _light_positions(views: list[View]) -> np.ndarray:
    return np.stack([v.c2w[:3, 3] if v.light_pos is None else v.light_pos for v in views]).astype(np.float32)


def _intensities(views: list[View], estimated: float | None) -> np.ndarray:
    return np.stack([np.full(3, estimated) if v.light_intensity is None else v.light_intensity for v in views]
                    ).astype(np.float32)


def _name(view: View, folder: Path) -> str:
    return str(view.image.relative_to(folder) if view.image.is_relative_to(folder) else view.image)

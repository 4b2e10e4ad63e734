"""Data sets as training reads them: :func:`load_dataset` recognises a folder's form by its files.

    transforms_train.json    captures of `mi-ntf capture`, NeRF-synthetic (Blender), NRHints: `transforms_json`
    transforms.json          nerfstudio, instant-ngp: `transforms_json`
    a COLMAP model           cameras, images, points3D (.bin or .txt) and `images/`: `colmap`
    poses_bounds.npy         LLFF, with `images/`: `llff`

Whatever a form leaves open is decided here, in the same way for all forms, and reported: views are held back for
missing splits, the object's sphere and the flash's intensity are estimated (`estimates`), and the light is put at the
camera or beside it. Every fault raises MiNtfError.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from mi_ntf.core import progress
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import (
    assumptions,
    colmap,
    estimates,
    file_names,
    images,
    lens,
    llff,
    photographs,
    poses,
    transforms_json,
)
from mi_ntf.data.assumptions import PREFIX, Assumptions, Views, every
from mi_ntf.data.schema import DataSet, Split, View


class Form(NamedTuple):
    """Form of data sets."""

    name: str
    is_in: Callable[[Path], bool]  # True if a folder holds a data set of the form
    read: Callable[[Path], DataSet]


FORMS = (
    Form("transforms_<split>.json", lambda folder: (folder / "transforms_train.json").is_file(),
         transforms_json.read_splits),
    Form(transforms_json.NERFSTUDIO, lambda folder: (folder / "transforms.json").is_file(),
         transforms_json.read_nerfstudio),
    Form(colmap.FORM, lambda folder: bool(colmap.models(folder)), colmap.read),
    Form(llff.FORM, lambda folder: (folder / "poses_bounds.npy").is_file(), llff.read),
)
"""All forms. If a folder has several, the first is the one that says most."""
SMALLEST = 8  # pixels of the longer side to which photographs may be scaled down

Say = Callable[[str], None]
Offset = tuple[float, float, float]


def load_dataset(folder: Path, say: Say = print, *, size: int | None = None, masks: Path | None = None,
                 background: str | None = None, flash_offset: Offset | Literal["estimate"] | None = None,
                 flash: bool = True) -> dict[str, Split]:
    """Return the splits `train`, `val` and `test` with all their images, in one similarity.

    Parameters
    ----------
    folder : Path
        Folder of one of the ``FORMS``.
    say : callable
        Called with a summary sentence, and with one sentence for each decision that the data set leaves open.
    size : int, optional
        Longer side in pixels to which photographs are scaled down, in linear light.
    masks : Path, optional
        Folder of masks with the photographs' names, instead of alpha channels and the form's own masks.
    background : str, optional
        "black": there are no masks, and the flash was the only light in a dark room (:attr:`Split.masked`).
    flash_offset : tuple of float or "estimate", optional
        Place of the flash (right, up, forward) from the lens in the data set's lengths, if it has no `pl_pos`. With
        "estimate" the lens is its place until training has found another.
    flash : bool
        False: the caller knows the light. Lights that the data set does not have are not estimated.

    Raises
    ------
    MiNtfError
        If there is no data set in `folder`, or it has a fault.
    """
    folder, estimate = Path(folder), flash_offset == "estimate"
    offset = None if isinstance(flash_offset, str) else flash_offset
    _check_options(size, masks, background, offset)
    form, notes = find_form(folder)
    name = form.name
    try:
        data = form.read(folder)
        name = data.form
        views, assumed = assumptions.settle(_with_options(data.views, masks, offset), background is None)
        say(_summary(data, folder, size, background))
        for note in [*notes, *data.notes, *(PREFIX + text for text in [*data.assumed, *assumed])]:
            say(note)
        return _load(folder, data, split_off(views, say), say, size, background == "black",
                     flash, _flash_note(offset, estimate, views["train"][0]) if flash else None)
    except MiNtfError as error:
        raise MiNtfError(f"{error} (read as {name})") from error


def _load(folder: Path, data: DataSet, views: Views, say: Say, size: int | None, black: bool, flash: bool,
          note: str | None) -> dict[str, Split]:
    """Return the splits of `views` with their images and everything that the data set leaves open.

    `flash`: estimate the intensity of a flash where the data set has none; `note` is a note on its place.
    """
    _check_lights(every(views))
    poses.check_views(views["train"], None if data.sphere is None else data.sphere[0])
    for view in every(views):  # before an hour is spent on the existing ones
        images.check_exists(view.image)
    assumed = Assumptions()
    with progress.Stage("photographs", len(every(views))) as stage:
        loaded = {name: photographs.load(split, size, black, assumed, stage.advance) for name, split in views.items()}
    for text in assumed.sentences():
        say(PREFIX + text)
    _check_masks(views["train"], loaded["train"].images)
    _say_pixels(loaded["train"].images, size, black, say)
    if data.sphere is None:
        with progress.Stage("finding the object's sphere"):
            (center, radius), source = estimates.find_sphere(*loaded["train"], data.points,
                                                             "lit regions" if black else "masks")
        say(f"the object's sphere is found {source}: center {center.round(4).tolist()}, radius {radius:.4g}")
    else:
        (center, radius), source = data.sphere, "'unit_sphere' of the data set"
    poses.check_outside(every(views), center, radius, source)
    lights = {name: np.stack([v.c2w[:3, 3] if v.light_pos is None else v.light_pos for v in split])
              for name, split in views.items()}
    first = views["train"][0]
    if note:
        say(note)
    calibrated, estimate = first.light_intensity is not None, 1.0
    if not calibrated and flash:
        estimate = estimates.find_intensity(loaded["train"].images, lights["train"], center, radius)
        say(f"no light intensity given ('pl_intensity'): {estimate:.4g} W/sr estimated, so that bright surfaces have "
            f"albedo {estimates.ALBEDO}; photographs determine intensity times albedo alone")
    intensities = {name: np.stack([np.full(3, estimate) if v.light_intensity is None else v.light_intensity
                                   for v in split]).astype(np.float32) for name, split in views.items()}
    return {name: Split(*loaded[name], lights[name], intensities[name], center, radius,
                        tuple(str(path.relative_to(folder) if path.is_relative_to(folder) else path)
                              for path in (view.image for view in split)),
                        not black, calibrated, first.light_pos is not None)
            for name, split in views.items()}


def _flash_note(offset: Offset | None, estimate: bool, view: View) -> str | None:
    """Return the note on the flash's place, None if the data set has it."""
    if offset is not None:
        right, up, forward = offset
        return (f"the flash is taken to be {right:g} right, {up:g} up, {forward:g} forward of the lens, in the data "
                "set's lengths")
    if view.light_pos is not None:
        return None
    if estimate:
        return "no light positions given ('pl_pos'): training estimates where the flash stands"
    return ("no light positions given ('pl_pos'): a flash at the lens is assumed; under any other light the "
            "reflectance comes out wrong (--flash-offset says where it is, `train --flash-offset estimate` finds it)")


def _check_options(size: int | None, masks: Path | None, background: str | None, flash_offset: Offset | None) -> None:
    if size is not None and size < SMALLEST:
        raise MiNtfError(f"size is {size}, must be {SMALLEST} or more: the pixels of the photographs' longer side")
    if background not in (None, "black"):
        raise MiNtfError(f"background is {background!r}, must be 'black', for photographs with a flash in a dark room; "
                         "leave it out where there are masks")
    if background is not None and masks is not None:
        raise MiNtfError(f"masks ({masks}) and background {background!r} are both given; before a black background no "
                         "masks are looked for: leave one of the two out")
    if masks is not None and not Path(masks).is_dir():
        raise MiNtfError(f"{masks} does not exist or is no folder; name the folder that holds the masks, named as the "
                         "photographs are (white: object)")
    if flash_offset is not None and not (len(flash_offset) == 3 and np.isfinite(flash_offset).all()):
        raise MiNtfError(f"flash_offset is {flash_offset}, expected three numbers: right, up, forward of the lens")


def find_form(folder: Path) -> tuple[Form, list[str]]:
    """Return the form of the data set in `folder`, and notes on further forms. Raises MiNtfError if there is none."""
    if folder.is_file():
        raise MiNtfError(f"{folder} is a file; name the folder that it is in, {folder.parent}")
    if not folder.is_dir():
        raise MiNtfError(f"{folder} does not exist or is no folder; make a data set with "
                         f"`mi-ntf capture SCENE.xml {folder}`")
    forms = [form for form in FORMS if form.is_in(folder)]
    if not forms:
        near = [str(place) for place in (folder.parent, *sorted(folder.iterdir())) if place.is_dir()
                and any(form.is_in(place) for form in FORMS)]
        if near:
            others = f"{' and '.join(near[:5])} {'holds' if len(near) == 1 else 'hold'} one"
            raise MiNtfError(f"{folder}: no data set is here, but {others}; name that folder")
        count = len(file_names.photographs([*folder.iterdir(), *folder.glob("images/*")]))
        if count:
            raise MiNtfError(f"{folder}: {count} photographs are here, but no camera poses; put them into "
                             f"{folder}/images and run `colmap automatic_reconstructor --workspace_path {folder} "
                             f"--image_path {folder}/images --dense 0`")
        raise MiNtfError(f"{folder}: no data set is here: neither transforms_train.json (capture, NeRF-synthetic, "
                         "NRHints) nor transforms.json (nerfstudio) nor a COLMAP model (cameras and images, .bin or "
                         ".txt, in sparse/0, sparse or the folder itself) nor poses_bounds.npy (LLFF); "
                         f"make one with `mi-ntf capture SCENE.xml {folder}`")
    return forms[0], [f"also in the folder, and ignored: {form.name}" for form in forms[1:]]


def _with_options(views: Views, masks: Path | None, flash_offset: Offset | None) -> Views:
    """Return `views` with the user's folder of masks and place of the flash."""
    stems = Counter(Path(view.name).stem for view in every(views))

    def change(view: View) -> View:
        if masks is not None:
            base = Path(view.name).name
            places = file_names.mask_places(Path(masks), view.name)
            if stems[Path(base).stem] == 1:  # else a mask could be another photograph's
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


def _summary(data: DataSet, folder: Path, size: int | None, background: str | None) -> str:
    views = every(data.views)
    pixels, text = images.size_of(views[0].image), f"{data.form} in {folder}: {len(views)} photographs"
    if pixels is not None:
        text += ", {}x{} pixels".format(*pixels)
        if lens.shrunk(*pixels, size) != pixels:
            text += ", scaled to {}x{}".format(*lens.shrunk(*pixels, size))
    if any(getattr(view.camera, "distortion", ()) for view in views):
        text += ", lens distortion undone"
    return f"{text}, {background} background" if background else text


def _say_pixels(stored: np.ndarray, size: int | None, black: bool, say: Say) -> None:
    height, width = stored.shape[1:3]
    if size is not None and max(height, width) < size:
        say(f"size {size} is more than the photographs have ({width}x{height}): they are left as they are")
    if black:
        empty, matter = (np.mean([np.mean(image[..., 3] == v) for image in stored])
                         for v in (0, stored.dtype.type(255 if stored.dtype == np.uint8 else 1)))
        say(f"black background: {empty:.0%} of the pixels for training are known to be empty, {matter:.0%} are lit; "
            "training resolves the rest. Everything that the flash lights counts as the object")


def _check_lights(views: list[View]) -> None:
    for key, name in (("light_pos", "pl_pos"), ("light_intensity", "pl_intensity")):
        lacking = [view for view in views if getattr(view, key) is None]
        if 0 < len(lacking) < len(views):
            raise MiNtfError(f"{lacking[0].where}: '{name}' is missing, {len(views) - len(lacking)} other frames have "
                             f"it; give it in all frames (for a flash on the camera, pl_pos is the camera's position) "
                             "or in none")


def split_off(views: Views, say: Say) -> Views:
    """Take missing splits from `train`: a tenth for test, a twentieth for val, at least one, evenly spaced."""
    views = dict(views)
    for name, divisor in (("test", 10), ("val", 20)):
        if name in views:
            continue
        train = views["train"]
        count = max(1, len(train) // divisor)
        if len(train) <= count:
            raise MiNtfError(f"{train[0].where}: there is no {name} split and {len(train)} photograph for training, "
                             "too few to hold one back; add photographs")
        held = {int((i + 0.5) * len(train) / count) for i in range(count)}
        views[name] = [view for i, view in enumerate(train) if i in held]
        views["train"] = [view for i, view in enumerate(train) if i not in held]
        say(f"no {name} split: {count} of {len(train)} photographs for training are held back for it")
    return {name: views[name] for name in ("train", "val", "test")}


def _check_masks(views: list[View], stored: np.ndarray) -> None:
    """Raise MiNtfError if a photograph shows nothing: it would empty the whole space."""
    for view, image in zip(views, stored, strict=True):
        if not estimates.covered(image).any():
            most = float(image[..., 3].max()) / (255 if image.dtype == np.uint8 else 1)
            raise MiNtfError(f"{view.image}: its alpha is {most:.2g} at most, so it shows no object; repair its mask "
                             "(white: object) or take the photograph out")

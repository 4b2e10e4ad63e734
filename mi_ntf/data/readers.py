"""Everything that training reads, behind one function: :func:`load_dataset` tells a folder's form by its files.

    transforms_train.json    captures of `mi-ntf capture`, NeRF-synthetic (Blender), NRHints: `transforms_json`
    a COLMAP model           cameras, images, points3D (.bin or .txt) and `images/`: `colmap`

What a form leaves open is decided here, alike for all, and said aloud: held-back views are split off, the object's
sphere is found (`bounds`), the light is put at the camera and its intensity estimated (`light`). Every fault raises
MiNtfError.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import bounds, colmap, light, poses, transforms_json
from mi_ntf.data.images import read_photograph
from mi_ntf.data.schema import Found, Split, View, focal_length


def load_dataset(folder: Path, say: Callable[[str], None] = print) -> dict[str, Split]:
    """The splits `train`, `val` and `test` with all their images, in one similarity. Raises MiNtfError.

    `say` is called with one sentence for each thing that the data set left open.
    """
    found = _find(Path(folder))
    for note in found.notes:
        say(note)
    views = split_off(found.views, say)
    every = [view for split in views.values() for view in split]
    for key, alone in (("light_pos", "pl_pos"), ("light_intensity", "pl_intensity")):
        lacking = [view for view in every if getattr(view, key) is None]
        if 0 < len(lacking) < len(every):
            raise MiNtfError(f"{lacking[0].where}: '{alone}' is missing, {len(every) - len(lacking)} other frames have "
                             f"it; give it in all frames (for a flash on the camera, pl_pos is the camera's position) "
                             "or in none")
    poses.check_views(views["train"], None if found.sphere is None else found.sphere[0])
    pictures = {name: _load(split) for name, split in views.items()}
    cameras = {name: _cameras(split, pictures[name]) for name, split in views.items()}
    _check_masks(views["train"], pictures["train"])
    if found.sphere is None:
        center, radius, how = bounds.find(pictures["train"][..., 3], *cameras["train"], found.points)
        say(f"the object's sphere is found {how}: center {center.round(4).tolist()}, radius {radius:.4g}")
    else:
        (center, radius), how = found.sphere, "'unit_sphere' of the data set"
    poses.check_outside(every, center, radius, how)
    places = {name: _light_positions(split) for name, split in views.items()}
    if every[0].light_pos is None:
        say("no light positions given ('pl_pos'): a flash at the lens is assumed; under any other light the "
            "reflectance comes out wrong")
    intensity = None
    if every[0].light_intensity is None:
        intensity = light.estimate(pictures["train"], places["train"], center, radius)
        say(f"no light intensity given ('pl_intensity'): {intensity:.4g} W/sr estimated, so that bright surfaces have "
            f"albedo {light.ALBEDO}; photographs determine intensity times albedo alone")
    return {name: Split(pictures[name], *cameras[name], places[name], _intensities(split, intensity), center, radius)
            for name, split in views.items()}


def _find(folder: Path) -> Found:
    """What lies in `folder`, by its form."""
    if not folder.is_dir():
        raise MiNtfError(f"{folder} does not exist or is no folder; make a data set with "
                         f"`mi-ntf capture SCENE.xml {folder}`")
    if (folder / "transforms_train.json").is_file():
        return transforms_json.read(folder)
    model = colmap.find_model(folder)
    if model is not None:
        return colmap.read(folder, model)
    raise MiNtfError(f"{folder}: no data set is here: neither transforms_train.json (capture, NeRF-synthetic, NRHints) "
                     "nor a COLMAP model (cameras and images, .bin or .txt, in sparse/0, sparse or the folder itself); "
                     f"make one with `mi-ntf capture SCENE.xml {folder}`")


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


def _load(views: list[View]) -> np.ndarray:
    """The photographs of a split, (N, H, W, 4) float32, all of one size."""
    images = np.empty((0, 0, 0, 4), np.float32)
    for i, view in enumerate(views):
        pixels = read_photograph(view.image, view.masks)
        size = pixels.shape[1], pixels.shape[0]
        if view.size is not None and size != view.size:
            raise MiNtfError(f"{view.image}: is {size[0]}x{size[1]}, {view.where} says {view.size[0]}x{view.size[1]}; "
                             "photograph and camera must belong together: scale one of them")
        if i == 0:
            images = np.empty((len(views), *pixels.shape), np.float32)
        if pixels.shape != images.shape[1:]:
            raise MiNtfError(f"{view.image}: is {size[0]}x{size[1]}, {views[0].image} is {images.shape[2]}x"
                             f"{images.shape[1]}; all photographs of a split have one size: scale or crop them")
        images[i] = pixels
    return images


def _check_masks(views: list[View], images: np.ndarray) -> None:
    """A photograph for training that shows nothing would empty the whole space."""
    for view, image in zip(views, images, strict=True):
        if image[..., 3].max() < bounds.COVERED:
            raise MiNtfError(f"{view.image}: its alpha is {image[..., 3].max():.2g} at most, so it shows no object; "
                             "repair its mask (white: object) or take the photograph out")


def _cameras(views: list[View], images: np.ndarray):
    """``(c2w (N, 4, 4), focal (N, 2), principal (N, 2))``, float64; pixels."""
    height, width = images.shape[1:3]
    full = []
    for view in views:
        camera = view.camera
        if len(camera) == 1:
            camera = (*(2 * (focal_length(camera[0], width),)), 0.5 * width, 0.5 * height)
        if not (0 < camera[2] < width and 0 < camera[3] < height):
            raise MiNtfError(f"{view.where}: its principal point is ({camera[2]:g}, {camera[3]:g}), outside the image "
                             f"of {width}x{height} pixels; scale the camera's intrinsics with the image")
        if not all(1e-3 * width < f < 1e6 * width for f in camera[:2]):
            raise MiNtfError(f"{view.where}: its focal lengths are {camera[0]:g} and {camera[1]:g} pixels, for an "
                             f"image of {width}x{height} pixels that is no pinhole camera; correct the camera")
        full.append(camera)
    intrinsics = np.array(full, dtype=np.float64)
    return np.stack([view.c2w for view in views]), intrinsics[:, :2], intrinsics[:, 2:]


def _light_positions(views: list[View]) -> np.ndarray:
    return np.stack([v.c2w[:3, 3] if v.light_pos is None else v.light_pos for v in views]).astype(np.float32)


def _intensities(views: list[View], estimated: float | None) -> np.ndarray:
    return np.stack([v.light_intensity if estimated is None else np.full(3, estimated) for v in views]
                    ).astype(np.float32)

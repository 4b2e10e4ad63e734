"""Photographs with their masks and lenses, read one at a time into the array that a split holds.

No other copy of all photographs exists. Files of 8 bits make an array of bytes, 4 a pixel. Any other file makes an
array of half precision, or of single precision if half does not hold the light of some photograph.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import exif, images, lens, masks
from mi_ntf.data.assumptions import Assumptions
from mi_ntf.data.file_names import first
from mi_ntf.data.schema import Camera, View, focal_length

HALF = (1e-3, 65504.0)  # range of a photograph's brightest light for half precision, which has 11 bits down to 6e-5


class Photographs(NamedTuple):
    """Photographs of a split with their cameras, as :class:`mi_ntf.data.schema.Split` has them."""

    images: np.ndarray
    c2w: np.ndarray
    focal: np.ndarray
    principal: np.ndarray


def load(views: list[View], size: int | None = None, black: bool = False, assumed: Assumptions | None = None,
         advance: Callable[[], None] = lambda: None) -> Photographs:
    """Read the photographs of a split, scaled down to a longer side of `size` pixels.

    With `black`, alpha comes from the black background instead of masks. All photographs have one size in the end:
    those that lie otherwise than the first are turned by 90 degrees. `assumed` receives the assumptions, and `advance`
    is called after each photograph. Raises MiNtfError.
    """
    stored, straighten, intrinsics, poses = np.empty((0, 0, 0, 4), np.uint8), lens.Straightener(), [], []
    assumed = Assumptions() if assumed is None else assumed
    for i, view in enumerate(views):
        (pixels, camera), c2w = read(view, size, black, straighten, assumed), view.c2w
        if i == 0:
            stored = np.empty((len(views), *pixels.shape), _fitting(pixels))
        if pixels.shape != stored.shape[1:] and pixels.shape[1::-1] == stored.shape[1:3]:
            pixels, camera, c2w = lens.quarter_turn(pixels, camera, c2w)
            assumed.add(f"{'landscapes' if pixels.shape[0] > pixels.shape[1] else 'portraits'} are turned to the left "
                        "with their cameras, to lie as the first photograph does", view.image)
        if pixels.shape != stored.shape[1:]:
            raise MiNtfError(f"{view.image}: is {pixels.shape[1]}x{pixels.shape[0]}, {views[0].image} is "
                             f"{stored.shape[2]}x{stored.shape[1]}; all photographs of a split have one size: scale or "
                             "crop them")
        stored = _widened(stored, i, _fitting(pixels))
        stored[i] = pixels if pixels.dtype == stored.dtype or pixels.dtype != np.uint8 else images.linear(pixels)
        intrinsics.append((camera.fx, camera.fy, camera.cx, camera.cy))
        poses.append(c2w)
        advance()
    numbers = np.array(intrinsics, dtype=np.float64)
    return Photographs(stored, np.stack(poses), numbers[:, :2], numbers[:, 2:])


def _fitting(pixels: np.ndarray) -> np.dtype:
    if pixels.dtype == np.uint8:
        return np.dtype(np.uint8)
    brightest = max(float(pixels[..., :3].max()), -float(pixels[..., :3].min()))
    return np.dtype(np.float16 if brightest == 0 or HALF[0] < brightest <= HALF[1] else np.float32)


def _widened(stored: np.ndarray, count: int, dtype: np.dtype) -> np.ndarray:
    """Return `stored`, of which the first `count` photographs are in use, in a type that also holds `dtype`."""
    if dtype.itemsize <= stored.dtype.itemsize:
        return stored
    wider = np.empty(stored.shape, dtype)
    for old, new in zip(stored[:count], wider, strict=False):
        new[:] = images.linear(old)
    return wider


def read(view: View, size: int | None, black: bool, straighten: lens.Straightener, assumed: Assumptions | None = None
         ) -> tuple[np.ndarray, Camera]:
    """Return the pixels (H, W, 4) of one photograph, 8-bit levels or float32, and its camera. Raises MiNtfError."""
    assumed = Assumptions() if assumed is None else assumed
    image = images.decode(view.image)
    for note in image.assumed:
        assumed.add(note, view.image)
    mask = None if black else _mask(view, image, assumed)
    if view.upright:
        alpha, mask = (None if plane is None else exif.turned(plane, view.orientation) for plane in (image.alpha, mask))
        image = image._replace(rgb=exif.turned(image.rgb, view.orientation), alpha=alpha)
    height, width = image.rgb.shape[:2]
    camera = _camera(view, width, height)
    target, whole = lens.shrunk(width, height, size), image.rgb.dtype == np.uint8
    bent = any(camera.distortion)
    if whole and not bent and target == (width, height):
        pixels = images.as_levels(image, mask)
    else:
        pixels = images.as_linear(image, mask)
        del image, mask  # each copy of 12 megapixels counts
        if bent:
            pixels, camera = straighten(pixels, camera, view.where)
        if target != (width, height):
            pixels, camera = lens.shrink(pixels, camera, target)
        if whole:
            stored = np.empty(pixels.shape, np.uint8)
            for rows in images.strips(pixels):
                stored[rows] = images.levels(pixels[rows])
            pixels = stored
    if black:
        pixels[..., 3] = masks.from_background(pixels, str(view.image)) * (1 if whole else 1 / 255)
    return pixels, camera


def _mask(view: View, image: images.Decoded, assumed: Assumptions) -> np.ndarray | None:
    """Return the mask that replaces the photograph's alpha, as the photograph is stored; None if its own alpha stays.

    Training must know which pixels show the object, so a photograph with neither is an error.
    """
    place = first(view.masks)
    if image.alpha is not None and not view.mask_first:
        if place is None or image.alpha.min() < (255 if image.alpha.dtype == np.uint8 else 1):
            return None
        assumed.add("an alpha channel that is opaque throughout gives way to a mask", view.image)
    if place is None:
        lacks = "has no mask" if view.mask_first else "has no alpha channel and no mask"
        raise MiNtfError(f"{view.image}: {lacks}{' (' + str(view.masks[0]) + ')' if view.masks else ''}; training must "
                         "tell the object from what is behind it: put a mask there (PNG, white: object, black: "
                         "background), name the masks' folder with --masks DIR, write the photograph as RGBA PNG, or, "
                         "if all were taken with a flash in a dark room, say --background black")
    mask, note = masks.read(place)
    assumed.add(note, view.image)
    mask = exif.turned(mask, exif.INVERSE[view.orientation]) if view.mask_upright else mask
    if mask.shape != image.rgb.shape[:2]:
        raise MiNtfError(f"{place}: is {mask.shape[1]}x{mask.shape[0]}, its photograph {view.image} is "
                         f"{image.rgb.shape[1]}x{image.rgb.shape[0]}; a mask has the size of its photograph")
    return mask


def _camera(view: View, width: int, height: int) -> Camera:
    """Return the camera of the photograph, which is `width` by `height` pixels large."""
    camera = view.camera
    if not isinstance(camera, Camera):
        focal = focal_length(camera, width)
        camera = Camera(focal, focal, 0.5 * width, 0.5 * height)
    if view.size is not None and view.size != (width, height):
        sizes = f"{view.image}: is {width}x{height}, {view.where} says {view.size[0]}x{view.size[1]}"
        if not view.rescaled:
            raise MiNtfError(f"{sizes}; photograph and camera must belong together: scale one of them")
        if abs(width * view.size[1] / (height * view.size[0]) - 1) > 0.02:  # rounding loses at most 1 pixel of 50
            raise MiNtfError(f"{sizes}; photographs may be scaled, in the same proportion: put the whole ones there")
        camera = lens.rescaled(camera, view.size, (width, height))
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        raise MiNtfError(f"{view.where}: its principal point is ({camera.cx:g}, {camera.cy:g}), outside the image "
                         f"of {width}x{height} pixels; scale the camera's intrinsics with the image")
    if not all(1e-3 * width < f < 1e6 * width for f in (camera.fx, camera.fy)):
        raise MiNtfError(f"{view.where}: its focal lengths are {camera.fx:g} and {camera.fy:g} pixels, for an "
                         f"image of {width}x{height} pixels that is no pinhole camera; correct the camera")
    return camera

"""Lenses: pictures are made straight and smaller in linear light, together with their camera.

Distortion is OpenCV's model of Brown and Conrady (documentation of `calib3d`). COLMAP's SIMPLE_RADIAL, RADIAL, OPENCV
and FULL_OPENCV and nerfstudio's k1 to k3, p1, p2 are cases of it. OpenCV's pixel (0, 0) is the centre of the top left
pixel, ours its corner: half a pixel is between them.
"""

from dataclasses import replace
from functools import lru_cache

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import opencv
from mi_ntf.data.schema import Camera

LONGEST = 32766  # largest side in pixels that OpenCV's `remap` supports
SCALES = (0.5, 4.0)  # range of the factor by which the focal length may change when the picture is made straight


def shrunk(width: int, height: int, size: int | None) -> tuple[int, int]:
    """Return (width, height) in the same proportion with a longer side of at most `size` pixels."""
    factor = 1.0 if size is None else min(1.0, size / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def rescaled(camera: Camera, old: tuple[int, int], new: tuple[int, int]) -> Camera:
    """Return the camera of a picture that is scaled from `old` to `new` (width, height)."""
    x, y = new[0] / old[0], new[1] / old[1]
    return replace(camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y)


def shrink(pixels: np.ndarray, camera: Camera, new: tuple[int, int]) -> tuple[np.ndarray, Camera]:
    """Average linear premultiplied pixels (H, W, 4) over areas to `new` (width, height); return them and the camera."""
    old = pixels.shape[1], pixels.shape[0]
    cv2 = opencv(f"scaling photographs of {old[0]}x{old[1]} to {new[0]}x{new[1]}")
    return cv2.resize(pixels, new, interpolation=cv2.INTER_AREA), rescaled(camera, old, new)


def quarter_turn(pixels: np.ndarray, camera: Camera, c2w: np.ndarray) -> tuple[np.ndarray, Camera, np.ndarray]:
    """Turn a pinhole's picture (H, W, 4) by 90 degrees to the left; return it with its rolled camera and pose."""
    turned = Camera(camera.fy, camera.fx, camera.cy, pixels.shape[1] - camera.cx)
    roll = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.rot90(pixels), turned, c2w @ roll


class Straightener:
    """Converts pictures of distorted cameras to pictures of pinholes; caches the maps of the last camera."""

    def __init__(self) -> None:
        self._maps = lru_cache(maxsize=1)(_maps)

    def __call__(self, pixels: np.ndarray, camera: Camera, where: str) -> tuple[np.ndarray, Camera]:
        """Return the straight picture of linear premultiplied `pixels` (H, W, 4), of the same size, and its camera.

        `where` names the camera in messages. Raises MiNtfError; see :func:`straight`.
        """
        try:
            cv2 = opencv("undoing the lens distortion")
            pinhole, x, y = self._maps(camera, (pixels.shape[1], pixels.shape[0]))
        except MiNtfError as error:
            raise MiNtfError(f"{where}: {error}") from None
        return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), pinhole


def _maps(camera: Camera, size: tuple[int, int]) -> tuple[Camera, np.ndarray, np.ndarray]:
    if max(size) > LONGEST:
        raise MiNtfError(f"lens distortion is undone in photographs of up to {LONGEST} pixels, this one is "
                         f"{size[0]}x{size[1]}; scale photographs and camera first")
    pinhole = straight(camera, size)
    return pinhole, *undistortion(camera, pinhole, size, size)


def straight(camera: Camera, size: tuple[int, int]) -> Camera:
    """Return the pinhole with the same principal point that shows most of the photograph and nothing beyond it.

    An empty border would read as photographed and empty. The focal lengths are those of `camera` times the smallest
    factor in ``SCALES`` that leaves none. `size` is (width, height). Raises MiNtfError.
    """
    low, high = SCALES
    if not _filled(camera, _zoomed(camera, high), size):
        raise MiNtfError(f"its lens distortion {list(camera.distortion)} folds the picture or leaves none that is "
                         "straight; calibrate the camera again, or run `colmap image_undistorter` and train on its "
                         "output folder (PINHOLE)")
    if _filled(camera, _zoomed(camera, low), size):
        return _zoomed(camera, low)
    while high / low > 1 + 1e-5:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if _filled(camera, _zoomed(camera, middle), size) else (middle, high)
    return _zoomed(camera, high)


def _zoomed(camera: Camera, factor: float) -> Camera:
    return Camera(camera.fx * float(factor), camera.fy * float(factor), camera.cx, camera.cy)


def _filled(camera: Camera, pinhole: Camera, size: tuple[int, int]) -> bool:
    """Return True if the pinhole's pixels come from different places within the photograph, tested on a grid."""
    cells = 65
    x, y = (axis.astype(np.float64) for axis in undistortion(camera, pinhole, size, (cells, cells)))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return False
    slack = 1e-3  # float32's rounding of some thousand pixels
    if min(x.min(), y.min()) < -slack or x.max() > size[0] - 1 + slack or y.max() > size[1] - 1 + slack:
        return False
    (x_down, x_across), (y_down, y_across) = np.gradient(x), np.gradient(y)
    return bool((x_across * y_down - x_down * y_across > 0).all())


def undistortion(camera: Camera, pinhole: Camera, size: tuple[int, int], cells: tuple[int, int]
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y, in OpenCV's pixels of the photograph, of a grid of places of the pinhole's picture.

    The grid has `cells` (across, down) places, evenly from the first to the last pixel's centre of `size` (width,
    height).
    """
    cv2 = opencv("undoing the lens distortion")
    sx, sy = ((n - 1) / max(s - 1, 1) for n, s in zip(cells, size, strict=True))
    old = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    new = np.array([[pinhole.fx * sx, 0, (pinhole.cx - 0.5) * sx], [0, pinhole.fy * sy, (pinhole.cy - 0.5) * sy],
                    [0, 0, 1]])
    x, y = cv2.initUndistortRectifyMap(old, np.array(camera.distortion, np.float64), None, new, cells, cv2.CV_32FC1)
    return x, y

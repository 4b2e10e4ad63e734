"""Lenses: pictures made straight, and made smaller, in linear light, with the camera that they are then of.

Distortion is OpenCV's model of Brown and Conrady (documentation of `calib3d`), which COLMAP's SIMPLE_RADIAL, RADIAL,
OPENCV and FULL_OPENCV and nerfstudio's k1 to k3, p1, p2 are cases of. OpenCV's pixel (0, 0) is the centre of the top
left pixel, ours its corner: half a pixel is between them.
"""

from dataclasses import replace

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import opencv
from mi_ntf.data.schema import Camera

LONGEST = 32766
"""Pixels that OpenCV's `remap` counts to."""
SCALES = (0.5, 4.0)
"""How much shorter and longer a focal length may become when the picture is made straight."""


def shrunk(width: int, height: int, size: int | None) -> tuple[int, int]:
    """(width, height) with the longer side of `size` pixels at most, in the same proportion."""
    factor = 1.0 if size is None else min(1.0, size / max(width, height))
    return max(1, round(width * factor)), max(1, round(height * factor))


def rescaled(camera: Camera, old: tuple[int, int], new: tuple[int, int]) -> Camera:
    """The camera of a picture of `old` (width, height) when the picture has `new`. Distortion has no unit."""
    x, y = new[0] / old[0], new[1] / old[1]
    return replace(camera, fx=camera.fx * x, fy=camera.fy * y, cx=camera.cx * x, cy=camera.cy * y)


def shrink(pixels: np.ndarray, camera: Camera, new: tuple[int, int]) -> tuple[np.ndarray, Camera]:
    """Linear premultiplied pixels (H, W, 4) averaged over areas to `new` (width, height), and their camera."""
    old = pixels.shape[1], pixels.shape[0]
    cv2 = opencv(f"scaling photographs of {old[0]}x{old[1]} to {new[0]}x{new[1]}")
    return cv2.resize(pixels, new, interpolation=cv2.INTER_AREA), rescaled(camera, old, new)


def quarter_turn(pixels: np.ndarray, camera: Camera, c2w: np.ndarray) -> tuple[np.ndarray, Camera, np.ndarray]:
    """A picture (H, W, 4) of a pinhole turned by 90 degrees to the left, and the camera and pose that it is then of:
    the camera is rolled about its optical axis."""
    turned = Camera(camera.fy, camera.fx, camera.cy, pixels.shape[1] - camera.cx)
    roll = np.array([[0.0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    return np.rot90(pixels), turned, c2w @ roll


class Straightener:
    """Makes pictures of distorted cameras those of pinholes. It keeps the maps of the last camera: most data sets have
    one camera alone."""

    def __init__(self):
        self._of, self._found = None, None

    def __call__(self, pixels: np.ndarray, camera: Camera, where: str) -> tuple[np.ndarray, Camera]:
        """Straight linear premultiplied pixels of the size of `pixels` (H, W, 4), and their camera (:func:`straight`);
        `where` names the camera in messages. Raises MiNtfError."""
        cv2 = opencv(f"{where}: undoing the lens distortion")
        size = pixels.shape[1], pixels.shape[0]
        if max(size) > LONGEST:
            raise MiNtfError(f"{where}: lens distortion is undone in photographs of up to {LONGEST} pixels, this one "
                             f"is {size[0]}x{size[1]}; scale photographs and camera first")
        if self._of != (camera, size):
            pinhole = straight(camera, size, where)
            self._found = pinhole, _map(camera, pinhole, size, size)
            self._of = camera, size
        pinhole, (x, y) = self._found
        return cv2.remap(pixels, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), pinhole


def straight(camera: Camera, size: tuple[int, int], where: str) -> Camera:
    """The pinhole at the same principal point whose picture of `size` (width, height) shows most of what the
    photograph shows and nothing else: an empty border would read as photographed and empty.

    Its focal lengths are those of `camera` times one factor, the smallest of ``SCALES`` that does it.
    """
    low, high = SCALES
    if not _filled(camera, _zoomed(camera, high), size):
        raise MiNtfError(f"{where}: its lens distortion {list(camera.distortion)} folds the picture or leaves none "
                         "that is straight; calibrate the camera again, or run `colmap image_undistorter` and train on "
                         "its output folder (PINHOLE)")
    if _filled(camera, _zoomed(camera, low), size):
        return _zoomed(camera, low)
    while high / low > 1 + 1e-5:
        middle = np.sqrt(low * high)
        low, high = (low, middle) if _filled(camera, _zoomed(camera, middle), size) else (middle, high)
    return _zoomed(camera, high)


def _zoomed(camera: Camera, factor: float) -> Camera:
    return Camera(camera.fx * float(factor), camera.fy * float(factor), camera.cx, camera.cy)


def _filled(camera: Camera, pinhole: Camera, size: tuple[int, int]) -> bool:
    """Return True if every pixel of the pinhole's picture of `size` comes from one place of the photograph, and no
    two from the same. It is tested on a grid from the first pixels' centres to the last ones'."""
    cells = 65
    x, y = _map(camera, pinhole, size, (cells, cells))
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        return False
    x, y = x.astype(np.float64), y.astype(np.float64)
    slack = 1e-3  # float32's rounding of some thousand pixels
    if min(x.min(), y.min()) < -slack or x.max() > size[0] - 1 + slack or y.max() > size[1] - 1 + slack:
        return False
    (x_down, x_across), (y_down, y_across) = np.gradient(x), np.gradient(y)
    return bool((x_across * y_down - x_down * y_across > 0).all())


def _map(camera: Camera, pinhole: Camera, size: tuple[int, int], cells: tuple[int, int]):
    """Map `cells` (across, down) places of the pinhole's picture to the photograph, in OpenCV's pixels:
    places that spread evenly from the first to the last pixel's centre of `size` (width, height)."""
    cv2 = opencv("undoing the lens distortion")
    sx, sy = ((n - 1) / max(s - 1, 1) for n, s in zip(cells, size, strict=True))
    old = np.array([[camera.fx, 0, camera.cx - 0.5], [0, camera.fy, camera.cy - 0.5], [0, 0, 1]])
    new = np.array([[pinhole.fx * sx, 0, (pinhole.cx - 0.5) * sx], [0, pinhole.fy * sy, (pinhole.cy - 0.5) * sy],
                    [0, 0, 1]])
    return cv2.initUndistortRectifyMap(old, np.array(camera.distortion, np.float64), None, new, cells, cv2.CV_32FC1)

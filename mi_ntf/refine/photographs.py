"""Photographs of a data set, and the camera of Mitsuba that takes the same pictures."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core.errors import MiNtfError
from ..data.images import LINEAR, linear
from ..data.schema import Split, mitsuba_to_opengl

OPAQUE = 0.9
"""Least alpha of pixels that count. Others show the background, too."""
SATURATED = 250
"""8-bit level from which a channel may stand for anything brighter, and does not count."""
SQUARE = 0.01
"""Largest relative difference of the focal lengths along x and y, since pixels of Mitsuba's films are square."""


class Camera:
    """Pinhole camera of Mitsuba whose film of `width` × `height` pixels shows a part of a photograph."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgba",
                "component_format": "float32", "rfilter": {"type": "box"}}
        self.sensor = mi.load_dict({"type": "perspective", "fov": 30.0, "fov_axis": "x", "near_clip": 1e-4,
                                    "far_clip": 1e8, "principal_point_offset_x": 0.0, "principal_point_offset_y": 0.0,
                                    "film": film, "sampler": {"type": "independent"}})
        self._parameters = mi.traverse(self.sensor)

    def place(self, c2w: np.ndarray, focal: float, principal: np.ndarray) -> None:
        """Move the camera.

        Parameters
        ----------
        c2w
            (4, 4) from the camera to the scene, OpenGL axes, without scale.
        focal, principal
            Focal length and principal point (2,) in pixels of this film, from its top left corner.
        """
        parameters = self._parameters
        matrix = mi.Matrix4f(mitsuba_to_opengl(c2w).tolist())
        dr.make_opaque(matrix)  # so that no place is compiled into a kernel
        parameters["to_world"] = mi.Transform4f(matrix)
        parameters["x_fov"] = float(np.degrees(2 * np.arctan(0.5 * self.width / focal)))
        parameters["principal_point_offset_x"] = float(0.5 - principal[0] / self.width)
        parameters["principal_point_offset_y"] = float(0.5 - principal[1] / self.height)
        parameters.update()


class Photographs:
    """Photographs of a split in the coordinates of a scene.

    Parameters
    ----------
    split
        The photographs.
    to_scene
        (4, 4) similarity from the data set's world to the scene.
    solid
        The object is a surface, so that pixels of partial coverage show its rim and do not count. Those of smoke do.
    """

    def __init__(self, split: Split, to_scene: np.ndarray, solid: bool) -> None:
        self.views, self.height, self.width = split.images.shape[:3]
        self.names = split.names or tuple(f"view {i}" for i in range(self.views))
        self._images, self._least = split.images, OPAQUE if solid and split.masked else -1.0
        ratio = split.focal[:, 1] / split.focal[:, 0]
        if np.abs(ratio - 1).max() > SQUARE:
            worst = int(np.abs(ratio - 1).argmax())
            raise MiNtfError(f"{self.names[worst]}: its focal lengths are {split.focal[worst, 0]:g} pixels along x and "
                             f"{split.focal[worst, 1]:g} along y, and refinement needs square pixels; scale it first")
        self.focal, self.principal = split.focal.mean(1), split.principal
        unit = float(np.cbrt(np.linalg.det(to_scene[:3, :3])))
        self.c2w = to_scene @ split.c2w
        self.c2w[:, :3, :3] /= unit
        self.lamp = split.light_pos @ to_scene[:3, :3].T + to_scene[:3, 3]
        self.intensity = split.light_intensity * unit**2

    def covered(self, view: int) -> np.ndarray:
        """Return the pixels (k, 2) of a photograph, rows first, that show the object."""
        alpha = self._images[view][..., 3] * (1 / 255 if self._images.dtype == np.uint8 else 1)
        pixels = np.argwhere(alpha > max(self._least, 0.0))
        return pixels if len(pixels) else np.argwhere(alpha >= 0)

    def part(self, view: int, corner: tuple[int, int], shape: tuple[int, int], shrink: int = 1
             ) -> tuple[np.ndarray, np.ndarray]:
        """Return colour (h, w, 3), linear RGB over black, and the channels' weight (h, w, 3) of a part of a photograph.

        `corner` is its first row and column, `shape` (h, w) its size in pixels that are each the mean of `shrink`².
        """
        rows, columns = (slice(c, c + n * shrink) for c, n in zip(corner, shape, strict=True))
        stored = self._images[view, rows, columns]
        pixels = linear(stored)
        weight = np.repeat((pixels[..., 3:] > self._least).astype(np.float32), 3, -1)
        if stored.dtype == np.uint8:
            weight *= pixels[..., :3] < LINEAR[SATURATED]
        blocks = [v.reshape(shape[0], shrink, shape[1], shrink, 3) for v in (pixels[..., :3], weight)]
        return blocks[0].mean((1, 3)), blocks[1].min((1, 3))

    def aim(self, camera: Camera, view: int, corner: tuple[int, int] = (0, 0), shrink: int = 1) -> None:
        """Move `camera` so that its film shows the :meth:`part` of a photograph from `corner` on."""
        camera.place(self.c2w[view], self.focal[view] / shrink, (self.principal[view] - corner[::-1]) / shrink)


def joined(one: Split, other: Split) -> Split:
    """Return the photographs of two splits as one, if they have one size; else those of the first."""
    if one.images.shape[1:] != other.images.shape[1:] or one.images.dtype != other.images.dtype:
        return one
    images, c2w, focal, principal, light_pos, light_intensity = (
        np.concatenate([getattr(split, name) for split in (one, other)])
        for name in ("images", "c2w", "focal", "principal", "light_pos", "light_intensity"))
    return replace(one, images=images, c2w=c2w, focal=focal, principal=principal, light_pos=light_pos,
                   light_intensity=light_intensity, names=one.names + other.names)

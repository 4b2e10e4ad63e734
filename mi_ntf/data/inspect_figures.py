"""Figures of `mi-ntf inspect`: the places of the cameras, and masks over photographs."""

from typing import TYPE_CHECKING

import numpy as np

from mi_ntf.data import colour, exif, lens, measures, page
from mi_ntf.data.file_names import SRGB_SUFFIXES
from mi_ntf.data.images import LINEAR, levels, linear, opencv
from mi_ntf.data.measures import Splits
from mi_ntf.data.schema import Camera, Split, View

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = {"train": "#3b82e0", "val": "#e39b1a", "test": "#e0433a"}
OUTLINE = (255, 0, 220)
OUTSIDE = np.array([0.004, 0.008, 0.03], np.float32)  # linear light added outside the object
UNKNOWN = np.array([0.10, 0.04, 0.0], np.float32)  # linear light added where the object may be
LEAST, WIDTH = 240, 320  # width of thumbnails in pixels: pixels are repeated up to LEAST or averaged down to WIDTH


def upright(splits: Splits) -> np.ndarray:
    """Return the rotation (3, 3) from world axes to axes with z up, by the cameras' mean up direction."""
    c2w = splits["train"].c2w
    up = c2w[:, :3, 1].mean(0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def cameras(splits: Splits, points: np.ndarray | None) -> "Figure":
    """Draw the cameras with their view directions around the unit sphere, seen from the side and from above."""
    figure = page.new_figure(10.5, 5.0)
    turn, center, radius = upright(splits), splits["train"].center, splits["train"].radius

    def place(x: np.ndarray) -> np.ndarray:
        return np.asarray((x - center) / radius @ turn.T)

    spots = np.concatenate([place(split.c2w[:, :3, 3]) for split in splits.values()])
    reach = float(np.abs(spots).max())
    for number, (elevation, azimuth, title) in enumerate([(12, -60, "from the side"), (89.9, -90, "from above")]):
        axes = figure.add_subplot(1, 2, number + 1, projection="3d", proj_type="ortho")
        axes.set_axis_off()
        _sphere(axes)
        if points is not None:
            axes.scatter(*place(points).T, s=0.6, color=page.GREY, alpha=0.5, linewidths=0)
        for name, split in splits.items():
            eye, ahead = place(split.c2w[:, :3, 3]), -split.c2w[:, :3, 2] @ turn.T
            axes.scatter(*eye.T, s=12, color=COLOURS[name], label=name, depthshade=False)
            axes.quiver(*eye.T, *ahead.T, length=0.18 * reach, color=COLOURS[name], linewidth=0.7)
            flash = place(split.light_pos.astype(np.float64))
            if np.abs(flash - eye).max() > 0.02 * reach:
                axes.scatter(*flash.T, s=14, color="#e3c21a", marker="*", depthshade=False,
                             label="flash" if name == "train" else None)
                axes.quiver(*eye.T, *(flash - eye).T, arrow_length_ratio=0, color="#e3c21a", linewidth=0.5)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
        axes.set_box_aspect((1, 1, 1), zoom=1.35)
        axes.view_init(elevation, azimuth)
        axes.text2D(0.5, 0.02, title, transform=axes.transAxes, color=page.GREY, fontsize=9, ha="center")
        if not number:
            axes.legend(frameon=False, labelcolor=page.GREY, fontsize=8, loc="upper left")
    return figure


def _sphere(axes: "Axes") -> None:
    turn = np.linspace(0, 2 * np.pi, 61)
    x, y, zero = np.cos(turn), np.sin(turn), np.zeros(61)
    circles = [(np.cos(h) * x, np.cos(h) * y, zero + np.sin(h)) for h in np.radians(np.arange(-60, 61, 30))]
    circles += [(x * np.cos(angle), x * np.sin(angle), y) for angle in np.radians(np.arange(0, 180, 30))]
    for circle in circles:
        axes.plot(*circle, color=page.GREY, alpha=0.5, linewidth=0.5)


def directions(splits: Splits, farthest: np.ndarray) -> "Figure":
    """Draw a map of all directions from the object, shaded by the angle to the nearest camera for training."""
    figure = page.new_figure(8.0, 3.6)
    axes = figure.add_subplot()
    page.plain(axes)
    turn = upright(splits)
    east, north = np.meshgrid(np.radians(np.arange(-179, 180, 2)), np.radians(np.arange(-89, 90, 2)))
    grid = np.stack([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)], -1)
    sides = {}
    for name, split in splits.items():
        side = (split.c2w[:, :3, 3] - split.center) @ turn.T
        sides[name] = side / np.linalg.norm(side, axis=1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((grid @ sides["train"].T).max(-1), -1, 1)))
    image = axes.imshow(angle, origin="lower", extent=(-180, 180, -90, 90), cmap="viridis_r", vmin=0, vmax=90,
                        alpha=0.6)
    for name, side in sides.items():
        axes.scatter(*_map(side), s=10, color=COLOURS[name], edgecolors="white", linewidths=0.4, label=name)
    axes.scatter(*_map(turn @ farthest), s=60, color="#e0433a", marker="x", label="largest gap")
    axes.set(xlabel="azimuth, degrees", ylabel="elevation, degrees", xlim=(-180, 180), ylim=(-90, 90),
             xticks=range(-180, 181, 60), yticks=range(-90, 91, 30))
    bar = figure.colorbar(image, ax=axes, shrink=0.8)
    bar.set_label("degrees to the nearest camera", color=page.GREY, fontsize=8)
    bar.ax.tick_params(colors=page.GREY, labelsize=8)
    bar.outline.set_color(page.GREY)
    axes.legend(frameon=False, labelcolor=page.GREY, fontsize=8, ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _map(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return azimuth and elevation in degrees of unit directions (..., 3)."""
    return (np.degrees(np.arctan2(direction[..., 1], direction[..., 0])),
            np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1))))


def thumbnail(split: Split, i: int, view: View | None, white: float) -> np.ndarray:
    """Return sRGB levels (h, w, 3) of photograph `i` with the outline of its mask.

    Pixels outside the object are dimmed and bluish, those where it may be orange. The file of `view` shows the
    background of a masked photograph. `white` is the linear radiance of white.
    """
    pixels = linear(split.images[i])
    factor = min(1.0, WIDTH / pixels.shape[1])
    width, height = (max(1, round(side * factor)) for side in pixels.shape[1::-1])
    *rgb, alpha = (_scaled(pixels[..., k], width, height) for k in range(4))
    picture = np.stack(rgb, -1) / white
    if split.masked and view is not None:
        whole = _whole(view, Camera(*factor * split.focal[i], *factor * split.principal[i]), width, height)
        picture = picture if whole is None else whole
    sure, maybe = measures.certain(split, alpha), measures.possible(split, alpha)
    inside = alpha >= 0.5 if split.masked else sure
    picture = np.where((inside if split.masked else maybe)[..., None], picture, 0.3 * picture + OUTSIDE)
    if not split.masked:
        picture = picture + (maybe & ~sure)[..., None] * UNKNOWN
    larger = max(1, LEAST // width)
    shown, inside = (np.repeat(np.repeat(each, larger, 0), larger, 1) for each in (levels(picture), inside))
    wide = np.pad(inside, 1, mode="edge")
    shown[inside & ~(wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:])] = OUTLINE
    return shown


def _scaled(plane: np.ndarray, width: int, height: int) -> np.ndarray:
    """Average a picture (H, W) to another size."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(plane, np.float32))
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def _whole(view: View, pinhole: Camera, width: int, height: int) -> np.ndarray | None:
    """Return the 8-bit photograph with its background as `pinhole` sees it (height, width, 3), linear.

    The result is None for files of another kind, and for turned photographs of a distorting lens.
    """
    from PIL import Image

    if view.image.suffix.lower() not in SRGB_SUFFIXES:
        return None
    bent = view.camera if isinstance(view.camera, Camera) and any(view.camera.distortion) else None
    with exif.open_image(view.image) as image:
        size = image.size
        turned = view.upright and view.orientation > 4
        quarter = width != height and ((size[0] > size[1]) != turned) != (width > height)  # `photographs.load` did
        if image.mode not in ("L", "LA", "P", "RGB", "RGBA") or (bent and (quarter or view.upright)):
            return None
        image.draft("RGB", (2 * width, 2 * height))  # JPEG is decoded at a fraction of its size
        target = (2 * width, 2 * height) if bent else (height, width) if quarter != turned else (width, height)
        rgb, _ = colour.to_srgb(image, view.image)
        stored = np.asarray(rgb.resize(target, Image.Resampling.BOX))
    stored = exif.turned(stored, view.orientation) if view.upright else stored
    stored = np.rot90(stored) if quarter else stored
    if bent:
        cv2 = opencv("undoing the lens distortion")
        x, y = lens.undistortion(lens.rescaled(bent, view.size or size, target), pinhole, (width, height),
                                 (width, height))
        stored = cv2.remap(stored, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(LINEAR[stored])

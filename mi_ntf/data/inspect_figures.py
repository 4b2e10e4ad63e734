"""The figures of `mi-ntf inspect`: where the cameras stand, and masks over photographs."""

import numpy as np

from mi_ntf.data import colour, exif, lens, measures, page
from mi_ntf.data.images import LINEAR, levels, linear, opencv
from mi_ntf.data.schema import Camera, Split, View

COLOURS = {"train": "#3b82e0", "val": "#e39b1a", "test": "#e0433a"}
OUTLINE = (255, 0, 220)
OUTSIDE = np.array([0.004, 0.008, 0.03], np.float32)
UNKNOWN = np.array([0.10, 0.04, 0.0], np.float32)
"""Linear light added where a photograph does not show the object, or may."""
LEAST, WIDTH = 240, 320
"""Width of thumbnails, pixels: smaller photographs' pixels are repeated up to the first, larger ones averaged down to
the other."""


def upright(splits: dict[str, Split]) -> np.ndarray:
    """Rotation (3, 3) from world to axes with z up, as the photographer held the camera on the whole."""
    c2w = splits["train"].c2w
    up = c2w[:, :3, 1].mean(0)
    up = up / np.linalg.norm(up) if np.linalg.norm(up) > 0.1 else np.array([0.0, 1.0, 0.0])
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(up, side), up])


def cameras(splits: dict[str, Split], points: np.ndarray | None):
    """Figure: cameras with their view directions around the unit sphere, seen from the side and from above."""
    figure = page.new_figure(10.5, 5.0)
    turn, center, radius = upright(splits), splits["train"].center, splits["train"].radius

    def place(x: np.ndarray) -> np.ndarray:
        return (x - center) / radius @ turn.T

    spots = np.concatenate([place(split.c2w[:, :3, 3]) for split in splits.values()])
    reach = float(np.abs(spots).max())
    for number, (elevation, azimuth, title) in enumerate([(12, -60, "from the side"), (89.9, -90, "from above")]):
        axes = figure.add_subplot(1, 2, number + 1, projection="3d", proj_type="ortho")
        axes.set_axis_off()
        _sphere(axes)
        if points is not None:
            axes.scatter(*place(points).T, s=0.6, color=page.GREY, alpha=0.5, linewidths=0)
        for name, split in splits.items():
            at, ahead = place(split.c2w[:, :3, 3]), -split.c2w[:, :3, 2] @ turn.T
            axes.scatter(*at.T, s=12, color=COLOURS[name], label=name, depthshade=False)
            axes.quiver(*at.T, *ahead.T, length=0.18 * reach, color=COLOURS[name], linewidth=0.7)
            flash = place(split.light_pos.astype(np.float64))
            if np.abs(flash - at).max() > 0.02 * reach:
                axes.scatter(*flash.T, s=14, color="#e3c21a", marker="*", depthshade=False,
                             label="flash" if name == "train" else None)
                axes.quiver(*at.T, *(flash - at).T, arrow_length_ratio=0, color="#e3c21a", linewidth=0.5)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), zlim=(-reach, reach))
        axes.set_box_aspect((1, 1, 1), zoom=1.35)
        axes.view_init(elevation, azimuth)
        axes.text2D(0.5, 0.02, title, transform=axes.transAxes, color=page.GREY, fontsize=9, ha="center")
        if not number:
            axes.legend(frameon=False, labelcolor=page.GREY, fontsize=8, loc="upper left")
    return figure


def _sphere(axes) -> None:
    """The unit sphere as a wire frame."""
    turn = np.linspace(0, 2 * np.pi, 61)
    for height in np.radians(np.arange(-60, 61, 30)):
        axes.plot(np.cos(height) * np.cos(turn), np.cos(height) * np.sin(turn), np.full(61, np.sin(height)),
                  color=page.GREY, alpha=0.5, linewidth=0.5)
    for angle in np.radians(np.arange(0, 180, 30)):
        axes.plot(np.cos(turn) * np.cos(angle), np.cos(turn) * np.sin(angle), np.sin(turn), color=page.GREY, alpha=0.5,
                  linewidth=0.5)


def directions(splits: dict[str, Split], farthest: np.ndarray):
    """Figure: all directions from the object as a map, shaded by how far the nearest camera for training is."""
    figure = page.new_figure(8.0, 3.6)
    axes = figure.add_subplot()
    page.plain(axes)
    turn = upright(splits)
    east, north = np.meshgrid(np.radians(np.arange(-179, 180, 2)), np.radians(np.arange(-89, 90, 2)))
    grid = np.stack([np.cos(north) * np.cos(east), np.cos(north) * np.sin(east), np.sin(north)], -1)
    sides = {name: _sides(split, turn) for name, split in splits.items()}
    away = np.degrees(np.arccos(np.clip((grid @ sides["train"].T).max(-1), -1, 1)))
    shown = axes.imshow(away, origin="lower", extent=(-180, 180, -90, 90), cmap="viridis_r", vmin=0, vmax=90, alpha=0.6)
    for name, side in sides.items():
        axes.scatter(*_map(side), s=10, color=COLOURS[name], edgecolors="white", linewidths=0.4, label=name)
    axes.scatter(*_map(turn @ farthest), s=60, color="#e0433a", marker="x", label="largest gap")
    axes.set(xlabel="azimuth, degrees", ylabel="elevation, degrees", xlim=(-180, 180), ylim=(-90, 90),
             xticks=range(-180, 181, 60), yticks=range(-90, 91, 30))
    bar = figure.colorbar(shown, ax=axes, shrink=0.8)
    bar.set_label("degrees to the nearest camera", color=page.GREY, fontsize=8)
    bar.ax.tick_params(colors=page.GREY, labelsize=8)
    bar.outline.set_color(page.GREY)
    axes.legend(frameon=False, labelcolor=page.GREY, fontsize=8, ncols=4, loc="lower left", bbox_to_anchor=(0, 1))
    return figure


def _sides(split: Split, turn: np.ndarray) -> np.ndarray:
    """Unit directions (N, 3) from the object to the cameras, z up."""
    side = (split.c2w[:, :3, 3] - split.center) @ turn.T
    return side / np.linalg.norm(side, axis=1, keepdims=True)


def _map(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Azimuth and elevation in degrees of unit directions (..., 3)."""
    return (np.degrees(np.arctan2(direction[..., 1], direction[..., 0])),
            np.degrees(np.arcsin(np.clip(direction[..., 2], -1, 1))))


def thumbnail(split: Split, i: int, view: View | None, white: float) -> np.ndarray:
    """Photograph `i`, sRGB levels (h, w, 3): what is not the object dimmed and bluish, what may be orange, and the
    mask's outline. The file of `view` shows what is behind the object; `white` linear."""
    pixels = linear(split.images[i])
    factor = min(1.0, WIDTH / pixels.shape[1])
    width, height = (max(1, round(side * factor)) for side in pixels.shape[1::-1])
    alpha = _scaled(pixels[..., 3], width, height)
    colour = np.stack([_scaled(pixels[..., k], width, height) for k in range(3)], -1) / white
    if split.masked and view is not None:
        whole = _whole(view, Camera(*factor * split.focal[i], *factor * split.principal[i]), width, height)
        colour = colour if whole is None else whole
    sure, maybe = measures.certain(split, alpha), measures.possible(split, alpha)
    inside = alpha >= 0.5 if split.masked else sure
    colour = np.where((inside if split.masked else maybe)[..., None], colour, 0.3 * colour + OUTSIDE)
    if not split.masked:
        colour = colour + (maybe & ~sure)[..., None] * UNKNOWN
    larger = max(1, LEAST // width)
    shown, inside = (np.repeat(np.repeat(each, larger, 0), larger, 1) for each in (levels(colour), inside))
    shown[_edge(inside)] = OUTLINE
    return shown


def _scaled(plane: np.ndarray, width: int, height: int) -> np.ndarray:
    """A picture (H, W) averaged to another size."""
    from PIL import Image

    image = Image.fromarray(np.ascontiguousarray(plane, np.float32))
    return np.asarray(image.resize((width, height), Image.Resampling.BOX))


def _whole(view: View, pinhole: Camera, width: int, height: int) -> np.ndarray | None:
    """The photograph's 8-bit file with its background as `pinhole` sees it (height, width, 3), linear. None for files
    of another kind, and for turned ones of a lens."""
    from PIL import Image

    if view.image.suffix.lower() not in (".jpg", ".jpeg", ".png"):
        return None
    bent = view.camera if isinstance(view.camera, Camera) and any(view.camera.distortion) else None
    with Image.open(view.image) as image:
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
        stored = _straight(stored, lens.rescaled(bent, view.size or size, target), pinhole, (width, height))
    return LINEAR[stored]


def _straight(stored: np.ndarray, camera: Camera, pinhole: Camera, size: tuple[int, int]) -> np.ndarray:
    """Levels of `pinhole`'s picture of `size` (width, height), found in those of `camera`; near enough to look at."""
    cv2 = opencv("undoing the lens distortion")
    old, new = (np.array([[c.fx, 0, c.cx - 0.5], [0, c.fy, c.cy - 0.5], [0, 0, 1]]) for c in (camera, pinhole))
    x, y = cv2.initUndistortRectifyMap(old, np.array(camera.distortion, np.float64), None, new, size, cv2.CV_32FC1)
    return cv2.remap(stored, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _edge(inside: np.ndarray) -> np.ndarray:
    """The pixels (h, w) inside that have a neighbour outside."""
    wide = np.pad(inside, 1, mode="edge")
    return inside & ~(wide[:-2, 1:-1] & wide[2:, 1:-1] & wide[1:-1, :-2] & wide[1:-1, 2:])

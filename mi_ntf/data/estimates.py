"""Estimates of what a data set does not give: the sphere around the object, and the flash's radiant intensity.

The sphere comes from the masks, or else from the reconstructed points, or else from the cameras alone. The similarity
field = (world - center) / radius moves the object into the unit sphere. Images are (N, H, W, 4) as stored; poses are
(N, 4, 4); focal lengths and principal points are (N, 2) in pixels.
"""

from typing import NamedTuple

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.images import linear
from mi_ntf.data.poses import footprint, nearest_point

MARGIN = 1.02  # sphere's radius over the hull's: room for a soft surface. The hull's cells leave some room already
COVERED = 0.1  # alpha from which a pixel shows the object: compression noise and the rim of one pixel are below
ALBEDO = 0.8  # albedo that the brightest surface is assumed to have
SAMPLES = 1 << 22  # pixels that estimate the intensity, of all photographs together


class Sphere(NamedTuple):
    """Sphere around the object, in world units."""

    center: np.ndarray
    radius: float


def bounding_sphere(points: np.ndarray) -> Sphere:
    """Return a nearly smallest sphere around `points` (P, 3), without margin.

    Source: Badoiu and Clarkson 2003, "Smaller core-sets for balls": step by 1/(i+1) towards the farthest point.
    """
    points = np.asarray(points, dtype=np.float64)
    middle = 0.5 * (points.min(0) + points.max(0))
    points = points - middle
    square = (points * points).sum(1)
    best = center = np.zeros(3)
    radius = np.inf
    for i in range(1, 200):
        distance = square - points @ (2 * center)  # squared, less that of the centre from the middle
        farthest = distance.argmax()
        length = float(np.linalg.norm(points[farthest] - center))
        if length < radius:
            best, radius = center, length
        center = center + (points[farthest] - center) / (i + 1)
    return Sphere(middle + best, radius)


def find_sphere(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray,
                points: np.ndarray | None, alpha: str = "masks") -> tuple[Sphere, str]:
    """Return the object's sphere and a phrase that says from which evidence it comes.

    `points` are reconstructed points (P, 3). `alpha` names in the phrase what the images' alpha channel is. Raises
    MiNtfError.
    """
    size = np.array(images.shape[2:0:-1])
    empty = sum(int(np.count_nonzero(~covered(image))) for image in images)
    if empty > 0.01 * len(images) * size.prod():
        return from_masks(images, c2w, focal, principal), f"from the {alpha}' visual hull"
    if points is not None and len(points) >= 10:
        sphere = from_points(points, size, c2w, focal, principal)
        if sphere is not None:
            return sphere, "from the reconstructed points"
    return from_cameras(size, c2w, focal), f"from the cameras alone, as the {alpha} cover everything"


def covered(image: np.ndarray) -> np.ndarray:
    """Return the mask (H, W) of the pixels of an image (H, W, 4) as stored that may show the object."""
    return np.asarray(image[..., 3] >= COVERED * (255 if image.dtype == np.uint8 else 1))


def from_masks(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray) -> Sphere:
    """Return a sphere around the visual hull of the :func:`covered` pixels. The hull holds the object."""
    center, reach = _first_guess(images, c2w, focal, principal)
    low, high = center - reach, center + reach
    for cells in (32, 64):  # once to find the box, once inside it
        edge = float((high - low).max()) / cells
        shape = np.ceil((high - low) / edge - 1e-9).astype(int)
        hull = _carve(low, edge, shape, images, c2w, focal, principal)
        low, high = hull.min(0) - edge, hull.max(0) + edge
    center, radius = bounding_sphere(_shell(hull))
    return Sphere(center, MARGIN * (radius + 0.5 * np.sqrt(3) * edge))


def _common_point(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
    center = nearest_point(origins, directions)
    if center is None:
        raise MiNtfError(f"all {len(origins)} cameras look in one direction, so the object's place in space is not "
                         "known; photograph it from more sides, or write 'unit_sphere' into transforms_train.json")
    return center


def _first_guess(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray) -> Sphere:
    """Return a sphere whose cube holds the object: rays through the masks' middles meet at its centre."""
    middles, slopes = [], []
    for i, image in enumerate(images):
        mask = covered(image)
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        box = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]])
        plane = (box - principal[i]) / focal[i] * (1, -1)
        slopes.append(0.5 * np.linalg.norm(plane[1] - plane[0]))
        middle = c2w[i, :3, :3] @ (*plane.mean(0), -1.0)
        middles.append(middle / np.linalg.norm(middle))
    center = _common_point(c2w[:, :3, 3], np.array(middles))
    distance = np.linalg.norm(c2w[:, :3, 3] - center, axis=1)
    return Sphere(center, 1.5 * float(np.quantile(distance * slopes, 0.9)))


def _carve(low: np.ndarray, edge: float, shape: np.ndarray, images: np.ndarray, c2w: np.ndarray, focal: np.ndarray,
           principal: np.ndarray) -> np.ndarray:
    """Return the centres (K, 3) of the cells that no photograph shows empty and at least half of them show at all.

    A mask that does not touch its image's border shows the whole object, so the space outside such an image is empty.
    """
    axes = [low[k] + edge * (np.arange(shape[k]) + 0.5) for k in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    views = np.zeros(len(cells), np.int32)
    for i, image in enumerate(images):
        mask = covered(image)
        clear = not any(border.any() for border in (mask[0], mask[-1], mask[:, 0], mask[:, -1]))
        window = footprint(cells, edge, c2w[i], focal[i], principal[i], (mask.shape[1], mask.shape[0]))
        pixels = window.pixels(mask)
        full = np.flatnonzero(pixels if clear else ~window.inside | (pixels > 0))
        cells, views = cells.take(full, 0), (views + window.inside).take(full)
        if not len(cells):
            break
    cells = cells[2 * views >= len(c2w)]
    if not len(cells):
        raise MiNtfError(f"no point in space is covered by the object in all photographs (photograph {i} of 0 to "
                         f"{len(c2w) - 1} for training takes the last one away), so poses and masks do not belong "
                         "together; check that poses are camera-to-world with OpenGL axes, the field of view, and that "
                         "no mask is inverted (white: object)")
    return cells


def _shell(cells: np.ndarray) -> np.ndarray:
    """Return the lowest and highest of the `cells` (K, 3), in lexicographic order, in every column along z."""
    new = np.flatnonzero((cells[1:, :2] != cells[:-1, :2]).any(1)) + 1
    return np.asarray(cells[np.unique(np.concatenate([[0], new, new - 1, [len(cells) - 1]]))])


def from_points(points: np.ndarray, size: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray
                ) -> Sphere | None:
    """Return a sphere around the points (P, 3) that most cameras see, or None if these are too few.

    The centre is their median. The radius is 1.1 times the 95th percentile of their distances, and at most 0.9 of the
    nearest camera's distance. `size` is (width, height) in pixels.
    """
    views = np.zeros(len(points), int)
    for pose, f, c in zip(c2w, focal, principal, strict=True):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        depth = -local[:, 2]
        pixel = c + f * local[:, :2] * (1, -1) / np.where(depth > 0, depth, 1.0)[:, None]
        views += (depth > 0) & (pixel >= 0).all(1) & (pixel < size).all(1)
    points = points[views >= 0.8 * len(c2w)]
    if len(points) < 10:
        return None
    center = np.median(points, axis=0)
    radius = 1.1 * float(np.quantile(np.linalg.norm(points - center, axis=1), 0.95))
    return Sphere(center, min(radius, 0.9 * float(np.linalg.norm(c2w[:, :3, 3] - center, axis=1).min())))


def from_cameras(size: np.ndarray, c2w: np.ndarray, focal: np.ndarray) -> Sphere:
    """Return the largest sphere in all fields of view around the point nearest to all optical axes."""
    center = _common_point(c2w[:, :3, 3], c2w[:, :3, 2])
    half = np.arctan(0.5 * size / focal).min(1)
    return Sphere(center, float((np.linalg.norm(c2w[:, :3, 3] - center, axis=1) * np.sin(half)).min()))


def find_intensity(images: np.ndarray, light_pos: np.ndarray, center: np.ndarray, radius: float) -> float:
    """Return the radiant intensity of a white flash, the same in all frames, that gives a plausible albedo.

    Photographs determine intensity times albedo alone. A Lambert surface at distance d that faces the flash has
    radiance L = albedo/π · I/d², so π L d²/I is the albedo times a cosine. I is such that the 95th percentile of the
    lit pixels has ``ALBEDO`` in its largest channel. d is the flash's distance to the sphere's centre less half its
    radius, the middle of the visible part. Lit pixels are covered and above a hundredth of the brightest percent.

    `light_pos` (N, 3), `center` (3,) and `radius` are in world units. Raises MiNtfError if no pixel is lit.
    """
    pixels = images.shape[1] * images.shape[2]
    step = max(1, pixels // 65536, len(images) * pixels // SAMPLES)
    distance = np.linalg.norm(light_pos - center, axis=1) - 0.5 * radius
    values = []
    for image, d in zip(images, distance, strict=True):
        sampled = linear(image.reshape(-1, 4)[::step])
        values.append(np.pi * sampled[sampled[:, 3] > 0.99, :3].max(-1) * d**2)
    value = np.concatenate(values)
    value = value[value > 0.01 * np.quantile(value, 0.99)] if len(value) else value
    if not len(value):
        raise MiNtfError(f"none of the {len(images)} photographs for training shows anything lit, so the flash's "
                         "intensity cannot be estimated; check the images and their masks (white: object)")
    return float(np.quantile(value, 0.95)) / ALBEDO

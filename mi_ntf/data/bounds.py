"""The sphere around the object: from masks, else from reconstructed points, else from the cameras alone.

The similarity field = (world - center) / radius moves the object into the unit sphere.
"""

import numpy as np

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.poses import nearest_point

MARGIN = 1.02   # room for a soft surface; the hull's cells leave some already
COVERED = 0.1   # alpha from which a pixel shows the object: below it lie compression noise and the rim of one pixel


def bounding_sphere(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre (3,) and radius of a sphere around `points` (P, 3), near the smallest, without margin.

    Source: Badoiu and Clarkson 2003, "Smaller core-sets for balls": step by 1/(i+1) towards the farthest point.
    """
    points = np.asarray(points, dtype=np.float64)
    center = 0.5 * (points.min(0) + points.max(0))
    best, radius = center, float(np.linalg.norm(points - center, axis=1).max())
    for i in range(1, 200):
        distance = np.linalg.norm(points - center, axis=1)
        if distance.max() < radius:
            best, radius = center, float(distance.max())
        center = center + (points[distance.argmax()] - center) / (i + 1)
    return best, radius


def find(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray,
         points: np.ndarray | None, alpha: str = "masks") -> tuple[np.ndarray, float, str]:
    """``(center (3,), radius, how)`` of the object's sphere in world units.

    images (N, H, W, 4) as stored · c2w (N, 4, 4) · focal, principal (N, 2) pixels · points (P, 3) or None · `alpha`:
    what it is, for `how`. Raises MiNtfError.
    """
    size = np.array(images.shape[2:0:-1])
    empty = sum(int(np.count_nonzero(~covered(image))) for image in images)
    if empty > 0.01 * len(images) * size.prod():
        return *from_masks(images, c2w, focal, principal), f"from the {alpha}' visual hull"
    if points is not None and len(points) >= 10:
        sphere = from_points(points, size, c2w, focal, principal)
        if sphere is not None:
            return *sphere, "from the reconstructed points"
    return *from_cameras(size, c2w, focal), f"from the cameras alone, as the {alpha} cover everything"


def covered(image: np.ndarray) -> np.ndarray:
    """Which pixels of an image (H, W, 4) as stored may show the object, (H, W) bool."""
    return image[..., 3] >= COVERED * (255 if image.dtype == np.uint8 else 1)


def from_masks(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray):
    """Sphere around the visual hull of what is :func:`covered` in images (N, H, W, 4). The hull holds the object, and
    so does the sphere."""
    center, reach = _first_guess(images, c2w, focal, principal)
    low, high = center - reach, center + reach
    for cells in (32, 64):  # once to find the box, once inside it
        edge = float((high - low).max()) / cells
        shape = np.ceil((high - low) / edge - 1e-9).astype(int)
        kept = _carve(low, edge, shape, images, c2w, focal, principal)
        low, high = kept.min(0) - edge, kept.max(0) + edge
    center, radius = bounding_sphere(_shell(kept))
    return center, MARGIN * (radius + 0.5 * np.sqrt(3) * edge)


def _first_guess(images: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray):
    """Centre of a cube that holds the object, and half its edge: where rays through the masks' middles meet."""
    middles, slopes = [], []
    for i, image in enumerate(images):
        mask = covered(image)
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        box = np.array([[columns[0], rows[0]], [columns[-1] + 1, rows[-1] + 1]])
        plane = (box - principal[i]) / focal[i] * (1, -1)
        slopes.append(0.5 * np.linalg.norm(plane[1] - plane[0]))
        middle = c2w[i, :3, :3] @ (*plane.mean(0), -1.0)
        middles.append(middle / np.linalg.norm(middle))
    center = nearest_point(c2w[:, :3, 3], np.array(middles))
    if center is None:
        raise MiNtfError(f"all {len(c2w)} cameras look in one direction, so the object's place in space is not known; "
                         "photograph it from more sides, or write 'unit_sphere' into transforms_train.json")
    distance = np.linalg.norm(c2w[:, :3, 3] - center, axis=1)
    return center, 1.5 * float(np.quantile(distance * slopes, 0.9))


def _carve(low: np.ndarray, edge: float, shape: np.ndarray, images: np.ndarray, c2w, focal, principal) -> np.ndarray:
    """Centres (K, 3) of the cells that no photograph shows empty and that at least half of them show at all.

    A mask that keeps clear of its image's border shows the whole object: outside of such an image all is empty.
    """
    axes = [low[k] + edge * (np.arange(shape[k]) + 0.5) for k in range(3)]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    seen = np.zeros(len(x), np.int32)
    height, width = images.shape[1:3]
    for i, (image, pose, f, c) in enumerate(zip(images, c2w, focal, principal, strict=True)):
        count = np.zeros((height + 1, width + 1), np.int32)  # summed-area table: any window's pixels in four look-ups
        count[1:, 1:] = covered(image).cumsum(0, np.int32).cumsum(1, np.int32)
        clear = count[-2, -2] - count[1, -2] - count[-2, 1] + count[1, 1] == count[-1, -1]
        local = (x - pose[:3, 3]) @ pose[:3, :3]
        depth = -local[:, 2]
        front = depth > edge
        safe = np.where(front, depth, 1.0)
        u = c[0] + f[0] * local[:, 0] / safe
        v = c[1] - f[1] * local[:, 1] / safe
        slant = np.linalg.norm(local, axis=1) / safe  # lengths along the ray move the pixel too, off the axis
        reach = slant * np.sqrt(3) / 2 * edge * f.max() / np.maximum(safe - edge, edge)  # half a cell's diagonal
        inside = front & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        u0, u1 = (np.clip(np.floor(u + s * reach) + (s > 0), 0, width).astype(int) for s in (-1, 1))
        v0, v1 = (np.clip(np.floor(v + s * reach) + (s > 0), 0, height).astype(int) for s in (-1, 1))
        pixels = np.where(front, count[v1, u1] - count[v0, u1] - count[v1, u0] + count[v0, u0], 0)
        kept = pixels > 0 if clear else ~inside | (pixels > 0)
        x, seen = x[kept], (seen + inside)[kept]
        if not len(x):
            raise _nothing_left(i, len(c2w))
    x = x[2 * seen >= len(c2w)]
    if not len(x):
        raise _nothing_left(len(c2w) - 1, len(c2w))
    return x


def _nothing_left(photograph: int, count: int) -> MiNtfError:
    return MiNtfError(f"no point in space is covered by the object in all photographs (photograph {photograph} of 0 to "
                      f"{count - 1} for training takes the last one away), so poses and masks do not belong together; "
                      "check that poses are camera-to-world with OpenGL axes, the field of view, and that no mask is "
                      "inverted (white: object)")


def _shell(x: np.ndarray) -> np.ndarray:
    """The lowest and highest of the cell centres `x` (K, 3), in lexicographic order, in every column along z."""
    new = np.flatnonzero((x[1:, :2] != x[:-1, :2]).any(1)) + 1
    return x[np.unique(np.concatenate([[0], new, new - 1, [len(x) - 1]]))]


def from_points(points: np.ndarray, size: np.ndarray, c2w: np.ndarray, focal: np.ndarray, principal: np.ndarray):
    """Sphere around the points (P, 3) that most cameras see, or None where these are too few.

    Robust: the middle is their median, the radius 1.1 times the 95th percentile of their distances, at most 0.9 of the
    nearest camera's. `size` (width, height) pixels.
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
    return center, min(radius, 0.9 * float(np.linalg.norm(c2w[:, :3, 3] - center, axis=1).min()))


def from_cameras(size: np.ndarray, c2w: np.ndarray, focal: np.ndarray):
    """Sphere at the point nearest to all optical axes, the largest that fits into every field of view."""
    center = nearest_point(c2w[:, :3, 3], c2w[:, :3, 2])
    if center is None:
        raise MiNtfError(f"all {len(c2w)} cameras look in one direction, so the object's place in space is not known; "
                         "photograph it from more sides, or write 'unit_sphere' into transforms_train.json")
    half = np.arctan(0.5 * size / focal).min(1)
    return center, float((np.linalg.norm(c2w[:, :3, 3] - center, axis=1) * np.sin(half)).min())

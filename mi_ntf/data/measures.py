"""What a data set is like, in numbers, and what of that will harm training: the part of `mi-ntf inspect` that computes.

Brightness is told as an apparent albedo, π L d²/I with d the flash's distance to the object's centre and I its
intensity, so that cameras at unequal distances can be compared. Lengths are in radii of the object's sphere.
"""

from typing import NamedTuple

import numpy as np

from mi_ntf.data import silhouettes
from mi_ntf.data.capture import view_directions
from mi_ntf.data.images import LINEAR, linear
from mi_ntf.data.schema import Split

SATURATED = 250
"""8-bit level from which a channel counts as saturated."""
BLACK = 0.002
"""Share of white below which a pixel counts as nearly black."""


class Photograph(NamedTuple):
    """What one photograph is like."""

    name: str
    split: str
    coverage: float
    """Share of the pixels that show the object for certain."""
    unknown: float
    """Share of the pixels of which it is not known (background 'black')."""
    mean: np.ndarray
    """(3,) mean linear radiance of the object's pixels."""
    brightness: np.ndarray
    """(3,) the same as apparent albedo."""
    saturated: float
    """Share of the object's pixels; NaN where the file does not tell."""
    black: float
    distance: float
    """Camera to the object's centre, radii."""
    flash: float
    """Angle between camera and flash as seen from there, degrees."""
    pixel: float
    """Width of a pixel at the object's centre, radii."""
    uncovered: float
    """Share of its silhouette that the others' hull does not cover; NaN: not compared."""


def certain(split: Split, alpha: np.ndarray) -> np.ndarray:
    """Which pixels show the object for certain, by their alpha."""
    return alpha >= (0.9 if split.masked else 0.999)


def possible(split: Split, alpha: np.ndarray) -> np.ndarray:
    """Which pixels may show the object."""
    return alpha >= (0.1 if split.masked else 0.001)


def name(splits: dict[str, Split], which: str, i: int) -> str:
    """The file of photograph `i` of a split, or else its number."""
    names = splits[which].names
    return names[i] if names else f"{which} {i}"


def measure(splits: dict[str, Split]) -> list[Photograph]:
    """Every photograph of `splits`, in the order of their names."""
    places = sorted((name(splits, which, i), which, i) for which, split in splits.items() for i in range(
        len(split.images)))
    outlines, white = [], white_level(splits)
    compared = set(silhouettes.chosen(len(places)).tolist())
    rows = []
    for number, (title, which, i) in enumerate(places):
        split = splits[which]
        stored = split.images[i]
        pixels = linear(stored)
        sure = certain(split, pixels[..., 3])
        if number in compared:
            outlines.append(silhouettes.Outline(possible(split, pixels[..., 3]), sure, split.c2w[i], split.focal[i],
                                                split.principal[i]))
        rows.append(_photograph(title, which, split, i, pixels, sure, white))
    first = splits["train"]
    shares = silhouettes.disagreement(outlines, first.center, first.radius) if len(outlines) > 2 else np.empty(0)
    for number, share in zip(sorted(compared), shares, strict=False):
        rows[number] = rows[number]._replace(uncovered=float(share))
    return rows


def white_level(splits: dict[str, Split]) -> tuple[float, bool]:
    """Linear radiance of white, and whether that is where the photographs are clipped.

    8-bit images end at 1, and so do linear files whose largest value is 1; else it is the 99.9th percentile.
    """
    samples, top = [], 0.0
    for split in splits.values():
        if split.images.dtype == np.uint8:
            return 1.0, True
        for image in split.images:
            largest = image[..., :3].max(-1)[certain(split, image[..., 3])].astype(np.float32)
            top = max(top, float(largest.max(initial=0)))
            samples.append(largest[:: max(1, largest.size // 4096)])
    values = np.concatenate(samples)
    if 0.99 <= top <= 1.001:
        return 1.0, True
    return (float(np.quantile(values, 0.999)) if values.size else 1.0), False


def _photograph(title: str, which: str, split: Split, i: int, pixels: np.ndarray, sure: np.ndarray,
                white: tuple[float, bool]) -> Photograph:
    inside = pixels[sure][:, :3]
    if not len(inside):
        inside = np.full((1, 3), np.nan, np.float32)
    largest = inside.max(-1) / white[0]
    mean = inside.mean(0, dtype=np.float64)
    eye, lamp = (place - split.center for place in (split.c2w[i, :3, 3], split.light_pos[i].astype(np.float64)))
    far, lit = np.linalg.norm(eye), np.linalg.norm(lamp)
    intensity = np.maximum(split.light_intensity[i].astype(np.float64), 1e-30)
    alpha = pixels[..., 3]
    return Photograph(
        title, which,
        coverage=float(alpha.mean() if split.masked else sure.mean()),
        unknown=0.0 if split.masked else float((possible(split, alpha) & ~sure).mean()),
        mean=mean, brightness=np.pi * mean * lit**2 / intensity,
        saturated=float((largest >= 0.999 * LINEAR[SATURATED]).mean()) if white[1] else float("nan"),
        black=float((largest < BLACK).mean()),
        distance=float(far / split.radius),
        flash=float(np.degrees(np.arccos(np.clip(eye @ lamp / (far * lit), -1, 1)))),
        pixel=float(far / split.focal[i].mean() / split.radius),
        uncovered=float("nan"))


def gap(splits: dict[str, Split]) -> tuple[float, np.ndarray]:
    """The direction (3,) from the object that is farthest from all cameras for training, and how far, degrees."""
    split = splits["train"]
    cameras = split.c2w[:, :3, 3] - split.center
    cameras = cameras / np.linalg.norm(cameras, axis=1, keepdims=True)
    tried = view_directions(10000, np.random.default_rng(0))
    for spread in (0.03, 0.003, 0.0):  # the lattice's directions are 2 degrees apart
        nearest = (tried @ cameras.T).max(1)
        best = tried[nearest.argmin()]
        around = best + spread * np.random.default_rng(1).normal(size=(2000, 3))
        tried = np.vstack([best, around / np.linalg.norm(around, axis=1, keepdims=True)])
    return float(np.degrees(np.arccos(np.clip((cameras @ best).max(), -1, 1)))), best


def numbers(splits: dict[str, Split], rows: list[Photograph]) -> dict:
    """The data set as a whole; plain numbers, None where there is none."""
    brightness = np.array([row.brightness for row in rows])
    first = splits["train"]
    degrees, direction = gap(splits)
    return {
        "photographs": {which: len(split.images) for which, split in splits.items()},
        "width": first.images.shape[2], "height": first.images.shape[1],
        "sphere": {"center": first.center.tolist(), "radius": float(first.radius)},
        "masked": first.masked, "calibrated": first.calibrated,
        "coverage": _spread([row.coverage for row in rows]),
        "unknown": _mean([row.unknown for row in rows]),
        "brightness": {"mean": _finite(np.nanmean(brightness, 0)) if np.isfinite(brightness).any() else None,
                       "ratio": _ratio(brightness)},
        "white_balance": {"red_over_green": _ratio(brightness[:, :1] / np.maximum(brightness[:, 1:2], 1e-30)),
                          "blue_over_green": _ratio(brightness[:, 2:] / np.maximum(brightness[:, 1:2], 1e-30))},
        "saturated": _mean([row.saturated for row in rows]),
        "black": _mean([row.black for row in rows]),
        "distance": _spread([row.distance for row in rows]),
        "flash_degrees": _spread([row.flash for row in rows]),
        "pixel": _spread([row.pixel for row in rows]),
        "gap": {"degrees": degrees, "direction": direction.tolist()},
        "uncovered": _spread([row.uncovered for row in rows]),
    }


def _mean(values: list[float]) -> float | None:
    kept = [value for value in values if np.isfinite(value)]
    return float(np.mean(kept)) if kept else None


def _spread(values: list[float]) -> dict | None:
    """Least, median and most of what is finite."""
    kept = [value for value in values if np.isfinite(value)]
    return {"least": float(min(kept)), "median": float(np.median(kept)), "most": float(max(kept))} if kept else None


def _ratio(values: np.ndarray):
    """Largest over smallest positive number of each column of `values` (N, C): a list, or one number where C is 1."""
    found = [float(v.max() / v.min()) if len(v := c[np.isfinite(c) & (c > 0)]) else None for c in values.T]
    return found if len(found) > 1 else found[0]


def _finite(values: np.ndarray) -> list:
    return [float(value) if np.isfinite(value) else None for value in values]


def warnings(found: dict, rows: list[Photograph]) -> list[str]:
    """One sentence for each thing in :func:`numbers` that will harm training, with the remedy."""
    told = [_of_views(found), _of_size(found), _of_light(found), _of_drift(found, rows), _of_masks(found, rows)]
    return [text for texts in told for text in texts]


def _of_views(found: dict):
    gap, far = found["gap"], found["distance"]
    if gap["degrees"] > 60:
        direction = ", ".join(f"{v:.2f}" for v in gap["direction"])
        yield (f"No camera for training is within {gap['degrees']:.0f}° of the direction ({direction}) from the "
               "object; that side will be guessed: take photographs from there, or do not show it.")
    if found["photographs"]["train"] < 30:
        yield (f"{found['photographs']['train']} photographs for training are few: 60 or more from all sides make a "
               "field without holes.")
    if far["most"] > 2 * far["least"]:
        yield (f"The cameras are between {far['least']:.3g} and {far['most']:.3g} radii from the object; the far ones "
               "blur what the near ones show: keep one distance, or check the poses.")


def _of_size(found: dict):
    if found["coverage"]["median"] < 0.1:
        yield (f"The object covers {percent(found['coverage']['median'])} of a photograph (median); go closer or "
               "crop, so that its pixels are spent on it.")
    if found["masked"] and found["coverage"]["median"] > 0.9:
        yield (f"The masks cover {percent(found['coverage']['median'])} of a photograph (median); check that they are "
               "not inverted (white: object).")
    if 2 / found["pixel"]["median"] < 100:
        yield (f"The object's sphere is {2 / found['pixel']['median']:.0f} pixels wide, which shows little detail; use "
               "larger photographs.")


def _of_light(found: dict):
    if (found["saturated"] or 0) > 0.01:
        yield (f"{percent(found['saturated'])} of the object's pixels are saturated, so highlights are not known; "
               "expose less.")
    if (found["black"] or 0) > 0.2:
        yield (f"{percent(found['black'])} of the object's pixels are nearly black and tell little; expose more, or "
               "bring the flash closer to the lens.")


def _of_drift(found: dict, rows: list[Photograph]):
    if found["calibrated"]:
        return
    ratio = found["brightness"]["ratio"]
    if max(r or 1 for r in ratio) > 1.5:
        k = int(np.argmax([r or 1 for r in ratio]))
        values = np.array([row.brightness[k] for row in rows])
        low, high = (rows[int(i)].name for i in (np.nanargmin(values), np.nanargmax(values)))
        yield (f"The object's brightness in {('red', 'green', 'blue')[k]} differs {ratio[k]:.3g}-fold between {low} "
               f"and {high}; unless its sides are so unequal, the exposure, the flash or the white balance was "
               "automatic. Training gives each photograph a gain for that; fixed settings are better.")
    drift = max(r or 1 for r in found["white_balance"].values())
    if drift > 1.3:
        yield (f"The object's colour, red or blue over green, differs {drift:.3g}-fold between photographs; unless "
               "its sides are so unequal, the white balance was automatic: fix it in the camera, or develop all raw "
               "files alike.")


def _of_masks(found: dict, rows: list[Photograph]):
    if not found["uncovered"]:
        return
    worst = max((row for row in rows if np.isfinite(row.uncovered)), key=lambda row: row.uncovered)
    if found["uncovered"]["median"] > 0.01:
        yield (f"{percent(found['uncovered']['median'])} of a silhouette (median; {worst.name}: "
               f"{percent(worst.uncovered)}) lie outside of what the other photographs leave for the object; the "
               "poses are inexact, or the masks unlike.")
    elif worst.uncovered > 0.02:
        yield (f"{percent(worst.uncovered)} of the silhouette in {worst.name} lies outside of what the other "
               "photographs leave for the object; one of their masks is too small, this one too large, or a pose is "
               "wrong.")


def percent(share: float | None) -> str:
    """A share for a reader."""
    return "–" if share is None or not np.isfinite(share) else f"{100 * share:.3g} %"

"""Numbers of a data set, and warnings of everything in them that will harm training (`mi-ntf inspect`).

Brightness is an apparent albedo, π L d²/I, with the flash's distance d to the object's centre and its intensity I, so
that cameras at unequal distances can be compared. Lengths are in radii of the object's sphere.
"""

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

from mi_ntf.core import progress
from mi_ntf.data import silhouettes
from mi_ntf.data.images import LINEAR, linear
from mi_ntf.data.poses import view_directions
from mi_ntf.data.schema import Split

SATURATED = 250  # 8-bit level from which a channel counts as saturated
BLACK = 0.002  # fraction of white below which a pixel counts as nearly black

Splits = dict[str, Split]
Numbers = dict[str, Any]  # plain numbers for JSON


class Photograph(NamedTuple):
    """Numbers of one photograph."""

    name: str
    split: str
    coverage: float  # fraction of the pixels that show the object for certain
    unknown: float  # fraction of the pixels that may show it (background 'black')
    mean: np.ndarray  # (3,) mean linear radiance of the object's pixels
    brightness: np.ndarray  # (3,) the same as apparent albedo
    saturated: float  # fraction of the object's pixels; NaN if the file does not tell
    black: float  # fraction of the object's pixels
    distance: float  # from the camera to the object's centre, radii
    flash: float  # angle between camera and flash at the object's centre, degrees; NaN if not known
    pixel: float  # width of a pixel at the object's centre, radii
    uncovered: float  # fraction of the silhouette outside the hull of all others; NaN if not compared


def certain(split: Split, alpha: np.ndarray) -> np.ndarray:
    """Return the mask of the pixels that show the object for certain, by their alpha."""
    return np.asarray(alpha >= (0.9 if split.masked else 0.999))


def possible(split: Split, alpha: np.ndarray) -> np.ndarray:
    """Return the mask of the pixels that may show the object, by their alpha."""
    return np.asarray(alpha >= (0.1 if split.masked else 0.001))


def places(splits: Splits) -> list[tuple[str, str, int]]:
    """Return (name, split, index) of all photographs in the order of their names."""
    return sorted((split.names[i] if split.names else f"{key} {i}", key, i)
                  for key, split in splits.items() for i in range(len(split.images)))


def measure(splits: Splits) -> list[Photograph]:
    """Return the numbers of every photograph of `splits`, in the order of their names."""
    ordered = places(splits)
    outlines, rows, white = [], [], white_level(splits)
    compared = silhouettes.chosen(len(ordered)).tolist()
    with progress.Stage("measured photographs", len(ordered), inner=True) as stage:
        for number, (name, key, i) in enumerate(ordered):
            split = splits[key]
            pixels = linear(split.images[i])
            sure = certain(split, pixels[..., 3])
            if number in compared:
                outlines.append(silhouettes.Outline(possible(split, pixels[..., 3]), sure, split.c2w[i], split.focal[i],
                                                    split.principal[i]))
            rows.append(_photograph(name, key, split, i, pixels, sure, white))
            stage.advance()
    if len(outlines) > 2:
        train = splits["train"]
        with progress.Stage("comparing the silhouettes", inner=True):
            fractions = silhouettes.disagreement(outlines, train.center, train.radius)
        for number, fraction in zip(compared, fractions, strict=True):
            rows[number] = rows[number]._replace(uncovered=float(fraction))
    return rows


class White(NamedTuple):
    """Linear radiance of white; `clips` is True if the photographs end there."""

    level: float
    clips: bool


def white_level(splits: Splits) -> White:
    """Return the white of the photographs.

    8-bit images end at 1, and so do linear files whose largest value is 1; else it is the 99.9th percentile.
    """
    samples, top = [], 0.0
    for split in splits.values():
        if split.images.dtype == np.uint8:
            return White(1.0, True)
        for image in split.images:
            largest = image[..., :3].max(-1)[certain(split, image[..., 3])].astype(np.float32)
            top = max(top, float(largest.max(initial=0)))
            samples.append(largest[:: max(1, largest.size // 4096)])
    values = np.concatenate(samples)
    if 0.99 <= top <= 1.001:
        return White(1.0, True)
    return White(float(np.quantile(values, 0.999)) if values.size else 1.0, False)


def _photograph(name: str, key: str, split: Split, i: int, pixels: np.ndarray, sure: np.ndarray, white: White
                ) -> Photograph:
    inside = pixels[sure][:, :3]
    if not len(inside):
        inside = np.full((1, 3), np.nan, np.float32)
    largest = inside.max(-1) / white.level
    mean = inside.mean(0, dtype=np.float64)
    eye, lamp = (place - split.center for place in (split.c2w[i, :3, 3], split.light_pos[i].astype(np.float64)))
    far, lit = np.linalg.norm(eye), np.linalg.norm(lamp)
    intensity = np.maximum(split.light_intensity[i].astype(np.float64), 1e-30)
    alpha = pixels[..., 3]
    return Photograph(
        name, key,
        coverage=float(alpha.mean() if split.masked else sure.mean()),
        unknown=0.0 if split.masked else float((possible(split, alpha) & ~sure).mean()),
        mean=mean, brightness=np.pi * mean * lit**2 / intensity,
        saturated=float((largest >= 0.999 * LINEAR[SATURATED]).mean()) if white.clips else float("nan"),
        black=float((largest < BLACK).mean()),
        distance=float(far / split.radius),
        flash=float(np.degrees(np.arccos(np.clip(eye @ lamp / (far * lit), -1, 1)))) if split.located else np.nan,
        pixel=float(far / split.focal[i].mean() / split.radius),
        uncovered=float("nan"))


def gap(splits: Splits) -> tuple[float, np.ndarray]:
    """Return the largest angle (degrees) to the cameras for training, and its direction (3,) from the object."""
    split = splits["train"]
    cameras = split.c2w[:, :3, 3] - split.center
    cameras = cameras / np.linalg.norm(cameras, axis=1, keepdims=True)
    directions = view_directions(10000, np.random.default_rng(0))
    for spread in (0.03, 0.003, 0.0):  # the lattice's directions are 2 degrees apart
        best = directions[(directions @ cameras.T).max(1).argmin()]
        around = best + spread * np.random.default_rng(1).normal(size=(2000, 3))
        directions = np.vstack([best, around / np.linalg.norm(around, axis=1, keepdims=True)])
    return float(np.degrees(np.arccos(np.clip((cameras @ best).max(), -1, 1)))), best


def numbers(splits: Splits, rows: list[Photograph]) -> Numbers:
    """Return the numbers of the whole data set for JSON; None stands for an unknown number."""
    brightness = np.array([row.brightness for row in rows])
    green = np.maximum(brightness[:, 1:2], 1e-30)
    first = splits["train"]
    degrees, direction = gap(splits)
    spreads = {key: _spread([getattr(row, name) for row in rows]) for key, name in (
        ("coverage", "coverage"), ("distance", "distance"), ("flash_degrees", "flash"), ("pixel", "pixel"),
        ("uncovered", "uncovered"))}
    means = {key: float(np.mean(known)) if (known := _finite([getattr(row, key) for row in rows])) else None
             for key in ("unknown", "saturated", "black")}
    mean = np.nanmean(brightness, 0) if np.isfinite(brightness).any() else None
    return {
        "photographs": {key: len(split.images) for key, split in splits.items()},
        "width": first.images.shape[2], "height": first.images.shape[1],
        "sphere": {"center": first.center.tolist(), "radius": float(first.radius)},
        "masked": first.masked, "calibrated": first.calibrated,
        "brightness": {"mean": None if mean is None else [float(v) if np.isfinite(v) else None for v in mean],
                       "ratio": _ratios(brightness)},
        "white_balance": {"red_over_green": _ratios(brightness[:, :1] / green)[0],
                          "blue_over_green": _ratios(brightness[:, 2:] / green)[0]},
        "gap": {"degrees": degrees, "direction": direction.tolist()},
        **spreads, **means,
    }


def _finite(values: list[float]) -> list[float]:
    return [value for value in values if np.isfinite(value)]


def _spread(values: list[float]) -> dict[str, float] | None:
    known = _finite(values)
    return {"least": min(known), "median": float(np.median(known)), "most": max(known)} if known else None


def _ratios(values: np.ndarray) -> list[float | None]:
    """Return the largest over the smallest positive number of each column of `values` (N, C)."""
    return [float(v.max() / v.min()) if len(v := c[np.isfinite(c) & (c > 0)]) else None for c in values.T]


def warnings(data: Numbers, rows: list[Photograph]) -> list[str]:
    """Return one sentence, with the remedy, for each of the :func:`numbers` that will harm training."""
    return [*_of_pixels(data), *_of_drift(data, rows), *_of_masks(data, rows)]


def _of_pixels(data: Numbers) -> Iterator[str]:
    gap, far, coverage, width = data["gap"], data["distance"], data["coverage"]["median"], 2 / data["pixel"]["median"]
    if gap["degrees"] > 60:
        direction = ", ".join(f"{v:.2f}" for v in gap["direction"])
        yield (f"No camera for training is within {gap['degrees']:.0f}° of the direction ({direction}) from the "
               "object; that side will be guessed: take photographs from there, or do not show it.")
    if data["photographs"]["train"] < 30:
        yield (f"{data['photographs']['train']} photographs for training are few: 60 or more from all sides make a "
               "field without holes.")
    if far["most"] > 2 * far["least"]:
        yield (f"The cameras are between {far['least']:.3g} and {far['most']:.3g} radii from the object; the far ones "
               "blur what the near ones show: keep one distance, or check the poses.")
    if coverage < 0.1:
        yield (f"The object covers {percent(coverage)} of a photograph (median); go closer or crop, so that its pixels "
               "are spent on it.")
    if data["masked"] and coverage > 0.9:
        yield (f"The masks cover {percent(coverage)} of a photograph (median); check that they are not inverted "
               "(white: object).")
    if width < 100:
        yield (f"The object's sphere is {width:.0f} pixels wide, which shows little detail; use larger photographs.")
    if (data["saturated"] or 0) > 0.01:
        yield (f"{percent(data['saturated'])} of the object's pixels are saturated, so highlights are not known; "
               "expose less.")
    if (data["black"] or 0) > 0.2:
        yield (f"{percent(data['black'])} of the object's pixels are nearly black and tell little; expose more, or "
               "bring the flash closer to the lens.")


def _of_drift(data: Numbers, rows: list[Photograph]) -> Iterator[str]:
    if data["calibrated"]:
        return
    ratio = [r or 1 for r in data["brightness"]["ratio"]]
    if max(ratio) > 1.5:
        k = int(np.argmax(ratio))
        values = np.array([row.brightness[k] for row in rows])
        low, high = (rows[int(i)].name for i in (np.nanargmin(values), np.nanargmax(values)))
        yield (f"The object's brightness in {('red', 'green', 'blue')[k]} differs {ratio[k]:.3g}-fold between {low} "
               f"and {high}; unless its sides are so unequal, the exposure, the flash or the white balance was "
               "automatic. Training gives each photograph a gain for that; fixed settings are better.")
    drift = max(r or 1 for r in data["white_balance"].values())
    if drift > 1.3:
        yield (f"The object's colour, red or blue over green, differs {drift:.3g}-fold between photographs; unless "
               "its sides are so unequal, the white balance was automatic: fix it in the camera, or develop all raw "
               "files alike.")


def _of_masks(data: Numbers, rows: list[Photograph]) -> Iterator[str]:
    if not data["uncovered"]:
        return
    worst = max((row for row in rows if np.isfinite(row.uncovered)), key=lambda row: row.uncovered)
    if data["uncovered"]["median"] > 0.01:
        yield (f"{percent(data['uncovered']['median'])} of a silhouette (median; {worst.name}: "
               f"{percent(worst.uncovered)}) lie outside the hull of the other photographs; the poses are inexact, or "
               "the masks unlike.")
    elif worst.uncovered > 0.02:
        yield (f"{percent(worst.uncovered)} of the silhouette in {worst.name} lies outside the hull of the other "
               "photographs; one of their masks is too small, this one too large, or a pose is wrong.")


def percent(fraction: float | None) -> str:
    """Return `fraction` as a percentage for a reader."""
    return "–" if fraction is None or not np.isfinite(fraction) else f"{100 * fraction:.3g} %"

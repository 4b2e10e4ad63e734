"""The picture of `mi-ntf compare`: image, reference, where they differ, and how much of it is seen."""

from pathlib import Path

import numpy as np

from ..core import files
from ..core.errors import MiNtfError
from . import metrics

DPI = 110
SHOWN = 99.5
"""Per cent of the pixels whose difference the colours tell apart; single bright pixels would hide all others."""


def check(path: Path) -> None:
    """Raise :class:`MiNtfError` for a name that is no PNG's or cannot be written to, before the work."""
    if path.suffix.lower() != ".png":
        raise MiNtfError(f"picture {path}: unknown ending {path.suffix!r}; give .png")
    files.check(path)


def draw(path: Path, image: np.ndarray, reference: np.ndarray, result: dict) -> None:
    """Write a row of four panels as PNG: image and reference (linear RGB (h, w, 3), shown as sRGB, clipped), the signed
    difference a − b, mean of channels, over the RMS of the reference, and the map of HDR-FLIP, 0 to 1.

    `result`: figures of the two, for the titles. Raises :class:`MiNtfError`.
    """
    from matplotlib.figure import Figure

    relative = difference(image, reference)
    scale = round_scale(np.percentile(np.abs(relative), SHOWN))
    height, width = relative.shape
    panel = float(np.clip(width / DPI, 3.2, 10))  # inches
    tall = float(np.clip(panel * height / width, 1.2, 10))
    figure = Figure(figsize=(4 * panel + 1.6, tall + 0.7), layout="constrained")
    panels = figure.subplots(1, 4)
    shown = {"image": metrics.srgb(image), "reference": metrics.srgb(reference)}
    for axes, (title, pixels) in zip(panels, shown.items(), strict=False):
        axes.imshow(pixels, interpolation="nearest")
        axes.set_title(title)
    _map(figure, panels[2], relative, cmap="RdBu_r", vmin=-scale, vmax=scale, extend="both",
         title=f"image − reference, ±{100 * scale:g}% of its RMS\nrelative RMSE {result['relative_rmse']:.2%}")
    _map(figure, panels[3], metrics.flip_map(image, reference), cmap="magma", vmin=0, vmax=1, extend="neither",
         title=f"HDR-FLIP\nmean {result['flip']:.4f}")
    for axes in panels:
        axes.set_axis_off()
    with files.replacing(path) as temporary:
        figure.savefig(temporary, format="png", dpi=DPI)


def difference(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Mean of channels of a − b over the RMS of b, (h, w): above 0 where the image is too bright."""
    return (image - reference).mean(-1) / np.sqrt(np.mean(np.square(reference)))


def round_scale(value: float) -> float:
    """The next of 1, 2, 5, 10, 20 … per cent and their parts from `value` on; at least 0.1 per cent."""
    value = max(float(value), 1e-3)
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(power * step for step in (1, 2, 5, 10) if power * step >= value * (1 - 1e-9)))


def _map(figure, axes, values, title, extend, **colours) -> None:
    drawn = axes.imshow(values, interpolation="nearest", **colours)
    axes.set_title(title)
    figure.colorbar(drawn, ax=axes, extend=extend, fraction=0.05, pad=0.02)

"""The picture of `mi-ntf compare`: image, reference, their difference, and the visible part of it."""

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core import files
from . import metrics
from .limits import Json

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 110
PERCENTILE = 99.5
"""Percentile of the differences at the end of the colour scale; single bright pixels would hide all others."""


def check(path: Path) -> None:
    """Raise :class:`MiNtfError` unless the file is a PNG that can be written."""
    files.check(path, (".png",))


def draw(path: Path, image: np.ndarray, reference: np.ndarray, result: Json) -> None:
    """Write a row of four panels as PNG: image, reference, signed difference, and the map of HDR-FLIP.

    Images are linear RGB (h, w, 3) and shown as clipped sRGB. The difference is that of :func:`difference`. The metrics
    in `result` stand in the titles. Raises :class:`MiNtfError`.
    """
    from matplotlib.figure import Figure

    relative = difference(image, reference)
    scale = round_scale(np.percentile(np.abs(relative), PERCENTILE))
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
    """Return the mean of channels of a − b over the RMS of b, (h, w); positive where the image is too bright."""
    relative: np.ndarray = (image - reference).mean(-1) / np.sqrt(np.mean(np.square(reference)))
    return relative


def round_scale(value: float) -> float:
    """Return the least of 0.001, 0.002, 0.005, 0.01, 0.02 … that is not below `value`."""
    value = max(float(value), 1e-3)
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(power * step for step in (1, 2, 5, 10) if power * step >= value * (1 - 1e-9)))


def _map(figure: "Figure", axes: "Axes", values: np.ndarray, title: str, extend: str, cmap: str, vmin: float,
         vmax: float) -> None:
    image = axes.imshow(values, interpolation="nearest", cmap=cmap, vmin=vmin, vmax=vmax)
    axes.set_title(title)
    figure.colorbar(image, ax=axes, extend=extend, fraction=0.05, pad=0.02)

"""`mi-ntf compare IMAGE REFERENCE`: read two images, measure, print."""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError

from . import compare_picture, metrics, perceptual
from .limits import METRICS

VARIANTS = {"aligned": "aligned", "masked": "object", "masked_aligned": "object, aligned"}
"""Beside the raw figures: name and title."""
INSIDE = 0.5
"""Pixels of the reference with more alpha than this are the object."""


def compare(image: Path, reference: Path, picture: Path | None = None) -> dict:
    """All metrics by name, both images composited on black; see :func:`compare_arrays`.

    EXR is read as linear and premultiplied, its AOV layers are dropped; PNG as sRGB with straight alpha. `picture`: PNG
    to write, see :func:`.compare_picture.draw`; its name is returned as ``picture``. Raises :class:`MiNtfError` where a
    file is missing or unreadable, sizes differ, a pixel is not finite, or the picture cannot be written.
    """
    if picture is not None:
        compare_picture.check(picture)
    a, b = read_image(image), read_image(reference)
    if a.shape != b.shape:
        raise MiNtfError(f"{image} has {_size(a)} pixels, {reference} has {_size(b)}; render both at one size")
    result = compare_arrays(a[..., :3], b[..., :3], b[..., 3], lpips=True)
    if picture is not None:
        compare_picture.draw(picture, a[..., :3], b[..., :3], result)
        result["picture"] = str(picture)
    return result


def compare_arrays(image: np.ndarray, reference: np.ndarray, alpha: np.ndarray | None = None,
                   lpips: bool = False) -> dict:
    """:func:`compare` for linear RGB arrays (h, w, 3), composited on black, and the reference's alpha (h, w).

    The raw figures by their names. Below ``aligned`` the same after one factor a channel, which stand there as
    ``factors``: published comparisons of relit objects take out the scale of the albedo that way. Below ``masked`` and
    ``masked_aligned`` those of the object's own pixels, a share ``coverage`` of the picture, where `alpha` tells the
    object from a background. A figure that picture or machine do not allow is None, with ``reason`` and ``remedy``
    below ``not_measured``. `lpips`: LPIPS, too, which imports PyTorch where it is installed.
    """
    names = [name for name in METRICS if lpips or name != "lpips"]
    missing: dict[str, dict[str, str]] = {}

    def figures(image, mask) -> dict:
        return {name: _figure(name, image, reference, mask, missing) for name in names}

    def aligned(mask) -> dict:
        factors = metrics.alignment(image, reference, mask)
        return figures(image * factors, mask) | {"factors": [float(f) for f in factors]}

    result = figures(image, None) | {"aligned": aligned(None)}
    inside = None if alpha is None else alpha > INSIDE
    if inside is not None and 0 < inside.sum() < inside.size:
        result["masked"] = figures(image, inside) | {"coverage": float(inside.mean())}
        result["masked_aligned"] = aligned(inside)
    return result | ({"not_measured": missing} if missing else {})


def _figure(name: str, image, reference, mask, missing: dict) -> float | None:
    """One figure; None, with an entry in `missing`, where it cannot be measured."""
    try:
        return getattr(perceptual if name == "lpips" else metrics, name)(image, reference, mask)
    except metrics.NotMeasured as error:
        missing[name] = {"reason": error.reason, "remedy": error.remedy}
        return None


def read_image(path: Path) -> np.ndarray:
    """Linear premultiplied RGBA (h, w, 4), float32; alpha is 1 where the file has none.

    For errors see :func:`compare`.
    """
    path = Path(path)
    if not path.is_file():
        raise MiNtfError(f"image {path} does not exist; render it first")
    readers = {".exr": _read_exr, ".png": _read_png}
    if path.suffix.lower() not in readers:
        raise MiNtfError(f"image {path}: unknown ending {path.suffix!r}; give .exr or .png")
    pixels = readers[path.suffix.lower()](path)
    bad = int(np.count_nonzero(~np.isfinite(pixels).all(axis=-1)))
    if bad:
        raise MiNtfError(f"image {path}: {bad} of {pixels.shape[0] * pixels.shape[1]} pixels are NaN or infinite; "
                         "they would make every metric meaningless, so mend the render")
    return pixels


def print_table(result: dict) -> None:
    """Print what :func:`compare` returned, with each metric's definition."""
    from rich.console import Console
    from rich.table import Table

    variants = {title: result[name] for name, title in VARIANTS.items() if name in result}
    missing = result.get("not_measured", {})
    table = Table("metric", "raw", *variants, "on")
    for name, metric in METRICS.items():
        if name in result:
            values = [figures[name] for figures in (result, *variants.values())]
            said = f"not measured: {missing[name]['reason']}" if name in missing else metric.definition
            title = ", ".join(filter(None, [metric.title, metric.unit]))
            table.add_row(title, *("–" if v is None else f"{v:.4g}" for v in values), said)
    console = Console()
    console.print(table)
    for name, why in missing.items():
        if why["remedy"]:  # never wrapped, so that commands can be copied
            line = f"to measure {METRICS[name].title}: {why['remedy']}"
            console.print(line, soft_wrap=True, markup=False, highlight=False)
    for title, figures in variants.items():
        if "factors" in figures:
            console.print(f"{title}: red, green, blue times " + ", ".join(f"{f:.4f}" for f in figures["factors"]))
        if "coverage" in figures:
            console.print(f"{title}: {figures['coverage']:.1%} of the pixels, alpha above {INSIDE:g} in the reference")
    if "picture" in result:
        console.print(f"picture: {result['picture']}", soft_wrap=True, markup=False, highlight=False)


def _size(pixels: np.ndarray) -> str:
    return f"{pixels.shape[1]}×{pixels.shape[0]}"


def _read_exr(path: Path) -> np.ndarray:
    import OpenEXR

    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            parts = [{name: np.array(c.pixels, np.float32) for name, c in part.channels.items()} for part in file.parts]
    except Exception as error:  # OpenEXR raises bare RuntimeError and ValueError
        raise MiNtfError(f"image {path} is no readable EXR ({error}); render it anew") from None
    for channels in parts:
        for names in ("RGB", "YYY"):
            if set(names) <= set(channels):
                colour = [channels[c] for c in names]
                return np.stack([*colour, channels.get("A", np.ones_like(colour[0]))], axis=-1)
    found = sorted({name for channels in parts for name in channels})
    raise MiNtfError(f"image {path}: no part has the channels R, G, B or Y; found {', '.join(found)}")


def _read_png(path: Path) -> np.ndarray:
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as file:
            encoded = np.asarray(file.convert("RGBA"), np.float32) / 255
    except (OSError, SyntaxError) as error:  # Pillow's own type derives from OSError
        raise MiNtfError(f"image {path} is no readable PNG ({error}); make it anew") from None
    alpha = encoded[..., 3:]
    return np.concatenate([metrics.linear(encoded[..., :3]) * alpha, alpha], axis=-1).astype(np.float32)

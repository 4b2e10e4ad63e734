"""The command `mi-ntf compare IMAGE REFERENCE`: read two images, measure, print."""

from pathlib import Path

import numpy as np

from mi_ntf.core import extras
from mi_ntf.core.errors import MiNtfError

from . import compare_picture, metrics, perceptual
from .limits import METRICS, Json

VARIANTS = {"aligned": "aligned", "masked": "object", "masked_aligned": "object, aligned"}
"""Names and titles of the figures besides the raw ones."""
INSIDE = 0.5
"""Alpha of the reference above which a pixel belongs to the object."""


def compare(image: Path, reference: Path, picture: Path | None = None) -> Json:
    """Return all metrics by name, both images composited on black; see :func:`compare_arrays`.

    EXR files are read as linear and premultiplied, without their AOV layers; PNG files as sRGB with straight alpha.
    `picture` is a PNG file to write, see :func:`.compare_picture.draw`; its name is returned as ``picture``.

    Raises
    ------
    MiNtfError
        If a file is missing or unreadable, sizes differ, a pixel is not finite, or the picture cannot be written.
    """
    if picture is not None:
        compare_picture.check(picture)
        if picture.resolve() in (image.resolve(), reference.resolve()):
            raise MiNtfError(f"{picture} is one of the images to compare; choose another name for the picture")
    a, b = read_image(image), read_image(reference)
    if a.shape != b.shape:
        raise MiNtfError(f"{image} has {_size(a)} pixels, {reference} has {_size(b)}; render both at one size")
    result = compare_arrays(a[..., :3], b[..., :3], b[..., 3], lpips=True)
    if picture is not None:
        compare_picture.draw(picture, a[..., :3], b[..., :3], result)
        result["picture"] = str(picture)
    return result


def compare_arrays(image: np.ndarray, reference: np.ndarray, alpha: np.ndarray | None = None,
                   lpips: bool = False) -> Json:
    """Return all metrics of linear RGB arrays (h, w, 3), composited on black, by name.

    ``aligned`` holds the same after one factor for each channel, stored as ``factors``; published comparisons of relit
    objects remove the scale of the albedo in this way. ``masked`` and ``masked_aligned`` hold those of the object's own
    pixels, if `alpha` of the reference (h, w) tells them from a background. They are a fraction ``coverage`` of the
    picture. A metric that picture or machine do not allow is None, with ``reason`` and ``remedy`` in
    ``not_measured``. With `lpips`, LPIPS is measured too, which imports PyTorch where it is installed.
    """
    names = [name for name in METRICS if lpips or name != "lpips"]
    missing: dict[str, dict[str, str]] = {}

    def figures(image: np.ndarray, mask: np.ndarray | None) -> Json:
        return {name: _figure(name, image, reference, mask, missing) for name in names}

    def aligned(mask: np.ndarray | None) -> Json:
        factors = metrics.alignment(image, reference, mask)
        return figures(image * factors, mask) | {"factors": [float(f) for f in factors]}

    result = figures(image, None) | {"aligned": aligned(None)}
    inside = None if alpha is None else alpha > INSIDE
    if inside is not None and 0 < inside.sum() < inside.size:
        result["masked"] = figures(image, inside) | {"coverage": float(inside.mean())}
        result["masked_aligned"] = aligned(inside)
    return result | ({"not_measured": missing} if missing else {})


def _figure(name: str, image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None,
            missing: dict[str, dict[str, str]]) -> float | None:
    """Return one metric, or None with an entry in `missing` where it cannot be measured."""
    metric: metrics.Function = getattr(perceptual if name == "lpips" else metrics, name)
    try:
        return metric(image, reference, mask)
    except metrics.NotMeasured as error:
        missing[name] = {"reason": error.reason, "remedy": error.remedy}
        return None


def read_image(path: Path) -> np.ndarray:
    """Return linear premultiplied RGBA (h, w, 4), float32; alpha is 1 where the file has none.

    Raises MiNtfError as :func:`compare` does.
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


def print_table(result: Json) -> None:
    """Print the result of :func:`compare` with the definition of each metric."""
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    variants = {title: result[name] for name, title in VARIANTS.items() if name in result}
    missing = result.get("not_measured", {})
    table = Table("metric", "raw", *variants, "on", box=SIMPLE_HEAD, pad_edge=False)
    for name, metric in METRICS.items():
        if name in result:
            values = [figures[name] for figures in (result, *variants.values())]
            text = f"not measured: {missing[name]['reason']}" if name in missing else metric.definition
            title = ", ".join(filter(None, [metric.title, metric.unit]))
            table.add_row(title, *("–" if v is None else f"{v:.4g}" for v in values), text)
    console = Console()
    console.print(table)
    for name, entry in missing.items():
        if entry["remedy"]:  # never wrapped, so that commands can be copied
            line = f"to measure {METRICS[name].title}: {entry['remedy']}"
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
        for letters in ("RGB", "YYY"):
            if set(letters) <= set(channels):
                colour = [channels[c] for c in letters]
                return np.stack([*colour, channels.get("A", np.ones_like(colour[0]))], axis=-1)
    names = sorted({name for channels in parts for name in channels})
    raise MiNtfError(f"image {path}: no part has the channels R, G, B or Y; found {', '.join(names)}")


def _read_png(path: Path) -> np.ndarray:
    extras.need("eval", "a PNG image", "PIL")
    from PIL import Image

    try:
        with Image.open(path, formats=["PNG"]) as file:
            if file.mode.startswith("I"):  # Pillow would clip 16 bits of grey to 8
                grey = np.asarray(file, np.float32)[..., None] / 65535
                return np.concatenate([np.repeat(metrics.linear(grey), 3, -1), np.ones_like(grey)], -1)
            encoded = np.asarray(file.convert("RGBA"), np.float32) / 255
    except (OSError, SyntaxError) as error:  # Pillow's own type derives from OSError
        raise MiNtfError(f"image {path} is no readable PNG ({error}); make it anew") from None
    alpha = encoded[..., 3:]
    return np.concatenate([metrics.linear(encoded[..., :3]) * alpha, alpha], axis=-1).astype(np.float32)

"""EXR files: the display window of the layer that holds the rendered picture.

Channels R, G, B[, A] (or red, green, blue, alpha) without a layer's name are the picture. Otherwise it is the only
layer (ViewLayer.Combined.R, of Blender and Nuke) or part that has R, G and B, or the only one that is called Combined,
Beauty or RGBA, or Blender's Composite.Combined. Pixels of the display window outside the data window are black and
empty.
"""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data.colour import PRIMARIES

if TYPE_CHECKING:
    import OpenEXR

PICTURES = ("combined", "beauty", "rgba")  # last part of the names of layers of rendered pictures, in lower case
COMPOSITE = "composite.combined"  # of Blender's compositor, beside the layers that it composes
CHANNELS = {name: channel for channel, word in zip("RGBA", ("red", "green", "blue", "alpha"), strict=True)
            for name in (channel.lower(), word)}
"""Channels by their names in lower case."""
LARGEST = 1 << 16  # pixels of a display window's side


class Layer(NamedTuple):
    """Layer of an EXR file: its name ("" if it has none), its part, and its channels by R, G, B and A."""

    name: str
    part: int
    channels: "dict[str, OpenEXR.Channel]"


def read(path: Path) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """Return linear RGB (H, W, 3), alpha (H, W) or None, and assumptions. Raises MiNtfError and errors of OpenEXR."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        layer = _picture(file, path)
        header = file.header(layer.part)
        assumed = [f"the layer '{layer.name}' of an EXR file is its picture"] if layer.name else []
        primaries = header.get("chromaticities")
        if primaries is not None and np.abs(np.array(primaries[:6]) - PRIMARIES).max() > 0.01:
            raise MiNtfError(f"{path}: its 'chromaticities' are {shown([round(v, 4) for v in primaries[:6]])}, other "
                             "primaries than Rec. 709's; convert it to linear Rec. 709 (sRGB primaries)")
        (low, high), (left_top, right_bottom) = header["dataWindow"], header["displayWindow"]
        if any(channel.pixels.dtype.kind == "u" for channel in layer.channels.values()):
            raise MiNtfError(f"{path}: its channels are whole numbers, whose white is not known; write it with "
                             "floating-point numbers")
        planes = {key: np.array(channel.pixels, dtype=np.float32) for key, channel in layer.channels.items()}
    if (low != left_top).any() or (high != right_bottom).any():
        size = right_bottom - left_top + 1
        if not (0 < size.min() and size.max() < LARGEST):
            raise MiNtfError(f"{path}: its display window is {size[0]}x{size[1]} pixels; write it with that of the "
                             "whole picture")
        planes = {key: _windowed(plane, low - left_top, size) for key, plane in planes.items()}
        assumed.append("an EXR file's picture is its display window, beyond the data window empty")
    return np.stack([planes["R"], planes["G"], planes["B"]], -1), planes.get("A"), assumed


def size(path: Path) -> tuple[int, int]:
    """Return (width, height) of the display window. Raises errors of OpenEXR."""
    import OpenEXR

    low, high = OpenEXR.File(str(path), header_only=True).header()["displayWindow"]
    width, height = high - low + 1
    return int(width), int(height)


def write_exr(path: Path, rgba: np.ndarray) -> None:
    """Write linear premultiplied RGBA (H, W, 4), whole or not at all.

    The precision is half, or single if a value is beyond the range of half precision.
    """
    import OpenEXR

    dtype = np.float32 if np.abs(rgba).max() > np.finfo(np.float16).max else np.float16
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": np.ascontiguousarray(rgba, dtype=dtype)}) as file:
        with files.replacing(path) as temporary:
            file.write(str(temporary))


def _picture(file: "OpenEXR.File", path: Path) -> Layer:
    """Return the layer that is the picture. Raises MiNtfError if there is none, or more than one candidate."""
    layers: dict[tuple[str, int], dict[str, OpenEXR.Channel]] = {}
    for i, part in enumerate(file.parts):
        for name, channel in file.channels(i).items():
            layer, _, last = name.rpartition(".")
            key = layer or (part.name() if len(file.parts) > 1 else ""), i
            layers.setdefault(key, {}).setdefault(CHANNELS.get(last.lower(), last), channel)  # capitals come first
    complete = [key for key, channels in layers.items() if set("RGB") <= set(channels)]
    if not complete:
        names = sorted({name for i in range(len(file.parts)) for name in file.channels(i)})
        raise MiNtfError(f"{path}: has channels {', '.join(names)}, lacks "
                         f"{', '.join(c for c in 'RGB' if c not in names)}; write it as RGB or RGBA")
    titled = [key for key in complete if key[0].rpartition(".")[2].lower() in PICTURES]
    nameless = [key for key in complete if not key[0]]
    composite = [key for key in complete if key[0].lower() == COMPOSITE]
    chosen = next((keys for keys in (nameless, complete, titled, composite) if len(keys) == 1), None)
    if chosen is None:
        raise MiNtfError(f"{path}: has the layers {shown([layer for layer, _ in complete])}, of which none alone is "
                         f"called {', '.join(PICTURES)}; write the rendered picture as R, G, B, A without a layer")
    (key,) = chosen
    return Layer(*key, {channel: layers[key][channel] for channel in "RGBA" if channel in layers[key]})


def _windowed(plane: np.ndarray, offset: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return a picture of `size` (width, height) with `plane` at `offset` (x, y), black elsewhere."""
    whole = np.zeros((size[1], size[0]), np.float32)
    (x, y), (height, width) = offset, plane.shape
    inside = whole[max(y, 0):max(y + height, 0), max(x, 0):max(x + width, 0)]
    inside[:] = plane[max(-y, 0):, max(-x, 0):][:inside.shape[0], :inside.shape[1]]
    return whole

"""Reader of EXR files: the picture within the display window, of the layer that is the rendered picture.

    R, G, B[, A]             without a layer's name: the picture, whatever else the file holds
    ViewLayer.Combined.R     layers (Blender, Nuke), or parts of such names: the only one that has R, G and B, or the
                             only one that is called Combined, Beauty or RGBA
    display window           what the camera sees; pixels that the data window lacks are black and empty
"""

from pathlib import Path

import numpy as np

from mi_ntf.core.errors import MiNtfError, shown
from mi_ntf.data.colour import PRIMARIES

PICTURES = ("combined", "beauty", "rgba")
"""Last part of the names of layers that hold the rendered picture, in lower case."""
LARGEST = 1 << 16
"""Pixels of a display window's side."""


def read(path: Path) -> tuple[np.ndarray, np.ndarray | None, list[str]]:
    """``(linear RGB (H, W, 3), alpha (H, W) or None, what was assumed)``. Raises MiNtfError, and what OpenEXR does."""
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        name, part, channels = _picture(file, path)
        header, assumed = file.header(part), [f"the layer '{name}' of an EXR file is its picture"] if name else []
        _check_primaries(header, path)
        (low, high), (left_top, right_bottom) = header["dataWindow"], header["displayWindow"]
        planes = {key: np.array(channel.pixels, dtype=np.float32) for key, channel in channels.items()}
    if (low != left_top).any() or (high != right_bottom).any():
        size = right_bottom - left_top + 1
        if not (0 < size.min() and size.max() < LARGEST):
            raise MiNtfError(f"{path}: its display window is {size[0]}x{size[1]} pixels; write it with that of the "
                             "whole picture")
        planes = {key: _windowed(plane, low - left_top, size) for key, plane in planes.items()}
        assumed.append("an EXR file's picture is its display window, beyond the data window empty")
    return np.stack([planes["R"], planes["G"], planes["B"]], -1), planes.get("A"), assumed


def size(path: Path) -> tuple[int, int]:
    """(width, height) of the display window. Raises what OpenEXR does."""
    import OpenEXR

    low, high = OpenEXR.File(str(path), header_only=True).header()["displayWindow"]
    width, height = high - low + 1
    return int(width), int(height)


def _picture(file, path: Path) -> tuple[str, int, dict]:
    """``(layer, part, channels by R, G, B, A)`` of the picture; the layer "" has no name."""
    layers: dict[tuple[str, int], dict] = {}
    for i, part in enumerate(file.parts):
        for name, channel in file.channels(i).items():
            layer, _, last = name.rpartition(".")
            layers.setdefault((layer or (part.name() if len(file.parts) > 1 else ""), i), {})[last] = channel
    complete = [key for key, channels in layers.items() if set("RGB") <= set(channels)]
    if not complete:
        found = sorted({name for i in range(len(file.parts)) for name in file.channels(i)})
        raise MiNtfError(f"{path}: has channels {', '.join(found)}, lacks "
                         f"{', '.join(c for c in 'RGB' if c not in found)}; write it as RGB or RGBA")
    called = [key for key in complete if key[0].rpartition(".")[2].lower() in PICTURES]
    plain = [key for key in complete if not key[0]]
    chosen = next((keys for keys in (plain, complete, called) if len(keys) == 1), None)
    if chosen is None:
        raise MiNtfError(f"{path}: has the layers {shown([layer for layer, _ in complete])}, of which none alone is "
                         f"called {', '.join(PICTURES)}; write the rendered picture as R, G, B, A without a layer")
    (layer, i), = chosen
    return layer, i, {key: layers[layer, i][key] for key in "RGBA" if key in layers[layer, i]}


def _check_primaries(header: dict, path: Path) -> None:
    found = header.get("chromaticities")
    if found is not None and np.abs(np.array(found[:6]) - PRIMARIES).max() > 0.01:
        raise MiNtfError(f"{path}: its 'chromaticities' are {shown([round(v, 4) for v in found[:6]])}, other primaries "
                         "than Rec. 709's; convert it to linear Rec. 709 (sRGB primaries)")


def _windowed(plane: np.ndarray, offset: np.ndarray, size: np.ndarray) -> np.ndarray:
    """A picture of `size` (width, height), black but where `plane` lies with its corner at `offset` (x, y)."""
    whole = np.zeros((size[1], size[0]), np.float32)
    (x, y), (height, width) = offset, plane.shape
    inside = whole[max(y, 0):max(y + height, 0), max(x, 0):max(x + width, 0)]
    inside[:] = plane[max(-y, 0):, max(-x, 0):][:inside.shape[0], :inside.shape[1]]
    return whole

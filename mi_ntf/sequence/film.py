"""Frames as a film, MP4 (H.264) or WebM (VP9), by ffmpeg (extra ``video``)."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ..core import files, ops, srgb
from ..core.errors import MiNtfError
from . import image_file

CODECS = {".mp4": ("libx264", "mp4", ["-crf", "18", "-preset", "medium", "-movflags", "+faststart"]),
          ".webm": ("libvpx-vp9", "webm", ["-crf", "24", "-b:v", "0"])}
"""By the ending: codec, container, quality."""
COLOURS = ["-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709",
           "-color_trc", "iec61966-2-1", "-color_range", "tv"]


def check(path: Path) -> None:
    """Raise MiNtfError, before any work, where no film could be written to `path`."""
    if path.suffix.lower() not in CODECS:
        raise MiNtfError(f"film {path}: unknown ending {path.suffix!r}; give .mp4 or .webm")
    _encoder()
    files.check(path)


def toned(channels: dict[str, np.ndarray], exposure: float) -> np.ndarray:
    """Pixels (h, w, 3) uint8 of linear R, G, B (or Y): times 2^`exposure`, on black, clipped to [0, 1], sRGB's curve.
    No highlight is compressed: what is brighter than 1 is white."""
    names = "RGB" if set("RGB") <= set(channels) else "YYY"
    if not set(names) <= set(channels):
        raise MiNtfError(f"the frames have the channels {', '.join(sorted(channels))}, a film needs R, G, B or Y")
    linear = np.stack([channels[n] for n in names], -1).astype(np.float32) * 2.0**exposure
    return (srgb.encode(ops, np.nan_to_num(linear)) * 255 + 0.5).astype(np.uint8)


def said(exposure: float) -> str:
    """What :func:`toned` does, in a line."""
    return f"linear RGB times {2.0**exposure:g}, clipped to 0..1, sRGB curve, on black"


def write(path: Path, frames: Iterable[Path], fps: float, exposure: float = 0.0) -> str:
    """Write the film of `frames`, EXR files, with `fps` frames a second; returns how they were toned, which the file
    says, too. The last row or column of odd sizes is shown twice. Raises MiNtfError."""
    encoder = _encoder()
    codec, container, quality = CODECS[path.suffix.lower()]
    note = said(exposure)
    with files.replacing(path) as temporary:
        writer = None
        for frame in frames:
            pixels = toned(image_file.read(frame)[0], exposure)
            pixels = np.pad(pixels, [(0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)], mode="edge")
            if writer is None:
                writer = encoder.write_frames(
                    str(temporary), pixels.shape[1::-1], fps=fps, codec=codec, macro_block_size=2,
                    ffmpeg_log_level="error",
                    output_params=[*quality, *COLOURS, "-metadata", f"comment={note}", "-f", container])
                writer.send(None)
            writer.send(np.ascontiguousarray(pixels))
        if writer is not None:
            writer.close()
    return note


def _encoder():
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MiNtfError("a film is written by ffmpeg: pip install 'mi-ntf[video]'") from None
    return imageio_ffmpeg

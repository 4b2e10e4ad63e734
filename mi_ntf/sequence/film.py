"""Frames as a film, MP4 (H.264) or WebM (VP9), by ffmpeg (extra ``video``)."""

import itertools
import subprocess
from collections.abc import Iterable
from contextlib import suppress
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
    _ffmpeg()
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
    note, pictures = said(exposure), (_even(toned(image_file.read(frame)[0], exposure)) for frame in frames)
    first = next(pictures)
    codec, container, quality = CODECS[path.suffix.lower()]
    size = f"{first.shape[1]}x{first.shape[0]}"
    words = [
        _ffmpeg(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(fps), "-i", "-",
        "-c:v", codec, "-pix_fmt", "yuv420p", *quality, *COLOURS, "-metadata", f"comment={note}", "-f", container]
    with files.replacing(path) as temporary:
        with subprocess.Popen([*words, str(temporary)], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as program:
            assert program.stdin is not None and program.stderr is not None
            try:
                for picture in itertools.chain([first], pictures):
                    if picture.shape != first.shape:
                        raise MiNtfError(f"film {path}: frames of {first.shape[1::-1]} and {picture.shape[1::-1]} "
                                         "pixels; a film has one size")
                    program.stdin.write(picture.data)
                program.stdin.close()
            except BrokenPipeError:  # it says why
                with suppress(OSError):
                    program.stdin.close()
            except BaseException:
                program.kill()
                raise
            complaint = program.stderr.read().decode(errors="replace").strip()
        if program.returncode:
            raise MiNtfError(f"film {path}: ffmpeg ended with {program.returncode}: {complaint}")
    return note


def _even(pixels: np.ndarray) -> np.ndarray:
    return np.pad(pixels, [(0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)], mode="edge")


def _ffmpeg() -> str:
    """The program."""
    try:
        import imageio_ffmpeg
    except ImportError:
        raise MiNtfError("a film is written by ffmpeg: pip install 'mi-ntf[video]'") from None
    return imageio_ffmpeg.get_ffmpeg_exe()

"""Films of frames, MP4 (H.264) or WebM (VP9), by ffmpeg (extra ``video``)."""

import itertools
import subprocess
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..core import extras, files, ops, srgb
from ..core.errors import MiNtfError
from . import image_file

CODECS = {".mp4": ("libx264", "mp4", ["-crf", "18", "-preset", "medium", "-movflags", "+faststart"]),
          ".webm": ("libvpx-vp9", "webm", ["-crf", "24", "-b:v", "0"])}
"""Codec, container and options of quality by the file name's ending."""
COLOURS = ["-vf", "scale=out_color_matrix=bt709:out_range=tv", "-colorspace", "bt709", "-color_primaries", "bt709",
           "-color_trc", "iec61966-2-1", "-color_range", "tv"]


@dataclass(frozen=True)
class Film:
    """Film of all frames: its `path`, frames per second, and exposure in stops."""

    path: Path
    fps: float
    exposure: float = 0.0

    def check(self) -> None:
        """Raise MiNtfError where no film could be written, before any work."""
        _ffmpeg()
        files.check(self.path, tuple(CODECS))

    @property
    def note(self) -> str:
        """Description of the tones of the film."""
        return f"linear RGB times {2.0**self.exposure:g}, clipped to 0..1, sRGB curve, on black"

    def toned(self, channels: image_file.Channels) -> NDArray[np.uint8]:
        """Return the pixels (h, w, 3) of linear R, G, B (or Y): times 2^exposure, clipped to [0, 1], in sRGB."""
        names = "RGB" if set("RGB") <= set(channels) else "YYY"
        if not set(names) <= set(channels):
            raise MiNtfError(f"the frames have the channels {', '.join(sorted(channels))}, a film needs R, G, B or Y")
        linear = np.stack([channels[n] for n in names], -1).astype(np.float32) * 2.0**self.exposure
        return np.asarray(srgb.encode(ops, np.nan_to_num(linear)) * 255 + 0.5, np.uint8)

    def write(self, frames: Iterable[Path]) -> None:
        """Write the film of `frames`, EXR files, with its note. Raises MiNtfError.

        The codecs need even sizes, so the last row or column of odd sizes is repeated.
        """
        path = self.path
        pictures = (_even(self.toned(image_file.read(frame)[0])) for frame in frames)
        first = next(pictures)
        codec, container, quality = CODECS[path.suffix.lower()]
        size = f"{first.shape[1]}x{first.shape[0]}"
        command = [
            _ffmpeg(), "-y", "-v", "error", "-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(self.fps),
            "-i", "-", "-c:v", codec, "-pix_fmt", "yuv420p", *quality, *COLOURS, "-metadata", f"comment={self.note}",
            "-f", container]
        with files.replacing(path) as temporary:
            with subprocess.Popen([*command, str(temporary)], stdin=subprocess.PIPE, stderr=subprocess.PIPE) as program:
                assert program.stdin is not None and program.stderr is not None
                try:
                    for picture in itertools.chain([first], pictures):
                        if picture.shape != first.shape:
                            raise MiNtfError(f"film {path}: frames of {first.shape[1::-1]} and {picture.shape[1::-1]} "
                                             "pixels; a film has one size")
                        program.stdin.write(picture.data)
                    program.stdin.close()
                except BrokenPipeError:  # ffmpeg's own message follows
                    with suppress(OSError):
                        program.stdin.close()
                except BaseException:
                    program.kill()
                    raise
                message = program.stderr.read().decode(errors="replace").strip()
            if program.returncode:
                raise MiNtfError(f"film {path}: ffmpeg ended with {program.returncode}: {message}")


def _even(pixels: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.pad(pixels, [(0, pixels.shape[0] % 2), (0, pixels.shape[1] % 2), (0, 0)], mode="edge")


def _ffmpeg() -> str:
    """Return the path of the program ffmpeg."""
    extras.need("video", "a film")
    import imageio_ffmpeg

    return str(imageio_ffmpeg.get_ffmpeg_exe())

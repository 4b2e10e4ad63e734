"""Films: tones by value, and the pictures that a decoder reads back."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from mi_ntf import cli
from mi_ntf.core.errors import MiNtfError
from mi_ntf.sequence import film, image_file

ffmpeg = pytest.importorskip("imageio_ffmpeg")


def frames(folder, values, size=(20, 31)):
    """Write frames of one linear colour each."""
    paths = []
    for number, value in enumerate(values):
        paths.append(image_file.path_of(folder, number, len(values)))
        pixels = np.full(size, 1, np.float32)
        channels = {c: v * pixels for c, v in zip("RGBA", (*value, 1), strict=True)}
        image_file.write(paths[-1], channels, {"number": number})
    return paths


def test_tones_are_those_that_it_says():
    row = np.float32([[-1, 0, 0.0025, 0.18, 0.5, 1, 7]])
    # sRGB's table: 0.0025 is on the line, 0.18 is 118, 0.5 is 188.
    shown = film.Film(Path(), 24).toned({"R": row, "G": row, "B": row})
    assert shown[0, :, 0].tolist() == [0, 0, 8, 118, 188, 255, 255]
    assert film.Film(Path(), 24, 1).toned({"Y": row})[0, :, 1].tolist() == [0, 0, 16, 162, 255, 255, 255]
    assert film.Film(Path(), 24, 1).note == "linear RGB times 2, clipped to 0..1, sRGB curve, on black"


@pytest.mark.parametrize("ending", ["mp4", "webm"])
def test_a_film_shows_every_frame_once_in_its_colour(tmp_path, ending):
    colours = [(0.5, 0.05, 0.02), (0.02, 0.4, 0.1), (0.1, 0.1, 0.6), (0.9, 0.9, 0.9), (0, 0, 0)]
    path = tmp_path / f"film.{ending}"
    the_film = film.Film(path, 10)
    the_film.write(frames(tmp_path, colours))
    program = ffmpeg.get_ffmpeg_exe()
    output = subprocess.run([program, "-i", str(path)], capture_output=True, text=True).stderr
    assert "32x20" in output and "10 fps" in output and "sRGB curve" in output and "bt709" in output
    read = [program, "-v", "error", "-i", str(path), "-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    shown = np.frombuffer(subprocess.run(read, capture_output=True, check=True).stdout, np.uint8).reshape(-1, 20, 32, 3)
    assert len(shown) == 5
    for pixels, colour in zip(shown, colours, strict=True):
        expected = the_film.toned({c: np.float32([[v]]) for c, v in zip("RGB", colour, strict=True)})[0, 0]
        np.testing.assert_allclose(pixels[10, 16].astype(int), expected, atol=4)  # 8-bit Y'CbCr, lossy
    assert sorted(p.name for p in tmp_path.iterdir()) == ["film." + ending, *(f"frame_000{i}.exr" for i in range(5))]


def test_a_film_says_its_tones(tmp_path):
    path = tmp_path / "film.mp4"
    dark = film.Film(path, 24, -1)
    dark.write(frames(tmp_path, [(0.1, 0.2, 0.3)]))
    assert dark.note.encode() in path.read_bytes() and "times 0.5" in dark.note


def test_a_film_that_cannot_be_is_an_error_before_the_work(tmp_path, scene, capsys):
    with pytest.raises(MiNtfError, match=r"the name ends in '.gif', expected .mp4 or .webm"):
        film.Film(tmp_path / "a.gif", 24).check()
    words = ["sequence", str(scene()), "-o", str(tmp_path / "out"), "--film"]
    (tmp_path / "file").touch()
    assert cli.main([*words, str(tmp_path / "file" / "a.mp4")]) == 1
    assert "file" in capsys.readouterr().err and not (tmp_path / "out").exists()
    assert cli.main([*words, str(tmp_path / "films" / "a.mp4")]) == 0
    assert "sRGB curve" in capsys.readouterr().out and (tmp_path / "films" / "a.mp4").stat().st_size > 500


def test_without_ffmpeg_the_extra_is_named(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "imageio_ffmpeg", None)
    with pytest.raises(MiNtfError, match=r"pip install 'mi-ntf\[video\]'"):
        film.Film(tmp_path / "a.mp4", 24).check()

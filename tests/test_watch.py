"""`mi-ntf render --watch`: changes that cause a render, faults that it survives, pictures for tev."""

import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_ntf import cli, watch
from mi_ntf.core.errors import MiNtfError

SCENE = """
<scene version="3.9.0">
  <integrator type="direct"/>
  <include filename="sensor.xml"/>
  <emitter type="constant"><rgb name="radiance" value="1, 2, 4"/></emitter>
</scene>
"""
SENSOR = """
<scene version="3.9.0">
  <sensor type="perspective">
    <film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="4"/></film>
    <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
  </sensor>
</scene>
"""


class Viewer:
    """Server that decodes pictures in the format of `Ipc.cpp` of tev."""

    def __init__(self):
        self.server = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self.server.getsockname()[1]}"
        self.names, self.images = [], {}
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self):
        while True:
            connection, _ = self.server.accept()
            with connection, connection.makefile("rb") as stream:
                while head := stream.read(4):
                    self._take(stream.read(struct.unpack("<I", head)[0] - 4))

    def _take(self, packet: bytes):
        kind, rest = packet[0], packet[2:]
        name, rest = self._text(rest)
        if kind == 4:  # CreateImage
            width, height, count = struct.unpack_from("<iii", rest)
            channels, _ = self._texts(rest[12:], count)
            self.images[name] = {c: np.full((height, width), np.nan, np.float32) for c in channels}
        else:
            assert kind == 6  # UpdateImage
            (count,) = struct.unpack_from("<i", rest)
            channels, rest = self._texts(rest[4:], count)
            x, y, width, height = struct.unpack_from("<iiii", rest)
            numbers = struct.unpack_from(f"<{2 * count}q", rest, 16)
            data = np.frombuffer(rest, "<f4", offset=16 + 16 * count)
            for i, channel in enumerate(channels):
                at = numbers[i] + numbers[count + i] * np.arange(width * height)
                self.images[name][channel][y : y + height, x : x + width] = data[at].reshape(height, width)
            self.names.append(name)

    def _text(self, data: bytes):
        text, _, rest = data.partition(b"\0")
        return text.decode(), rest

    def _texts(self, data: bytes, count: int):
        texts = []
        for _ in range(count):
            text, data = self._text(data)
            texts.append(text)
        return texts, data


class Watching:
    """The running command."""

    def __init__(self, folder: Path, *words: str):
        program = Path(sys.executable).with_name("mi-ntf")
        self.log = folder / "log.txt"
        command = [str(program), "render", "-m", "llvm_ad_rgb", "--watch", "-o", "out.exr", *words, "scene.xml"]
        with self.log.open("w") as log:
            self.process = subprocess.Popen(command, cwd=folder, stdout=subprocess.DEVNULL, stderr=log)

    def lines(self) -> list[str]:
        return [line for line in self.log.read_text().splitlines() if "; watching " in line]

    def rounds(self, count: int) -> str:
        """Wait for this many rounds, and return the last one's message."""
        end = time.monotonic() + 120
        while len(self.lines()) < count:
            assert self.process.poll() is None and time.monotonic() < end, self.log.read_text()
            time.sleep(0.05)
        return self.lines()[-1]

    def stop(self) -> int:
        self.process.send_signal(signal.SIGINT)
        return self.process.wait(60)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "scene.xml").write_text(SCENE)
    (tmp_path / "sensor.xml").write_text(SENSOR)
    return tmp_path


def pixels(folder: Path) -> np.ndarray:
    return np.array(mi.Bitmap(str(folder / "out.exr")))[..., :3].astype(np.float32)


def test_changes_are_rendered_faults_survived_and_tev_sees_each_picture(folder: Path):
    viewer = Viewer()
    run = Watching(folder, "--tev", viewer.address)
    try:
        assert "watching 2 files, Ctrl-C ends" in run.rounds(1)
        np.testing.assert_allclose(pixels(folder), np.broadcast_to([1, 2, 4], (4, 6, 3)), rtol=1e-3)
        (folder / "scene.xml").write_text(SCENE.replace("1, 2, 4", "3, 2, 4"))
        run.rounds(2)
        np.testing.assert_allclose(pixels(folder)[..., 0], 3, rtol=1e-3)
        (folder / "sensor.xml").write_text(SENSOR.replace("</sensor>", ""))
        assert "Start-end tags mismatch" in run.rounds(3)
        (folder / "new.xml").write_text(SENSOR.replace('"6"', '"5"'))
        os.replace(folder / "new.xml", folder / "sensor.xml")  # as editors write
        assert "mismatch" not in run.rounds(4)
        assert pixels(folder).shape == (4, 5, 3)
        time.sleep(1)
        assert len(run.lines()) == 4  # nothing without a change
    finally:
        code = run.stop()
    assert code == 0
    assert viewer.names == 3 * [str(folder / "out.exr")]
    [image] = viewer.images.values()
    np.testing.assert_allclose(np.stack([image[c] for c in "RGB"], -1), pixels(folder), rtol=1e-3)


def test_a_viewer_that_is_not_there_or_hangs_is_no_fault():
    said: list[str] = []
    bitmap = mi.Bitmap(np.zeros((2048, 2048, 4), np.float32))
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        tev = watch.Tev(f"127.0.0.1:{port}", said.append)
        timeout, watch.TEV_TIMEOUT = watch.TEV_TIMEOUT, 0.3
        try:
            assert not tev.show("a", bitmap) and not tev.show("a", bitmap)
        finally:
            watch.TEV_TIMEOUT = timeout
    assert said == ["tev did not take the picture (timed out)"]
    assert not tev.show("a", bitmap)
    assert len(said) == 1 and socket.getdefaulttimeout() is None


def test_without_the_package_it_says_once_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "tevclient", None)
    said: list[str] = []
    tev = watch.Tev(Viewer().address, said.append)
    bitmap = mi.Bitmap(np.zeros((2, 2, 3), np.float32))
    assert not tev.show("a", bitmap) and not tev.show("a", bitmap)
    assert said == ["tev listens; it is sent pictures after `pip install 'mi-ntf[watch]'`"]


def test_interrupted_while_it_renders_it_ends():
    def render(_seen):
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt:
            raise RuntimeError("what Mitsuba makes of it") from None

    before, said = signal.getsignal(signal.SIGINT), []
    watch.watch(render, said.append)
    assert said == [] and signal.getsignal(signal.SIGINT) is before


def test_files_that_are_still_being_written_are_waited_for(tmp_path: Path):
    file, seen_sizes = tmp_path / "field", []
    file.write_bytes(b"a")

    def render(note):
        note(file)
        seen_sizes.append(file.stat().st_size)
        if len(seen_sizes) == 2:
            signal.raise_signal(signal.SIGINT)

    def write():
        time.sleep(0.5)
        with file.open("ab", buffering=0) as out:
            for _ in range(10):
                out.write(b"b")
                time.sleep(watch.INTERVAL / 2)

    threading.Thread(target=write).start()
    watch.watch(render, lambda _: None)
    assert seen_sizes == [1, 11]


def test_faults_of_the_command(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(folder)
    assert cli.main("render --watch a.xml b.xml".split()) == 2
    assert "--watch takes one scene, found 2" in capsys.readouterr().err
    assert cli.main("render -m llvm_ad_rgb --watch nothing.xml".split()) == 1
    assert "scene nothing.xml does not exist" in capsys.readouterr().err
    with pytest.raises(MiNtfError, match="--tev is 'here', expected HOST:PORT"):
        watch.Tev("here", print)

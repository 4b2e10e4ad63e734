"""Ctrl-C in a terminal, which all processes of a command receive: exit code 130, and a sentence on how to go on."""

import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest
from helpers import scenes

SPHERE = """<scene version="3.9.0"><integrator type="path"/><shape type="sphere"/></scene>"""
FIELD = """<scene version="3.9.0"><default name="map" value="1024"/>
    <integrator type="nrf"><integer name="map_resolution" value="$map"/></integrator>
    <sensor type="perspective"><transform name="to_world"><lookat origin="2, 1.5, 6" target="0.4, -0.2, 0.3"
        up="0, 1, 0"/></transform><sampler type="independent"><integer name="sample_count" value="4096"/></sampler>
        <film type="hdrfilm"><integer name="width" value="64"/><integer name="height" value="64"/></film></sensor>
    <emitter type="point" id="lamp"><point name="position" x="3" y="3" z="2.5"/></emitter>
    <shape type="sphere"><point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/><medium type="nrf" name="interior"><string name="filename" value="{field}"/>
        <integer name="resolution" value="{voxels}"/></medium></shape></scene>"""


class Command:
    """A command of `mi-ntf` in a session of its own, as in a terminal; `said` has what it printed."""

    def __init__(self, folder: Path, *words: str):
        program = [sys.executable, "-m", "mi_ntf", *words]
        self.said = folder / "said.txt"
        with open(self.said, "w") as file:
            self.process = subprocess.Popen(program, cwd=folder, stdout=file, stderr=file, start_new_session=True,
                                            env={**os.environ, "XDG_CACHE_HOME": str(folder / "cache")})

    def interrupt(self, when: Callable[[], bool]) -> tuple[int, str]:
        """Press Ctrl-C as soon as `when` is true; return the exit code and the last line."""
        end = time.monotonic() + 120
        while not when():
            assert self.process.poll() is None and time.monotonic() < end, self.said.read_text()
            time.sleep(0.02)
        os.killpg(self.process.pid, signal.SIGINT)
        code = self.process.wait(60)
        assert "Traceback" not in self.said.read_text()
        return code, self.said.read_text().splitlines()[-1].removeprefix("\x1b[0m")  # end of a warning of Mitsuba's


@pytest.fixture(scope="module")
def field(tmp_path_factory) -> Path:
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


@pytest.mark.parametrize("workers", [[], ["--workers", "2"]], ids=["alone", "two workers"])
def test_a_capture_goes_on(tmp_path, workers):
    (tmp_path / "scene.xml").write_text(SPHERE)
    words = ["capture", "scene.xml", "photos", "--views", "3000", "--size", "8", "--spp", "1", *workers]
    command = Command(tmp_path, *words)
    code, last = command.interrupt(lambda: len(list(tmp_path.glob("photos/train/*.exr"))) > 3)
    stopped = re.fullmatch(r"mi-ntf: stopped after (\d+) of 3170 photographs; the same command goes on", last)
    assert code == 130 and stopped and int(stopped[1]) > 0  # two more may be there, of which no worker could tell
    there = len(list(tmp_path.glob("photos/*/*.exr")))
    again = Command(tmp_path, *words)
    code, last = again.interrupt(lambda: "photographs: " in again.said.read_text())
    assert f"goes on: {there} of 3170 photographs are there" in again.said.read_text() and code == 130


@pytest.mark.parametrize("workers", [[], ["--workers", "2"]], ids=["alone", "two workers"])
def test_a_sequence_goes_on(field, tmp_path, workers):
    (tmp_path / "scene.xml").write_text(FIELD.format(field=field, voxels=48).replace("4096", "1"))
    (tmp_path / "turn.toml").write_text("frames = 400\n[lights.lamp]\nposition = { start = [3, 3, 2.5], centre = "
                                        "[0, 0, 0], degrees = { keys = [[0, 0], [4, 120]] } }\n")
    words = ["sequence", "scene.xml", "-o", "out", "--timeline", "turn.toml", "-D", "map=32", *workers]
    command = Command(tmp_path, *words)
    code, last = command.interrupt(lambda: len(list(tmp_path.glob("out/*.exr"))) > 2)
    assert code == 130
    assert re.fullmatch(r"mi-ntf: stopped after \d+ of 400 frames; the same command goes on", last)


def test_bake_and_render_leave_no_file(field, tmp_path):
    """Ctrl-C comes while a field is baked in a thread of Mitsuba's, while maps are made, and while pixels are."""
    (tmp_path / "scene.xml").write_text(FIELD.format(field=field, voxels=384))
    command = Command(tmp_path, "bake", "scene.xml", "-o", "maps.exr")
    assert command.interrupt(lambda: "reading scene.xml" in command.said.read_text()) == (
        130, "mi-ntf: stopped while reading scene.xml; nothing was written")
    (tmp_path / "scene.xml").write_text(FIELD.format(field=field, voxels=48))
    render = Command(tmp_path, "render", "scene.xml", "-o", "picture.exr", "-D", "map=32")
    assert render.interrupt(lambda: "nrf integrator: auto" in render.said.read_text()) == (
        130, "mi-ntf: stopped while rendering scene.xml; nothing was written")
    assert list(tmp_path.glob("*.exr*")) == []

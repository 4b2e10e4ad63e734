"""The user's cache in a place that cannot be used, or that several use: it may cost time, never a render, never a wrong
picture."""

import os
import re
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers.maps import table, texels, without_cache

from mi_ntf.render.maps import map_cache

# --- folders that cannot be used -------------------------------------------------------------------------------------


@contextmanager
def little_room(size):
    """Limit files to `size` bytes, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def spoil(what, cache, monkeypatch):
    """Make the cache unusable; returns what the warning says."""
    home = cache.parent.parent
    if what in ("a file in place of XDG_CACHE_HOME", "a file in place of mi-ntf", "a file in place of maps"):
        place = {"XDG_CACHE_HOME": home, "mi-ntf": cache.parent, "maps": cache}[what.split()[-1]]
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_text("a file")
        return r"cannot make the folder .*(File exists|Not a directory)"
    if what == "no home":
        def nobody():
            raise RuntimeError("Could not determine home directory.")

        monkeypatch.delenv("XDG_CACHE_HOME")
        monkeypatch.setattr(Path, "home", nobody)
        return "the user has no home folder"
    if what == "a read-only disk":  # root ignores permission bits, so the system's answer is played
        def refuse(self, *args, **kwargs):
            raise OSError(30, "Read-only file system", str(self))

        monkeypatch.setattr(Path, "mkdir", refuse)
        return "Read-only file system"
    return "File too large"


FAULTS = ["a file in place of XDG_CACHE_HOME", "a file in place of mi-ntf", "a file in place of maps", "no home",
          "a read-only disk", "a full disk"]


@pytest.mark.parametrize("what", FAULTS)
def test_a_cache_that_cannot_be_used_is_one_warning(medium, cache, warnings, monkeypatch, what):
    expected = without_cache(medium), without_cache(medium, table(2))
    reason = spoil(what, cache, monkeypatch)
    with little_room(1000 if what == "a full disk" else resource.RLIM_INFINITY):
        for _ in range(2):
            np.testing.assert_array_equal(texels(medium), expected[0])
            np.testing.assert_array_equal(texels(medium, table(2)), expected[1])
            map_cache.forget()
    (text,) = warnings
    assert re.search(reason, text) and "XDG_CACHE_HOME" in text and "\n" not in text
    if cache.is_dir():
        assert not list(cache.iterdir()), "nothing half-written, nothing temporary"


SCENE = """<scene version="3.9.0">
  <integrator type="nrf"><string name="visibility" value="transmittance_map"/>
    <integer name="map_resolution" value="16"/><integer name="samples" value="96"/></integrator>
  <sensor type="perspective"><transform name="to_world"><lookat origin="0.4,-0.2,6" target="0.4,-0.2,0.3" up="0,1,0"/>
    </transform><sampler type="independent"><integer name="sample_count" value="2"/></sampler>
    <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
  <emitter type="point"><point name="position" x="3" y="3" z="2.5"/></emitter>
  <emitter type="directional"><vector name="direction" x="-1" y="-1.2" z="-0.6"/></emitter>
  <shape type="sphere"><point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
    <bsdf type="null"/><medium type="nrf" name="interior"><string name="filename" value="FIELD"/>
    <integer name="resolution" value="48"/></medium></shape></scene>"""


@pytest.fixture
def render(path, tmp_path):
    """Starts the program on a small scene under maps; ``render(name, **environment)``: (process, picture's path)."""
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.replace("FIELD", str(path)))

    def start(name, **environment):
        out = tmp_path / f"{name}.exr"
        command = [sys.executable, "-m", "mi_ntf", "render", "-m", "llvm_ad_rgb", str(scene), "-o", str(out)]
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
                                env=os.environ | {"MI_NTF_CACHE": "on"} | environment), out

    return start


def finish(process):
    text, _ = process.communicate(timeout=300)
    assert process.returncode == 0, text
    return text


def pixels(path):
    return OpenEXR.File(str(path), separate_channels=True).channels()["G"].pixels.copy()


def test_the_program_renders_with_a_file_in_place_of_the_cache(render, tmp_path):
    obstacle = tmp_path / "file"
    obstacle.write_text("")
    process, out = render("spoilt", XDG_CACHE_HOME=str(obstacle))
    text = finish(process)
    assert pixels(out).max() > 0
    assert text.count("mi_ntf keeps nothing for later renders") == 1 and "Traceback" not in text


@pytest.mark.slow
def test_three_processes_on_one_cache(render, tmp_path):
    """Started together on an empty cache: the same bits as without one; afterwards the cache serves a fourth."""
    home = tmp_path / "home"
    alone, reference = render("reference", MI_NTF_CACHE="off")
    finish(alone)
    together = [render(f"p{k}", XDG_CACHE_HOME=str(home)) for k in range(3)]
    for process, out in together:
        finish(process)
        np.testing.assert_array_equal(pixels(out), pixels(reference))
    (file,) = (home / "mi-ntf" / "maps").iterdir()
    before = file.stat().st_ino
    later, out = render("later", XDG_CACHE_HOME=str(home))
    finish(later)
    np.testing.assert_array_equal(pixels(out), pixels(reference))
    assert [p.stat().st_ino for p in file.parent.iterdir()] == [before], "it was read, not written anew"

"""The user's cache under every fault: it may cost time, never a render, never a wrong picture, never memory."""

import dataclasses
import os
import re
import resource
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from helpers import scenes
from helpers.maps import OPTIONS, SIZE, build, find_medium, table, texels, without_cache
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf import cli
from mi_ntf.infer import profile
from mi_ntf.render import user_cache
from mi_ntf.render.cost import model
from mi_ntf.render.maps import map_cache
from mi_ntf.render.scene import loaded


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


@pytest.fixture
def medium(path):
    return find_medium(path)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of maps, not yet made."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("MI_NTF_MAP_CACHE", "on")
    map_cache.forget()
    user_cache._warned.clear()
    yield tmp_path / "cache" / "mi-ntf" / "maps"
    map_cache.forget()


@pytest.fixture
def warnings(monkeypatch):
    """What is logged."""
    texts = []
    monkeypatch.setattr(user_cache.mi, "Log", lambda level, text: texts.append(text))
    return texts


# --- folders that cannot be used -------------------------------------------------------------------------------------


@contextmanager
def little_room(size):
    """No file may grow beyond `size` bytes: what a full disk is to a writer."""
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


@pytest.mark.parametrize("what", FAULTS)
def test_prices_that_cannot_be_kept_are_one_warning(cache, warnings, monkeypatch, what):
    reason = spoil(what, cache, monkeypatch)
    possible = what == "a file in place of maps"
    with little_room(100 if what == "a full disk" else resource.RLIM_INFINITY):
        for _ in range(2):
            model.remember(model.Constants(march=3.0))
    assert model.constants() == model.Constants(march=3.0 if possible else model.Constants().march)
    assert [bool(re.search(reason, text)) for text in warnings] == ([] if possible else [True])
    if cache.parent.is_dir():
        assert {p.name for p in cache.parent.iterdir()} == ({"maps", "cost.json"} if possible else set())


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
                                env=os.environ | {"MI_NTF_MAP_CACHE": "on"} | environment), out

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
    alone, reference = render("reference", MI_NTF_MAP_CACHE="off")
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


# --- files that do not hold what was written -------------------------------------------------------------------------


def as_npy(array):
    def change(file, data):
        with open(file, "wb") as out:
            np.save(out, array)

    return change


def floats(change):
    """Numbers changed behind the seal."""
    def apply(file, data):
        values = np.frombuffer(data, "<f4", offset=map_cache.SEAL).copy()
        change(values)
        file.write_bytes(data[: map_cache.SEAL] + values.tobytes())

    return apply


DAMAGE = {
    "empty": lambda file, data: file.write_bytes(b""),
    "cut": lambda file, data: file.write_bytes(data[:-1]),
    "cut in half": lambda file, data: file.write_bytes(data[: len(data) // 2]),
    "longer": lambda file, data: file.write_bytes(data + b"\0"),
    "zeros of the right length": lambda file, data: file.write_bytes(bytes(len(data))),
    "npy": as_npy(np.ones(3 * SIZE // 4, np.float32)),
    "npy of doubles": as_npy(np.ones(3 * SIZE // 8)),
    "a pickle": lambda file, data: file.write_bytes(b"cos\nabort\n(tR." + data[14:]),
    "NaN": floats(lambda v: v.__setitem__(5, np.nan)),
    "inf": floats(lambda v: v.__setitem__(-1, np.inf)),
    "zeros": floats(lambda v: v.fill(0)),
    "swapped": floats(lambda v: v.__setitem__(slice(None), v[::-1].copy())),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_map_is_made_anew(medium, cache, warnings, damage):
    expected = texels(medium)
    (file,) = cache.iterdir()
    data = file.read_bytes()
    DAMAGE[damage](file, data)
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert file.read_bytes() == data and list(cache.iterdir()) == [file] and not warnings


def test_every_flipped_bit_is_noticed(medium, cache, rng):
    """Of the seal and of the texels; one light's map under another's name as well."""
    texels(medium)
    (file,) = cache.iterdir()
    name, count, data = file.stem, 3 * SIZE // 4, file.read_bytes()
    assert map_cache._read(name, count) is not None
    for place in [*range(map_cache.SEAL), *rng.integers(map_cache.SEAL, len(data), 300)]:
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.integers(8)
        file.write_bytes(flipped)
        assert map_cache._read(name, count) is None, place
    file.write_bytes(data)
    assert map_cache._read(name, count) is not None
    file.rename(file.with_name(f"{'0' * 64}.map"))
    assert map_cache._read("0" * 64, count) is None


def test_something_else_under_a_maps_name(medium, cache, warnings):
    """A folder cannot be replaced, and a pipe would be waited for: a warning, a warning less, and the map."""
    expected = texels(medium)
    (file,) = cache.iterdir()
    file.unlink()
    file.mkdir()
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert len(warnings) == 1 and "Is a directory" in warnings[0]
    file.rmdir()
    os.mkfifo(file)
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert file.is_file() and len(warnings) == 1


def test_numbers_that_are_not_finite_are_never_kept(cache):
    made = SimpleNamespace(values=mi.Float([1.0, np.nan]))
    assert map_cache.cached("0" * 64, lambda values=None: made, 2, 1e9) is made
    assert not cache.exists()


# --- keys ------------------------------------------------------------------------------------------------------------


def test_a_field_trained_over_while_it_is_loaded(tmp_path, cache):
    """The process that holds the old field stores old maps, which the new field must never meet."""
    path = scenes.write_blobs(tmp_path, log_density=3.0)
    old = find_medium(path)
    scenes.write_blobs(tmp_path, log_density=-1.0)  # the same name, size and, within a tick of the clock, time
    before = texels(old)
    map_cache.forget()
    loaded._load.cache_clear()
    new = find_medium(path)
    after = texels(new)
    np.testing.assert_array_equal(before, without_cache(old))
    np.testing.assert_array_equal(after, without_cache(new))
    assert np.abs(before - after).max() > 1
    assert old.field.digest != new.field.digest and len(list(cache.iterdir())) == 2


def test_a_field_written_within_one_tick_of_the_clock_is_read_anew(tmp_path):
    path = scenes.write_blobs(tmp_path, log_density=3.0)
    stat = path.stat()
    old = loaded.load(str(path), 32)
    scenes.write_blobs(tmp_path, log_density=-1.0)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert path.stat().st_size == stat.st_size
    assert loaded.load(str(path), 32).digest != old.digest


def test_the_same_networks_in_another_file_share_maps(path, tmp_path, cache, medium):
    copy = tmp_path / "copy.safetensors"
    copy.write_bytes(path.read_bytes())
    texels(medium)
    map_cache.forget()
    texels(find_medium(copy))
    assert len(list(cache.iterdir())) == 1


def names_of(cache, medium, options=OPTIONS):
    map_cache.forget()
    texels(medium, options=options)
    return {p.name for p in cache.iterdir()}


def test_keys_follow_the_march_and_the_libraries(medium, cache, monkeypatch):
    """What decides texels, or their last bits, decides the name."""
    seen = [names_of(cache, medium)]
    seen.append(names_of(cache, medium, dataclasses.replace(OPTIONS, step=2 / 128)))
    network = dataclasses.replace(OPTIONS, map_source="network")
    seen.append(names_of(cache, medium, network))
    monkeypatch.setattr(profile, "FOR_NETWORKS", 1.25)  # the rule for a march's step, which only this source follows
    seen.append(names_of(cache, medium, network))
    assert names_of(cache, medium) == seen[-1]
    for module in (map_cache.mi, map_cache.dr, map_cache.np):
        with monkeypatch.context() as patch:
            patch.setattr(module, "__version__", "0.0.0")
            seen.append(names_of(cache, medium))
    with monkeypatch.context() as patch:
        compiler = "cuda_version" if VARIANT.startswith("cuda") else "llvm_version"
        patch.setattr(map_cache.dr.detail, compiler, lambda: (1, 2, 3))
        seen.append(names_of(cache, medium))
    assert [len(names) for names in seen] == list(range(1, len(seen) + 1))


# --- memory ----------------------------------------------------------------------------------------------------------


def held():
    return sum(4 * len(m.values) for m in map_cache._maps.values())


def kept(size: int):
    """What stands for a map of `size` bytes."""
    return SimpleNamespace(values=np.zeros(size // 4, np.float32), texels=SimpleNamespace(nbytes=size))


def test_kept_maps_and_the_one_in_the_making_fit_into_map_memory(cache, monkeypatch):
    """Lights that move each frame: a new map each time, in a memory for two and a half."""
    monkeypatch.setenv("MI_NTF_MAP_CACHE", "memory")
    limit, size, most = 2.5 * 1000, 1000, []

    def make(values=None):
        most.append(held() + size)
        return kept(size)

    for k in range(6):
        map_cache.cached(str(k), make, size // 4, limit)
    assert max(most) <= limit and max(most) == 2000 and held() == 2000
    map_cache.cached("larger than all", lambda values=None: kept(2800), 700, limit)
    assert held() == 0, "what exceeds the memory alone is not kept beside"


def test_maps_of_one_run_of_several_are_not_kept(medium, cache):
    whole = table()
    build(medium, whole)
    assert held() == 3 * SIZE
    for k in range(3):
        part = whole.part(k, k + 1)
        first = build(medium, part, dataclasses.replace(OPTIONS, map_memory=SIZE / 2**20))
        assert held() == 0
        assert build(medium, part, OPTIONS) is not first
    assert len(list(cache.iterdir())) == 4, "on disk each run is found again"


@pytest.mark.slow
def test_prices_are_measured_without_a_place_for_them(path, tmp_path, cache, warnings, capfd):
    """`mi-ntf explain --measure` says what it measured, and in one warning that it cannot keep it."""
    (tmp_path / "cache").write_text("a file")
    scene = tmp_path / "scene.xml"
    scene.write_text(SCENE.replace("FIELD", str(path)))
    assert cli.main(["explain", str(scene), "--measure"]) == 0
    assert "measured" in capfd.readouterr().out
    (text,) = warnings
    assert "keeps nothing for later renders" in text

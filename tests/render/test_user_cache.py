"""Arrays that are made from a field once: found again on the disk and in its own file, also where these are damaged."""

import json
import os
import re
import subprocess
import sys
import time

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.variants import VARIANT

from mi_ntf import cli
from mi_ntf.core import field_file, progress
from mi_ntf.infer import bake, bricks
from mi_ntf.render import log, user_cache
from mi_ntf.render.scene import loaded


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    mi.set_variant(VARIANT)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    loaded._load.cache_clear()
    yield tmp_path / "cache" / "mi-ntf"
    loaded._load.cache_clear()


@pytest.fixture
def bakes(monkeypatch):
    """Counts the bakes."""
    seen = []
    original = loaded.bake
    monkeypatch.setattr(loaded, "bake", lambda *args: seen.append(args) or original(*args))
    return seen


@pytest.fixture
def path(tmp_path):
    return scenes.write_blobs(tmp_path, log_density=3.0)


def content(field) -> list[np.ndarray]:
    grid = field.grid
    x = tuple(mi.Float(c) for c in np.random.default_rng(0).uniform(-0.57, 0.57, (3, 5000)).astype(np.float32))
    normal, albedo, *rest = grid.reflectance(x)
    return [np.array(v) for v in (grid.density(x), *normal, *albedo, *rest, field.softness(x))] + [
        grid.hull, np.array([grid.majorant, grid.gloss, field.softness.solid])]


def assert_same(a, b):
    for one, other in zip(content(a), content(b), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_field_is_baked_once(path, bakes, cache):
    """The second load reads what the first kept; another resolution is another entry."""
    first = loaded.load(str(path), 48)
    loaded._load.cache_clear()
    assert_same(loaded.load(str(path), 48), first)
    assert len(bakes) == 1 and len(list((cache / "fields").iterdir())) == 1
    loaded.load(str(path), 64)
    assert len(bakes) == 2 and len(list((cache / "fields").iterdir())) == 2


def test_one_file_is_one_field_however_its_path_is_written(path, bakes):
    """As Mitsuba finds a file that a scene names, and as a program names it."""
    assert loaded.load(f"{path.parent}/./{path.name}", 32) is loaded.load(str(path), 32)
    assert len(bakes) == 1


@pytest.mark.parametrize("damage", ["cut", "flipped", "zeros", "another program's"])
def test_a_damaged_entry_is_made_anew(path, bakes, cache, damage):
    first = loaded.load(str(path), 48)
    (file,) = (cache / "fields").iterdir()
    data = file.read_bytes()
    flipped = bytearray(data)
    flipped[len(data) // 2] ^= 4
    file.write_bytes({"cut": data[:-100], "flipped": bytes(flipped), "zeros": bytes(len(data)),
                      "another program's": b"PK" + data[2:]}[damage])
    loaded._load.cache_clear()
    assert_same(loaded.load(str(path), 48), first)
    assert len(bakes) == 2 and file.read_bytes() == data


def test_a_change_of_the_program_makes_it_anew(path, bakes, monkeypatch):
    loaded.load(str(path), 48)
    loaded._load.cache_clear()
    monkeypatch.setattr(user_cache, "_program", lambda: "another text")
    loaded.load(str(path), 48)
    assert len(bakes) == 2


def test_off(path, bakes, cache, monkeypatch):
    monkeypatch.setenv("MI_NTF_CACHE", "off")
    for _ in range(2):
        loaded._load.cache_clear()
        loaded.load(str(path), 48)
    assert len(bakes) == 2 and not cache.exists()


def test_two_processes_leave_one_good_entry(path, cache):
    """Two processes that load at once get the field, and a third one reads what they left."""
    script = (f"import mitsuba as mi; mi.set_variant({VARIANT!r}); import mi_ntf.render as r; r.register()\n"
              f"from mi_ntf.render.scene import loaded; print(loaded.load({str(path)!r}, 64).grid.majorant)")
    both = [subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) for _ in range(2)]
    texts = {process.communicate()[0] for process in both}
    assert len(texts) == 1 and all(process.returncode == 0 for process in both)
    (file,) = (cache / "fields").iterdir()
    assert user_cache.read("fields", file.stem)["density.resolution"] == [64]


def test_the_oldest_entries_go(cache, monkeypatch):
    monkeypatch.setattr(user_cache, "FOLDER_LIMIT", 3500)
    for k in range(4):
        user_cache.write(user_cache.KINDS[k % 3], str(k), {"values": np.zeros(200, np.float32)})
        os.utime(user_cache._path(user_cache.KINDS[k % 3], str(k)), (1000 + k, 1000 + k))
        if k == 2:
            user_cache.read("fields", "0")  # used just now
    assert {path.stem for _, path, _ in user_cache.entries()} == {"0", "2", "3"}


def test_in_a_film_what_depends_on_places_is_not_written(cache):
    values = {"values": np.zeros(3)}
    with user_cache.film():
        user_cache.write("maps", "moves", values, placed=True)
        user_cache.write("maps", "stays", values)
    user_cache.write("maps", "later", values, placed=True)
    assert {path.stem for _, path, _ in user_cache.entries()} == {"stays", "later"}


def test_command(path, cache, capsys):
    """`mi-ntf cache` counts what there is; --clear removes it."""
    loaded.load(str(path), 48)
    size = sum(file.stat().st_size for file in (cache / "fields").iterdir())
    capsys.readouterr()
    assert cli.main(["cache", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["folder"] == str(cache) and told["fields"] == {"entries": 1, "mib": round(size / 2**20, 1)}
    assert cli.main(["cache", "--clear", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["removed_mib"] == round(size / 2**20, 1) and told["fields"]["entries"] == 0
    assert not list((cache / "fields").iterdir())


# --- voxels in the field file -----------------------------------------------------------------------------------------


def test_baked_into_the_file(path, bakes, cache, capsys):
    """The file's own tensors stay as they are, and loads neither bake nor read the cache."""
    header, tensors = field_file.load(path)
    assert cli.main(["bake", str(path), "--baked", "--json"]) == 0
    voxels = json.loads(capsys.readouterr().out)[str(path)]["voxels"]
    again, others = field_file.load(path)
    assert again == header and set(others) == set(tensors)
    assert all((others[name] == tensors[name]).all() and others[name].dtype == tensors[name].dtype for name in tensors)
    field = loaded.load(str(path), None)
    assert len(bakes) == 1 and not cache.exists() and field.grid.resolution == voxels
    with_cache = loaded.load(str(path), 48)  # another resolution
    assert len(bakes) == 2 and with_cache.grid.resolution == 48
    copy = path.with_name("copy.safetensors")
    field_file.save(copy, header, tensors, np.float32)
    assert_same(loaded.load(str(copy), None), field)


def test_the_fields_of_a_scene_are_baked_as_its_media_ask(path, bakes, cache, tmp_path, capsys):
    def scene(*resolutions):
        media = "".join(f'<medium type="nrf" id="{i}"><string name="filename" value="{path}"/>{r}'
                        f'<transform name="to_world"><translate x="{9 * i}"/></transform></medium>'
                        f'<shape type="sphere"><transform name="to_world"><translate x="{9 * i}"/></transform>'
                        f'<point name="center" value="0.4, -0.2, 0.3"/><float name="radius" value="1.5"/>'
                        f'<bsdf type="null"/><ref name="interior" id="{i}"/></shape>'
                        for i, r in enumerate(resolutions))
        file = tmp_path / "scene.xml"
        file.write_text(f'<scene version="3.0.0"><integrator type="nrf"/>{media}</scene>')
        return str(file)

    coarse = '<integer name="resolution" value="48"/>'
    for own, resolution in (("", None), (coarse, 48)):
        assert cli.main(["bake", scene(own, own), "--baked", "--json"]) == 0
        count = len(bakes)
        loaded._load.cache_clear()
        user_cache.clear()
        loaded.load(str(path), resolution)
        assert len(bakes) == count
    assert cli.main(["bake", scene("", coarse), "--baked"]) == 1
    assert "differ in resolution" in capsys.readouterr().err


@pytest.mark.parametrize("change", ["index", "words", "missing", "hull", "version"])
def test_voxels_in_a_file_that_are_wrong_are_not_used(path, bakes, monkeypatch, change):
    """Crafted ones would be read outside of their memory."""
    truth = loaded.load(str(path), 48)
    field = truth.digest
    arrays = dict(loaded._baked(str(path), truth.header, truth.network, 48, mi))
    if change == "index":
        arrays["density.index"] = arrays["density.index"] | 0xFFFFFF
    elif change == "words":
        arrays["density.words"] = arrays["density.words"][:-1]
    elif change == "missing":
        del arrays["softness.range"]
    elif change == "hull":
        arrays["hull"] = arrays["hull"][:, :2]
    field_file.add_baked(path, arrays, loaded._stamp(field, 48))
    if change == "version":
        monkeypatch.setattr(loaded, "VERSION", bake.VERSION + 1)
    loaded._load.cache_clear()
    assert_same(loaded.load(str(path), 48), truth)


def test_bricks_of_wrong_arrays():
    good = bricks.of_dense(np.ones((20, 20, 20, 1), np.float32), np.ones((20, 20, 20), bool))
    for name, value in {"index": good["index"][:2], "words": good["words"].astype(np.int32),
                        "range": good["range"] * np.nan,
                        "resolution": np.array([40])}.items():
        with pytest.raises(ValueError, match="these are no bricks"):
            bricks.Bricks(good | {name: value}, mi)


# --- what is said -----------------------------------------------------------------------------------------------------


def test_work_is_part_of_a_commands_progress_or_logged_at_level_info(monkeypatch, capsys):
    shown, logged = [], []
    monkeypatch.setattr(log, "info", logged.append)
    monkeypatch.setattr(log, "INTERVAL", 0.1)

    def work():
        with log.Work("nrf medium", "baking a.safetensors") as stage:
            for done in (0.25, 0.5, 0.75):
                stage.update(done)
                time.sleep(0.15)

    work()  # in a script
    with progress.Stage("reading scene.xml", write=shown.append, interval=0.1):
        work()
    assert "reading scene.xml · baking a.safetensors: 50%" in shown and logged == []
    level = mi.log_level()
    mi.set_log_level(mi.LogLevel.Info)
    try:
        work()
    finally:
        mi.set_log_level(level)
    assert "nrf medium: baking a.safetensors: 25%" in logged
    assert re.fullmatch(r"nrf medium: baking a.safetensors \(0\.\d+ s\)", logged[-1])
    assert capsys.readouterr() == ("", "")


def test_a_bake_tells_its_progress():
    told = []
    bake.bake(loaded.NetworkField(*fields.blobs([(0, 0, 0)], [0.4]), mi), 48, mi, told.append)
    assert told == sorted(told) and told[0] == 0 and 0.5 <= told[-1] < 1

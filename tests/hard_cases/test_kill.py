"""Programs killed at any moment, disks that fill up, places that cannot be written to.

Nothing is ever half-written under its final name, nothing temporary is left by an error, and the same command finishes.
"""

import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from helpers import maps, scenes
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf import cli, swap
from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture as capture_module
from mi_ntf.data import schema
from mi_ntf.render.maps import map_file

KILLS = 3
"""Kills of each command, at moments spread over the time that it takes undisturbed."""
OBJECT = """<scene version="3.9.0">
    <shape type="sphere"><point name="center" x="1" y="0" z="0.5"/><float name="radius" value="0.7"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.4, 0.2"/></bsdf></shape>
</scene>"""
LIT = """<scene version="3.9.0">
    <integrator type="nrf"><integer name="map_resolution" value="RESOLUTION"/></integrator>
    <sensor type="perspective"/>
    <emitter type="point"><point name="position" x="3" y="3" z="2.5"/></emitter>
    <emitter type="directional"><vector name="direction" x="-1" y="-1.2" z="-0.6"/></emitter>
    <shape type="sphere"><point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/><medium type="nrf" name="interior"><string name="filename" value="FIELD"/>
        <integer name="resolution" value="48"/></medium></shape>
</scene>"""


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()


@pytest.fixture(scope="module")
def field(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


def lit(folder, field, resolution=16):
    """Return a scene file to bake."""
    path = folder / "lit.xml"
    path.write_text(LIT.replace("FIELD", str(field)).replace("RESOLUTION", str(resolution)))
    return path


def photographed(folder):
    """Return a scene file to photograph."""
    path = folder / "object.xml"
    path.write_text(OBJECT)
    return path


def files_in(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}


def pictures(folder):
    """Name → pixels, of every EXR file by its final name: all are whole."""
    result = {}
    for path in sorted(folder.rglob("*.exr")):
        for k, part in enumerate(OpenEXR.File(str(path), separate_channels=True).parts):
            for name, channel in part.channels.items():
                assert channel.pixels.shape == (part.height(), part.width())
                result[f"{path.relative_to(folder)} {k} {name}"] = channel.pixels.copy()
    return result


def assert_same(result, expected):
    assert result.keys() == expected.keys()
    for name, pixels in expected.items():
        np.testing.assert_array_equal(result[name], pixels, err_msg=name)


# --- every writer, on a disk that fills up ---------------------------------------------------------------------------


def save_field(path, field):
    header, tensors = field_file.load(field)
    return lambda: field_file.save(path, header, tensors)


def save_checkpoint(path, field):
    torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")
    from mi_ntf.train import checkpoint

    return lambda: checkpoint.write(path, {"data": {}}, {"tensors": {"x": torch.zeros(2000)}})


def write_maps(path, field):
    medium = maps.find_medium(field)
    built = maps.build(medium)
    return lambda: map_file.write(path, medium, maps.table(), maps.OPTIONS, [built])


def write_photograph(path, field):
    return lambda: schema.write_exr(path, np.random.default_rng(0).random((64, 64, 4)))


def write_transforms(path, field):
    frames = [schema.Frame(f"{k}.exr", np.eye(4), np.zeros(3), np.ones(3)) for k in range(50)]
    transforms = schema.Transforms(0.6, 8, 8, np.zeros(3), 1.0, frames)
    return lambda: schema.write_transforms(path.parent, "train", transforms)


def write_manifest(path, field):
    return lambda: capture_module._open_manifest(path.parent, {"a": "b" * 5000}, {})


def write_scene(path, field):
    scene = photographed(path.parents[1])
    return lambda: swap.swap(scene, field, path)


WRITERS = {"f.safetensors": save_field, "f.ckpt": save_checkpoint, "maps.exr": write_maps, "0.exr": write_photograph,
           "transforms_train.json": write_transforms, "capture.json": write_manifest, "nrf.xml": write_scene}


@pytest.mark.parametrize("room", [0, 300])
@pytest.mark.parametrize("name", WRITERS)
def test_a_full_disk_is_one_sentence(field, tmp_path, name, room):
    """The system refuses every byte after `room`. What was there stays."""
    path = tmp_path / "out" / name
    path.parent.mkdir()
    write = WRITERS[name](path, field)
    if name != "capture.json":  # which is read first
        path.write_text("before")
    before = files_in(path.parent)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(MiNtfError, match=r"cannot write .*; free space there or choose another place") as caught:
            write()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert "too large" in str(caught.value) and str(path) in str(caught.value) and "\n" not in str(caught.value)
    assert files_in(path.parent) == before
    assert all((path.parent / n).read_text() == "before" for n in before)
    write()
    assert files_in(path.parent) == {name} and path.stat().st_size > 300


@pytest.mark.parametrize("command", ["capture", "bake", "swap", "train"])
def test_a_place_that_cannot_be_written_to_is_one_sentence(field, tmp_path, capfd, command):
    """Said before the work is done, not after it."""
    (tmp_path / "file").write_text("")
    obstacle = tmp_path / "file" / "out"
    words = {"capture": ["capture", photographed(tmp_path), obstacle],
             "bake": ["bake", lit(tmp_path, field), "-o", obstacle.with_suffix(".exr")],
             "swap": ["swap", photographed(tmp_path), field, "-o", obstacle.with_suffix(".xml")],
             "train": ["train", tmp_path / "no data are read", "-o", obstacle.with_suffix(".safetensors")]}[command]
    if command == "train":
        pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")
    assert cli.main([str(w) for w in words]) == 1
    line = capfd.readouterr().err.strip().splitlines()[-1]
    assert line.startswith("mi-ntf: error: cannot ") and str(tmp_path / "file") in line
    assert files_in(tmp_path) <= {"file", "object.xml", "lit.xml"}


# --- kill -9 ---------------------------------------------------------------------------------------------------------


SUICIDE = """import os, signal, sys
place, times = sys.argv.pop(1), int(sys.argv.pop(1))
real = getattr(os, place)

def last(*arguments):
    global times
    times -= 1
    if not times:
        os.kill(os.getpid(), signal.SIGKILL)
    return real(*arguments)

setattr(os, place, last)
from mi_ntf.cli import main
sys.exit(main(sys.argv[1:]))
"""
"""Runs a command and dies as it calls os.PLACE for the n-th time."""


def start(*words, program=("-m", "mi_ntf")):
    return subprocess.Popen([sys.executable, *map(str, (*program, *words))], stdout=subprocess.PIPE,
                            stderr=subprocess.STDOUT, text=True, env=os.environ | {"MI_NTF_CACHE": "off"})


def finish(process, code=0):
    text, _ = process.communicate(timeout=500)
    assert process.returncode == code, text
    return text


def kill_at_random(words, check, seed, program=("-m", "mi_ntf")):
    """Kill the first of two commands KILLS times, with ``check()`` after each, and let it finish in the end.

    The second command runs whole, before. The moments are random within its time, so that they fall into imports, work
    and writing.
    """
    begin = time.monotonic()
    finish(start(*words[1], program=program))
    span, killed, rng = time.monotonic() - begin, 0, np.random.default_rng(seed)
    for _ in range(4 * KILLS):
        process = start(*words[0], program=program)
        try:
            process.communicate(timeout=rng.uniform(0.3, 1.0) * span)
            span *= 0.7  # it was done sooner: less is compiled, or done, than at first
        except subprocess.TimeoutExpired:
            process.send_signal(signal.SIGKILL)
            process.communicate()
            killed += 1
        check()
        if killed == KILLS:
            break
    assert killed
    finish(start(*words[0], program=program))


CAPTURE = ["--views", "4", "--test-views", "2", "--size", "24", "--spp", "8"]


def test_killed_between_writing_and_naming(field, tmp_path):
    """The worst moment of every writer: the temporary file is whole, the final one not yet there."""
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    for folder in (undisturbed, out):
        folder.mkdir()
    scene, baked = photographed(tmp_path), lit(tmp_path, field)
    assert cli.main(["capture", str(scene), str(undisturbed), *CAPTURE]) == 0
    assert cli.main(["bake", str(baked), "-o", str(undisturbed / "maps.exr")]) == 0
    dying = [start("replace", "4", "capture", scene, out, *CAPTURE, program=("-c", SUICIDE)),
             start("fsync", "1", "bake", baked, "-o", out / "maps.exr", program=("-c", SUICIDE))]
    for process in dying:
        finish(process, -signal.SIGKILL)
    remaining = files_in(out)
    assert {n for n in remaining if not n.endswith(".part")} == {"capture.json", "train/0000.exr", "train/0001.exr"}
    assert sorted(n.split(".")[0] for n in remaining if n.endswith(".part")) == ["maps", "train/0002"]
    assert cli.main(["capture", str(scene), str(out), *CAPTURE]) == 0
    assert cli.main(["bake", str(baked), "-o", str(out / "maps.exr")]) == 0
    assert files_in(out) == files_in(undisturbed), "leftovers of the killed are gone"
    assert_same(pictures(out), pictures(undisturbed))


@pytest.mark.slow
def test_capture_killed_at_random(tmp_path):
    undisturbed, out, scene = tmp_path / "undisturbed", tmp_path / "out", photographed(tmp_path)

    def whole():
        if out.exists():
            pictures(out)

    command = [["capture", scene, folder, *CAPTURE[:-1], "256"] for folder in (out, undisturbed)]
    kill_at_random(command, whole, 1)
    assert files_in(out) == files_in(undisturbed)
    assert_same(pictures(out), pictures(undisturbed))
    for path in undisturbed.glob("*.json"):
        assert (out / path.name).read_bytes() == path.read_bytes()


@pytest.mark.slow
def test_bake_killed_at_random(field, tmp_path):
    undisturbed, out, scene = tmp_path / "undisturbed", tmp_path / "out", lit(tmp_path, field, resolution=1024)
    for folder in (undisturbed, out):
        folder.mkdir()
    kill_at_random([["bake", scene, "-o", folder / "maps.exr", "--overwrite"] for folder in (out, undisturbed)],
                   lambda: pictures(out), 2)
    assert files_in(out) == {"maps.exr"}
    assert_same(pictures(out), pictures(undisturbed))


@pytest.mark.slow
def test_training_killed_at_random_ends_where_an_undisturbed_run_ends(tmp_path):
    """Bit for bit, as runs given in steps promise."""
    pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")
    from train import two_spheres

    data = two_spheres.write(tmp_path / "data", {"train": 6, "val": 1, "test": 1}, size=16)
    undisturbed, out = tmp_path / "undisturbed", tmp_path / "out"
    for folder in (undisturbed, out):
        folder.mkdir()
    program = Path(__file__).parents[1] / "train" / "program.py"

    def whole():
        if (out / "f").exists():
            field_file.load(out / "f")

    kill_at_random([[data, folder / "f", 40] for folder in (out, undisturbed)], whole, 3, (program,))
    assert files_in(out) == files_in(undisturbed) == {"f", "f.npz", "f.json"}
    with np.load(out / "f.npz") as result, np.load(undisturbed / "f.npz") as expected:
        for name in expected:
            assert result[name].tobytes() == expected[name].tobytes(), name


# --- a real disk that is full ----------------------------------------------------------------------------------------


@pytest.fixture
def disk(tmp_path):
    """``(folder, resize)``: a small disk of its own; ``resize(KiB)``."""
    folder = tmp_path / "disk"
    folder.mkdir()
    done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"a disk cannot be mounted here: {done.stderr.strip()}")
    yield folder, lambda size: subprocess.run(["mount", "-o", f"remount,size={size}k", folder], check=True)
    subprocess.run(["umount", folder], check=True)


def refused(words):
    """Return the one sentence of a command that fails."""
    text = finish(start(*words), 1)
    errors = [line for line in text.splitlines() if line.startswith("mi-ntf: error:")]
    assert len(errors) == 1 and "No space left on device" in errors[0] and "Traceback" not in text, text
    return errors[0]


@pytest.mark.slow
@pytest.mark.parametrize("command", ["capture", "bake", "train"])
def test_a_command_on_a_full_disk(field, tmp_path, disk, command):
    """A command on a full disk names the file, leaves no half one, and succeeds once there is room."""
    folder, resize = disk
    if command == "train":
        pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")
        from train import two_spheres

        data = two_spheres.write(tmp_path / "data", {"train": 4, "val": 1, "test": 1}, size=16)
    words, least = {
        "capture": lambda: (["capture", photographed(tmp_path), folder / "set", "--views", "8", "--test-views", "2",
                             "--size", "64", "--spp", "2"], 1),
        "bake": lambda: (["bake", lit(tmp_path, field, 256), "-o", folder / "maps.exr"], 0),
        "train": lambda: (["train", data, "-o", folder / "f.safetensors", "--steps", "3"], 0)}[command]()
    assert str(folder) in refused(words)
    assert not [n for n in files_in(folder) if n.endswith(".part")] and len(files_in(folder)) >= least
    pictures(folder)
    resize(64 << 10)
    finish(start(*words))
    expected = {"capture": 14 + 3 + 1, "bake": 1, "train": 1}[command]
    assert len(files_in(folder)) == expected

"""Frames in files: their pixels, resuming, checking, shards."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ntf import cli, launcher
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.compare import read_image
from mi_ntf.render.maps import map_cache
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.sequence import changes, command, image_file, work
from mi_ntf.sequence.timeline import Frame

CIRCLE = """frames = 4
[lights.lamp]
position = { start = [3, 3, 2.5], centre = [0.4, 0, 0.3], degrees = { keys = [[0, 0], [4, 120]] } }
"""


@pytest.fixture
def circle(tmp_path):
    path = tmp_path / "circle.toml"
    path.write_text(CIRCLE)
    return path


def tasks(scene, folder, frames):
    return command.tasks_of(scene, folder, frames)


def pixels(path):
    channels, _ = image_file.read(path)
    return np.stack([channels[c] for c in "RGBA"], -1)


def contents(folder: Path) -> dict:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_a_frame_is_what_the_stock_renderer_makes_of_these_values(scene, tmp_path):
    path = scene()
    frame = Frame(0, {"spp": "3", "visibility": "transmittance_map"}, {"origin": [0, 1, 6.5], "target": [0.4, 0, 0],
                  "up": [0, 1, 0], "fov": 35.0}, {"lamp": {"position": [-2.0, 2.5, 4.0]}})
    work.render(tasks(path, tmp_path / "out", [frame])[0])
    text = path.read_text()
    for before, after in (('x="3" y="3" z="2.5"', 'x="-2" y="2.5" z="4"'), ('value="40"/>', 'value="35"/>'),
                          ("2, 1.5, 6", "0, 1, 6.5"), ('target="0.4, -0.2, 0.3"', 'target="0.4, 0, 0"')):
        assert text.count(before) == 1
        text = text.replace(before, after)
    path.write_text(text)
    launcher.render_file(path, frame.parameters, output=tmp_path / "alone.exr")
    alone = read_image(tmp_path / "alone.exr")
    assert alone[..., :3].max() > 0.05
    np.testing.assert_allclose(pixels(tmp_path / "out/frame_0000.exr"), alone, atol=1e-5)  # lookat in two precisions


def test_an_environment_turns_as_its_to_world_does(scene, tmp_path):
    sky = np.zeros((8, 16, 3), np.float32)
    sky[2, 3] = 40
    mi.Bitmap(sky).write(str(tmp_path / "sky.exr"))
    path = scene('<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>')
    frames = [Frame(i, environment={"degrees": angle}) for i, angle in enumerate((0.0, 90.0, 360.0))]
    for task in tasks(path, tmp_path / "out", frames):
        work.render(task)
    still, turned, around = (pixels(tmp_path / f"out/frame_000{i}.exr") for i in range(3))
    np.testing.assert_allclose(around, still, atol=1e-4)
    words = ("sequence", path, "-o", tmp_path / "laid", "--env-rotate", "90", "--env-scale", "2", "-m", mi.variant())
    assert cli.main([str(word) for word in words]) == 0
    laid = pixels(tmp_path / "laid/frame_0000.exr")
    np.testing.assert_allclose(laid[..., :3], 2 * turned[..., :3], atol=1e-4 * laid.max())  # turned in two precisions
    assert np.abs(turned - still).max() > 0.05
    path.write_text(path.read_text().replace('value="sky.exr"/>', 'value="sky.exr"/><transform name="to_world">'
                                             '<rotate y="1" angle="90"/></transform>'))
    launcher.render_file(path, {}, output=tmp_path / "alone.exr")
    np.testing.assert_allclose(turned, read_image(tmp_path / "alone.exr"), atol=1e-5)


def test_the_command_renders_goes_on_and_checks(scene, circle, tmp_path, capsys):
    path, out = scene(), tmp_path / "out"
    words = ["sequence", str(path), "-o", str(out), "--timeline", str(circle), "-D", "spp=1", "--json"]
    assert cli.main(words) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rendered"] == 4 and report["kept"] == 0
    whole = contents(out)
    assert list(whole) == [f"frame_000{i}.exr" for i in range(4)]
    assert len({pixels(out / name).tobytes() for name in whole}) == 4
    assert cli.main([*words, "--check"]) == 0

    (out / "frame_0000.exr").unlink()
    data = bytearray(whole["frame_0001.exr"])
    data[-100] ^= 64  # of the pixels
    (out / "frame_0001.exr").write_bytes(data)
    (out / "frame_0002.exr").write_bytes(whole["frame_0002.exr"][:-9])
    (out / "frame_0003.exr").write_bytes(whole["frame_0000.exr"])
    capsys.readouterr()
    assert cli.main([*words, "--check"]) == 1
    printed = capsys.readouterr()
    result = json.loads(printed.out)
    assert result["done"] == 0
    assert [len(result[kind]) for kind in ("missing", "broken", "other")] == [1, 2, 1]
    for i in range(4):
        assert f"frame_000{i}.exr" in printed.err
    assert '"position": [3.0, 3.0, 2.5]' in result["other"][0]

    assert cli.main(words) == 0 and contents(out) == whole
    (out / "frame_0000.exr").unlink()
    capsys.readouterr()
    assert cli.main(words[:-1]) == 0
    printed = capsys.readouterr()
    assert "goes on: 3 of 4 frames are there\nframes: 3 of 4\n" in printed.err
    assert printed.out.splitlines()[0] == f"frames: {out} (4, 3 of them from an earlier run)"
    assert printed.out.splitlines()[-1] == "next: the same command with --film FILM.mp4 makes a film of them"
    assert cli.main([*words[:-3], "-D", "spp=2", "--json"]) == 0  # other parameters: all are made anew
    assert contents(out) != whole


def test_a_changed_field_makes_frames_old(scene, tmp_path, field):
    path = scene()
    copy = tmp_path / "own.safetensors"
    copy.write_bytes(field.read_bytes())
    path.write_text(path.read_text().replace(str(field), "own.safetensors"))
    (task,) = tasks(path, tmp_path / "out", [Frame(0)])
    before = work.key(task)
    assert work.key(task) == before
    data = bytearray(copy.read_bytes())
    data[-1] ^= 1
    copy.write_bytes(data)
    assert work.key(task) != before


def test_shards_make_all_frames_once(scene, circle, tmp_path, capsys):
    path = scene()
    words = ["sequence", str(path), "--timeline", str(circle), "-D", "spp=1", "--json"]
    assert cli.main([*words, "-o", str(tmp_path / "whole")]) == 0
    for i in (1, 2, 3):
        assert cli.main([*words, "-o", str(tmp_path / "parts"), "--shard", f"{i}/3"]) == 0
    text = capsys.readouterr().out
    assert [json.loads(part + "}")["rendered"] for part in text.split("\n}\n")[:-1]] == [4, 2, 1, 1]
    assert contents(tmp_path / "parts") == contents(tmp_path / "whole")


@pytest.mark.parametrize(("words", "says"), [
    (["--shard", "0/3"], "--shard is 0/3, expected i/n with i from 1 to n"),
    (["--shard", "half"], "--shard is half"),
    (["--timeline", "a", "--parameters", "b"], "not both"),
    (["--shard", "1/2", "--film", "x.mp4"], "--film shows all frames"),
])
def test_bad_usage(words, says, capsys):
    assert cli.main(["sequence", "scene.xml", "-o", "out", *words]) == 2
    assert says in capsys.readouterr().err


@pytest.mark.parametrize(("frame", "says"), [
    (Frame(3, {"nothing": "1"}), "(?s)frame 3: .*nothing"),
    (Frame(0, lights={"sun": {"position": [0, 0, 0]}}), "lights.sun: the scene has 0 emitters .* it has lamp"),
    (Frame(0, lights={"lamp": {"position": [0, 0, 0], "target": [1, 0, 0]}}), "a point light shines everywhere"),
    (Frame(0, environment={"degrees": 1.0}), "the scene has 0 of them"),
    (Frame(0, camera={"origin": [0, 1, 0], "target": [0, 0, 0]}), "there is no upright view"),
    (Frame(0, camera={"fov": 180.0}), "camera.fov is 180"),
    (Frame(0, {"visibility": "magic"}), "magic"),
])
def test_what_the_scene_lacks_is_one_clear_error(scene, tmp_path, frame, says):
    with pytest.raises(MiNtfError, match=says):
        work.render(tasks(scene(), tmp_path / "out", [frame])[0])
    assert not list(tmp_path.glob("out/*"))


LIGHTS = """<emitter type="constant"><rgb name="radiance" value="0.1"/></emitter>
    <emitter type="point" id="lamp"><point name="position" x="3" y="3" z="2.5"/>
        <rgb name="intensity" value="60, 50, 40"/></emitter>
    <emitter type="point" id="other"><point name="position" x="-3" y="2" z="3"/>
        <rgb name="intensity" value="9, 30, 50"/></emitter>
    <emitter type="directional"><vector name="direction" x="0" y="-1" z="-0.6"/></emitter>"""


@pytest.fixture
def kept_maps(monkeypatch):
    monkeypatch.setenv("MI_NTF_CACHE", "memory")
    map_cache.forget()
    yield
    map_cache.forget()


def test_nothing_is_compiled_and_nothing_piles_up_after_the_second_frame(scene, tmp_path, kept_maps):
    """The scene has radiosity between patches and maps; camera and light move."""
    frames = [Frame(i, {"visibility": "transmittance_map", "depth": "4"},
                    {"origin": [2 + 0.1 * i, 1.5, 6], "target": [0.4, -0.2, 0.3]},
                    {"lamp": {"position": [3 - 0.2 * i, 3, 2.5]}}) for i in range(5)]
    line = tasks(scene(), tmp_path / "out", frames)
    work._last_frame.clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        for task in line[:3]:
            work.render(task)
        patches, _ = work._last_frame["patches"], dr.kernel_history()
        for task in line[3:]:
            work.render(task)
        new = [k for k in dr.kernel_history() if "cache_hit" in k and not k["cache_hit"]]
    assert new == []
    assert work._last_frame["patches"] is patches
    assert len(map_cache._maps) == 1


def test_of_several_lights_those_that_moved_get_maps_anew(scene, tmp_path, kept_maps, monkeypatch):
    """The pictures are those of maps that are all made at once, bit by bit."""
    made_rows = []
    joined = map_cache._joined

    def counting(each, some, count):
        return joined(each, lambda rows: made_rows.append(rows.tolist()) or some(rows), count)

    monkeypatch.setattr(map_cache, "_joined", counting)
    values = {"visibility": "transmittance_map", "spp": "4"}
    frames = [Frame(i, values, lights={"other": {"position": [-3 + i, 2, 3]}}) for i in range(2)]
    line = tasks(scene(LIGHTS), tmp_path / "out", frames)
    for task in line:
        work.render(task)
    assert made_rows == [[512 + 1]]  # after the constant light's, and the lamp
    first = contents(tmp_path / "out")
    map_cache.forget()
    work.render(line[1])
    assert made_rows == [[512 + 1]] and contents(tmp_path / "out") == first


def test_killed_three_times_it_ends_as_if_undisturbed(scene, circle, tmp_path):
    """The process gets kill -9 at moments spread over the run."""
    path = scene()
    program = [str(Path(sys.executable).parent / "mi-ntf"), "sequence", str(path), "--timeline", str(circle), "-D",
               "visibility=transmittance_map", "-o"]
    begin = time.monotonic()
    subprocess.run([*program, "whole"], cwd=tmp_path, check=True, capture_output=True)
    whole = time.monotonic() - begin
    for part in (0.5, 0.75, 0.9):
        process = subprocess.Popen([*program, "killed"], cwd=tmp_path, stdout=subprocess.DEVNULL,
                                   stderr=subprocess.DEVNULL, env={**os.environ})
        time.sleep(part * whole)
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run([*program, "killed"], cwd=tmp_path, check=True, capture_output=True)
    assert contents(tmp_path / "killed") == contents(tmp_path / "whole")


@pytest.mark.parametrize("kind", ["sunsky", "timed_sunsky"])
def test_the_sun_turns_with_its_sky(kind):
    emitter = mi.Properties(kind)
    emitter["sun_direction"] = [1.0, 0.0, 0.5]
    changes._turn_environment([emitter], {"axis": [0.0, 0.0, 1.0], "degrees": 90.0})
    np.testing.assert_allclose(np.array(emitter["sun_direction"]).ravel(), [0, 1, 0.5], atol=1e-6)


def test_an_angle_of_view_replaces_a_focal_length():
    sensor = mi.Properties("perspective")
    sensor["focal_length"] = "50mm"
    changes._place_camera([sensor], {"fov": 30.0})
    assert sensor["fov"] == 30.0 and "focal_length" not in sensor


def test_workers_find_an_environment_in_any_folder(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mi.Bitmap(np.ones((2, 4, 3), np.float32)).write("e.exr")
    (task,) = command.tasks_of(scene(), tmp_path / "out", [Frame(0)], environment=Environment(Path("e.exr")))
    assert task.environment.file == tmp_path / "e.exr"

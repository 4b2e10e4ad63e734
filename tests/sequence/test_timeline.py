"""Timelines and tables, by value."""

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.sequence import curves, parameters, timeline


def curve(keys, interpolation, at):
    track = curves.track({"keys": keys, "interpolation": interpolation}, 1, "x")
    return [float(track.at(f)[0]) for f in at]


def test_linear_and_step_keys():
    keys = [[0, 1.0], [4, 3.0], [6, -1.0]]
    assert curve(keys, "linear", [-5, 0, 1, 4, 5, 6, 99]) == [1, 1, 1.5, 3, 1, -1, -1]
    assert curve(keys, "step", [-5, 0, 3.9, 4, 5, 6, 99]) == [1, 1, 1, 3, 3, -1, -1]


def test_catmull_rom_repeats_every_parabola():
    """Three keys determine a parabola. Hermite's cubic with its slopes is the parabola itself."""
    def parabola(x):
        return 2 - 3 * x + 0.5 * x * x
    at = np.linspace(0, 7, 15)
    values = curve([[x, parabola(x)] for x in (0.0, 2.0, 7.0)], "catmull-rom", at)
    np.testing.assert_allclose(values, parabola(at), atol=1e-12)


def test_monotone_agrees_with_scipys_pchip_and_never_leaves_its_keys():
    interpolate = pytest.importorskip("scipy.interpolate")
    frames, values = [0, 3, 4, 9, 12, 13], [0.0, 5.0, 5.2, 1.0, 1.0, 4.0]
    at = np.linspace(0, 13, 131)
    curve_values = np.array(curve([list(k) for k in zip(frames, values, strict=True)], "monotone", at))
    np.testing.assert_allclose(curve_values, interpolate.PchipInterpolator(frames, values)(at), atol=1e-12)
    assert curve_values.min() == 0 and curve_values.max() == pytest.approx(5.2, abs=1e-12)


def test_smooth_is_monotone_for_numbers_and_catmull_rom_for_positions():
    keys = [[0, 0.0], [2, 1.0], [5, 1.5], [6, 0.0]]
    at = [1, 3, 4.5, 5.5]
    assert curve(keys, "smooth", at) == curve(keys, "monotone", at)
    rows = curves.track({"keys": [[f, [v, 2 * v, 0]] for f, v in keys]}, 3, "p")
    np.testing.assert_allclose([rows.at(f)[:2] for f in at],
                               [[v, 2 * v] for v in curve(keys, "catmull-rom", at)], atol=1e-14)


def test_a_circle_about_an_axis():
    track = curves.track({"start": [3, 5, 1], "centre": [1, 0, 1], "degrees": {"keys": [[0, 0], [4, 360]],
                                                                                 "interpolation": "linear"}}, 3, "p")
    np.testing.assert_allclose([track.at(f) for f in range(5)],
                               [[3, 5, 1], [1, 5, -1], [-1, 5, 1], [1, 5, 3], [3, 5, 1]], atol=1e-12)


TEXT = """
frames = 3
fps = 12.5
[parameters]
visibility = "raymarch"
spp = 4
power = { keys = [[0, 1.0], [2, 2.0]], interpolation = "linear" }
light = { keys = [[0, "point"], [2, "env"]] }
size = { keys = [[0, 8], [1, 16]], interpolation = "step" }
[camera]
origin = { keys = [[0, [0, 0, 4]], [2, [2, 0, 4]]], interpolation = "linear" }
target = [0, 0, 0]
[lights.lamp]
position = [1, 2, 3]
[environment]
degrees = { keys = [[0, 0], [2, 90]], interpolation = "linear" }
"""


def test_what_a_timeline_says_of_its_frames(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text(TEXT)
    line = timeline.read(path, {"spp": "16"})
    assert line.fps == 12.5 and [f.number for f in line.frames] == [0, 1, 2]
    assert line.frames[1].parameters == {"visibility": "raymarch", "spp": "16", "power": "1.5", "light": "point",
                                         "size": "16"}
    assert line.frames[2].parameters["light"] == "env"
    assert line.frames[1].camera == {"origin": [1, 0, 4], "target": [0, 0, 0]}
    assert line.frames[1].lights == {"lamp": {"position": [1, 2, 3]}}
    assert line.frames[1].environment == {"degrees": 45}
    assert set(line.frames[0].values()) == {"parameters", "camera", "lights", "environment"}


@pytest.mark.parametrize(("text", "says"), [
    ("frames = 0", "frames is 0, expected a whole number from 1"),
    ("", "frames is None"),
    ("frames = 2\nspeed = 1", "unknown key 'speed', expected frames, fps"),
    ("frames = 2\nfps = true", "fps is True"),
    ("frames = 2\n[parameters]\na = [1, 2]", r"parameters.a is \[1, 2\], expected a number"),
    ("frames = 2\n[parameters]\na = { keys = [[1, 1], [0, 2]] }", r"frames \[1.0, 0.0\], which must increase"),
    ("frames = 2\n[parameters]\na = { keys = [] }", r"parameters.a: keys is \[\]"),
    ("frames = 2\n[parameters]\na = { keys = [[0, 1]], interpolation = 'cubic' }", "interpolation is 'cubic'"),
    ("frames = 2\n[parameters]\na = { keys = [[0, 'x'], [1, 'y']], interpolation = 'linear' }", "texts cannot be"),
    ("frames = 2\n[parameters]\na = { keys = [[0, 'x'], 5] }", r"parameters.a: keys is \[\[0, 'x'\], 5\]"),
    ("frames = 2\n[lights.a]\nposition = { start = { keys = [[0, [1, 0, 0]]] }, centre = [0, 0, 0], degrees = "
     "{ keys = [[0, 0], [1, 9]] } }", r"start is .*, expected \[x, y, z\]; degrees alone can have keys"),
    ("frames = 2\n[camera]\norigin = [0, 0, 1]", "camera needs both origin and target"),
    ("frames = 2\n[lights.a]\nposition = [0, 0]", r"lights.a.position is \[0, 0\], expected \[x, y, z\]"),
    ("frames = 2\n[lights.a]\nposition = [0, 0, nan]", "expected"),
    ("frames = 2\nlights = 3", "lights is 3, expected a table"),
    ("frames = 2\n[environment]\naxis = [0, 1, 0]", "environment needs degrees"),
    ("frames = ", "is no TOML file"),
])
def test_a_wrong_timeline_is_one_clear_error(tmp_path, text, says):
    path = tmp_path / "t.toml"
    path.write_text(text)
    with pytest.raises(MiNtfError, match=says) as error:
        timeline.read(path)
    assert str(path) in str(error.value)


def test_a_table_of_parameters(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("spp, visibility\n1,raymarch\n\n4,\n")
    first, second = parameters.read(path, {"res": "8"}).frames
    assert first.parameters == {"spp": "1", "visibility": "raymarch", "res": "8"} and first.number == 0
    assert second.parameters == {"spp": "4", "res": "8"} and second.number == 1


@pytest.mark.parametrize(("text", "says"), [
    ("spp\n", "has 1 lines that are not empty"),
    ("spp,spp\n1,2\n", "the name 'spp'"),
    ("$spp\n1\n", r"the name '\$spp'"),
    ("a,b\n1,2\n3\n", "line 3: 1 values for 2 names"),
])
def test_a_wrong_table_is_one_clear_error(tmp_path, text, says):
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(MiNtfError, match=says):
        parameters.read(path)
    with pytest.raises(MiNtfError, match="cannot be read"):
        parameters.read(tmp_path / "none.csv")


def test_a_line_of_empty_cells_is_a_frame_of_defaults(tmp_path):
    path = tmp_path / "p.csv"
    path.write_text("spp,res\n1,8\n,\n\n2,8\n")
    assert [frame.parameters for frame in parameters.read(path).frames] == [
        {"spp": "1", "res": "8"}, {}, {"spp": "2", "res": "8"}]

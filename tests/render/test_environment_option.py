"""``--env FILE --env-rotate DEG --env-scale S``, by the radiance from each direction, for emitters anywhere."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.programs import run_program
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import load_scene
from mi_ntf.render.lights.environment import radiance
from mi_ntf.render.scene import scene_file
from mi_ntf.render.scene.environment_option import Environment, turned

SCENE = """
<scene version="3.9.0">
  <integrator type="{integrator}"/>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  {light}
  <shape type="sphere">{inside}</shape>
</scene>
"""
UP_Z = '<transform name="to_world"><rotate x="1" angle="90"/></transform>'
TILTED = '<transform name="to_world"><rotate z="1" angle="20"/><rotate x="1" angle="35"/></transform>'
SUN = '<vector name="sun_direction" value="0.5, 0.3, 0.6"/>'
LIGHTS = {
    "map": ('<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>', "y"),
    "z up": (f'<emitter type="envmap"><string name="filename" value="sky.exr"/>{UP_Z}'
             '<float name="scale" value="3"/></emitter>', "z"),
    "tilted": (f'<emitter type="envmap"><string name="filename" value="sky.exr"/>{TILTED}</emitter>', "y"),
    "sunsky": (f'<emitter type="sunsky">{SUN}<float name="sky_scale" value="0.5"/></emitter>', "z"),
    "constant": ('<emitter type="constant"><rgb name="radiance" value="0.1, 0.2, 0.4"/></emitter>', "y"),
    "even": ('<emitter type="constant"><spectrum name="radiance" value="0.3"/></emitter>', "y"),
    "white": ('<emitter type="constant"/>', "y"),
}


def sky(path: Path, seed: int) -> None:
    pixels = np.random.default_rng(seed).random((8, 16, 3)).astype(np.float32)
    mi.Bitmap(pixels).write(str(path))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    sky(tmp_path / "sky.exr", 1)
    sky(tmp_path / "other.exr", 2)
    return tmp_path


def write(folder: Path, light: str, integrator="path", inside="", name="scene.xml") -> Path:
    path = folder / name
    path.write_text(SCENE.format(light=light, integrator=integrator, inside=inside))
    return path


def seen(path: Path, directions: np.ndarray, environment: Environment | None = None) -> np.ndarray:
    """Return the radiance (n, 3) from `directions` (n, 3)."""
    [emitter] = scene_file.load(path, {}, environment).emitters()
    return radiance(emitter, directions)


def about(axis: str, degrees: float, d: np.ndarray) -> np.ndarray:
    """Return `d` (n, 3) rotated counter-clockwise, seen from the tip of the axis."""
    i = "xyz".index(axis)
    j, k = (i + 1) % 3, (i + 2) % 3
    angle, result = np.radians(degrees), d.copy()
    result[:, j] = np.cos(angle) * d[:, j] - np.sin(angle) * d[:, k]
    result[:, k] = np.sin(angle) * d[:, j] + np.cos(angle) * d[:, k]
    return result


@pytest.fixture
def directions(rng) -> np.ndarray:
    d = rng.normal(size=(400, 3))
    return d / np.linalg.norm(d, axis=1, keepdims=True)


@pytest.mark.parametrize("kind", LIGHTS)
def test_what_shone_from_a_direction_shines_from_the_turned_one_and_scaled(folder, directions, kind):
    light, up = LIGHTS[kind]
    path = write(folder, light)
    before = seen(path, directions)
    after = seen(path, about(up, 70, directions), Environment(None, 70, 2.5))
    # float32 directions, texels' slopes; CUDA's texture units step by 1/256 between texels
    step = 2.5 / 256 if VARIANT.startswith("cuda") else 1e-4
    np.testing.assert_allclose(after, 2.5 * before, rtol=2e-3, atol=step)
    assert before.max() > 0.05


@pytest.mark.parametrize("kind", sorted(set(LIGHTS) - {"sunsky"}))
def test_a_file_takes_the_place_and_keeps_placement_and_scale(folder, directions, kind):
    light, _ = LIGHTS[kind]
    properties = "".join(part for part in (UP_Z, TILTED, '<float name="scale" value="3"/>') if part in light)
    by_hand = f'<emitter type="envmap"><string name="filename" value="other.exr"/>{properties}</emitter>'
    expected = seen(write(folder, by_hand, name="hand.xml"), directions)
    result = seen(write(folder, light), directions, Environment(folder / "other.exr"))
    np.testing.assert_allclose(result, expected, rtol=1e-3, atol=1e-4)


def test_in_place_of_a_sky_a_map_stands_upright(folder, directions):
    rows = np.linspace(1, 0, 8, dtype=np.float32)  # bright above, alike all around
    mi.Bitmap(np.tile(rows[:, None, None], (1, 16, 3))).write(str(folder / "rows.exr"))
    result = seen(write(folder, LIGHTS["sunsky"][0]), directions, Environment(folder / "rows.exr"))
    expected = 1 - np.arccos(np.clip(directions[:, 2], -1, 1)) / np.pi
    np.testing.assert_allclose(result, np.tile(expected[:, None], 3), atol=1e-3)


def test_a_scene_without_gets_one_beside_its_lights(folder, directions):
    path = write(folder, '<emitter type="point"><point name="position" value="1,2,3"/></emitter>')
    scene = scene_file.load(path, {}, Environment(folder / "other.exr", 30))
    assert sorted(e.class_name() for e in scene.emitters()) == ["EnvironmentMapEmitter", "PointLight"]
    bare = write(folder, '<emitter type="envmap"><string name="filename" value="other.exr"/></emitter>', name="b.xml")
    np.testing.assert_allclose(radiance(scene.environment(), about("y", 30, directions)), seen(bare, directions),
                               rtol=1e-3, atol=1e-4)


def test_also_inside_of_an_ntf_emitter(folder, blobs, directions):
    medium = f'<medium type="nrf" name="{{}}"><string name="filename" value="{blobs}"/>'
    medium += '<integer name="resolution" value="16"/></medium>'
    none = '<string name="visibility" value="none"/>'
    light = f'<emitter type="ntf">{none}{LIGHTS["map"][0]}{medium.format("field")}</emitter>'
    path = write(folder, light, "nrf", '<bsdf type="null"/>' + medium.format("interior"))
    [emitter] = load_scene(path, {}, Environment(folder / "other.exr", 45, 2)).emitters()
    bare = write(folder, '<emitter type="envmap"><string name="filename" value="other.exr"/></emitter>', name="b.xml")
    np.testing.assert_allclose(radiance(emitter.attached(), about("y", 45, directions)), 2 * seen(bare, directions),
                               rtol=1e-3, atol=1e-4)


def test_up_is_the_coordinate_axis_that_the_environment_points_to():
    rotate = mi.ScalarTransform4f().rotate
    upside_down = np.array(rotate([1, 0, 0], 180).matrix)
    np.testing.assert_allclose(turned(upside_down, 30), np.array(rotate([0, 1, 0], -30).matrix) @ upside_down,
                               atol=1e-6)
    np.testing.assert_allclose(turned(np.eye(4), 30), np.array(rotate([0, 1, 0], 30).matrix), atol=1e-6)


@pytest.mark.parametrize(("light", "options", "says"), [
    ("", {"rotate": 10.0}, r"scene\.xml has no environment to turn or to scale; give one by --env FILE"),
    ("", {"file": Path("nothing.exr")}, r"--env nothing\.exr: does not exist"),
    ("", {"file": Path(__file__)}, r"test_environment_option\.py: no image that Mitsuba reads"),
    ("", {"rotate": float("nan")}, "--env-rotate is nan, expected a finite number of degrees"),
    ("", {"scale": -1.0}, r"--env-scale is -1\.0, expected a finite number, 0 or more"),
    ('<emitter type="constant"><texture type="bitmap" name="radiance"><string name="filename" value="sky.exr"/>'
     "</texture></emitter>", {"scale": 2.0}, "--env-scale: the radiance of the scene's constant emitter is a nested"),
])
def test_faults_are_named(folder, light, options, says):
    with pytest.raises(MiNtfError, match=says):
        scene_file.load(write(folder, light), {}, Environment(**options))


def test_command_line_writes_what_the_scene_by_hand_gives(folder):
    write(folder, LIGHTS["z up"][0])
    by_hand = UP_Z.replace("</transform>", '<rotate z="1" angle="-50"/></transform>')
    write(folder, f'<emitter type="envmap"><string name="filename" value="other.exr"/>{by_hand}'
                  '<float name="scale" value="1.5"/></emitter>', name="hand.xml")
    for words in (("--env", "other.exr", "--env-rotate", "-50", "--env-scale", "0.5", "scene.xml"), ("hand.xml",)):
        done = run_program("mi-ntf", "render", "-m", "llvm_ad_rgb", *words, cwd=folder)
        assert done.returncode == 0, done.stderr
    a, b = (np.array(mi.Bitmap(str(folder / name))) for name in ("scene.exr", "hand.exr"))
    np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-5)
    assert a[..., :3].max() > 0.1

"""The stock `mitsuba` program with the plugins of this package: same picture as Python, clean exits, clear errors."""

import json
import re
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from helpers import scenes
from helpers.programs import run_on_one_core, run_program

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.compare import read_image
from mi_ntf.swap import swap

SCENE = """<scene version="3.9.0">
  <default name="visibility" value="auto"/> <default name="spp" value="4"/>
  <integrator type="{integrator}">{options}</integrator>
  <sensor type="perspective">
    <float name="fov" value="28"/>
    <transform name="to_world"><lookat origin="1.6, 1.3, 5.3" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/>
      <string name="pixel_format" value="rgba"/><string name="component_format" value="float32"/></film>
    <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
  </sensor>
  {light}
  <shape type="sphere">
    <point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/><bsdf type="null"/>
    <medium type="nrf" name="interior">
      <string name="filename" value="blobs.safetensors"/><integer name="resolution" value="64"/></medium>
  </shape>
</scene>"""
POINT = (
    '<emitter type="point"><point name="position" x="3.4" y="3" z="2.5"/><rgb name="intensity" value="60"/></emitter>'
)
NRF = {"integrator": "nrf", "options": '<string name="visibility" value="$visibility"/>', "light": POINT}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stock")
    scenes.write_blobs(folder)
    return folder


def write(folder, name="scene.xml", **fill):
    (folder / name).write_text(SCENE.format(**{**NRF, **fill}))
    return folder / name


@pytest.mark.parametrize("visibility", ["raymarch", "neural_transmittance", "transmittance_map", "none"])
def test_equals_rendering_from_python(folder, variant, visibility, tmp_path):
    """The same scene and seed give the same picture to 1e-4 in another process and working directory."""
    path = write(folder)
    out = tmp_path / "stock.exr"
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-D", f"visibility={visibility}", "-o", out, path, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    mi_ntf.render.register()
    ours = np.array(variant.render(variant.load_file(str(path), visibility=visibility), seed=0))
    assert ours[..., :3].max() > 0.05
    np.testing.assert_allclose(read_image(out), ours, atol=1e-4)


@pytest.mark.parametrize("place", ["", "deep"])
def test_a_field_in_the_working_folder_is_not_taken_for_the_scenes_own(folder, tmp_path, place):
    """`mi-ntf swap` names the field's file, and Mitsuba looks for files in the working folder first."""
    (folder / "mesh.xml").write_text(SCENE.format(integrator="path", options="", light=POINT))
    (folder / "light.xml").write_text(f'<scene version="3.9.0">{POINT}</scene>')
    swapped = folder / place / "swapped.xml"
    swap(folder / "mesh.xml", folder / "blobs.safetensors", swapped)
    (tmp_path / "blobs.safetensors").write_bytes(b"another")
    (tmp_path / "field.safetensors").write_bytes(b"another")
    shipped = Path(__file__).parents[2] / "scenes/statue/scene.xml"
    for scene in (swapped, shipped) if not place else (swapped,):
        small = ["-D", "res=8"] if scene == shipped else []
        done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-D", "visibility=none", "-D", "spp=1", *small, "-o",
                           tmp_path / "a.exr", scene, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr


def test_our_program_writes_what_it_achieved_into_the_header(folder, tmp_path):
    """The picture is that of the stock program."""
    options = NRF["options"] + '<float name="noise_threshold" value="0.05"/>'
    path = write(folder, "noise.xml", options=options)
    words = ("-m", "llvm_ad_rgb", "-D", "visibility=raymarch")
    for command in (("mi-ntf", "render"), ("mitsuba",)):
        done = run_program(*command, *words, "-o", tmp_path / f"{command[0]}.exr", path, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
    with OpenEXR.File(str(tmp_path / "mi-ntf.exr"), header_only=True) as file:
        found = json.loads(file.header()["mi_ntf"])
    assert found["ended"] == "noise" and found["noise"] <= 0.05 and found["visibility"] == "raymarch"
    np.testing.assert_array_equal(read_image(tmp_path / "mi-ntf.exr"), read_image(tmp_path / "mitsuba.exr"))


def test_it_says_what_it_does(folder, tmp_path):
    """The log names what is loaded, what `auto` chose and why, and what is built, with seconds; the film is last."""
    path = write(folder)
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-D", "visibility=auto", "-o", tmp_path / "a.exr", path,
                       cwd=tmp_path)
    text = done.stdout + done.stderr
    lines = [r"nrf medium: baking .*blobs.safetensors, \d+³ voxels \([\d.]+ s\)",
             r"nrf medium: reading .*blobs.safetensors \([\d.]+ s\)",
             r"nrf integrator: auto takes visibility=raymarch: camera rays times lights are 3.1 thousand, no more than",
             r"nrf integrator: done, \d+ × \d+ pixels with \d+ samples each \([\d.]+ s\)", r"Developing"]
    places = [re.search(line, text) for line in lines]
    assert all(places), text
    assert [m.start() for m in places] == sorted(m.start() for m in places), text


@pytest.mark.parametrize("runs", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_runs_in_a_row_exit_cleanly(folder, tmp_path, runs):
    path = write(folder)
    for _ in range(runs):
        done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-D", "spp=1", "-o", tmp_path / "a.exr", path, cwd=tmp_path)
        assert done.returncode == 0 and "rror" not in done.stderr, done.stdout + done.stderr


def test_a_scene_of_python_is_written_as_xml_that_the_program_renders(folder, variant, tmp_path):
    mi_ntf.render.register()
    parts = {"type": "scene", "integrator": scenes.nrf("none"), "light": scenes.light("point"),
             "sensor": {"type": "perspective", "film": scenes.film(16),
                        "to_world": variant.ScalarTransform4f().look_at([1, 1, 5], [0, 0, 0], [0, 1, 0])},
             "ball": scenes.ball(folder / "blobs.safetensors")}
    state = variant.parser.parse_dict(variant.parser.ParserConfig(variant.variant()), parts)
    variant.parser.write_file(state, str(tmp_path / "scene.xml"))
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-o", "a.exr", "scene.xml", cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    expected = np.array(variant.render(variant.load_dict(parts), seed=0))
    assert expected[..., :3].max() > 0.05
    np.testing.assert_allclose(read_image(tmp_path / "a.exr"), expected, rtol=2e-3, atol=1e-4)  # of 16 bits


@pytest.mark.parametrize("integrator", ["volpath", "prbvolpath"])
def test_stock_volumetric_integrators_see_the_field(folder, integrator, tmp_path):
    """The same medium under Mitsuba's own path tracers: the pixel means agree."""
    # The stock program, being of C++, has no integrators that are written in Python.
    program = ("mi-ntf", "render") if integrator == "prbvolpath" else ("mitsuba",)
    options = '<integer name="max_depth" value="2"/>'
    path = write(folder, f"{integrator}.xml", integrator=integrator, options=options)
    reference = write(folder)
    images = []
    for file, spp in ((path, 64), (reference, 64)):
        out = tmp_path / f"{file.stem}.exr"
        done = run_program(*program, "-m", "llvm_ad_rgb", "-D", f"spp={spp}", "-o", out, file, cwd=tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        images.append(read_image(out))
    # 49 000 paths, a tenth of which reach the light, of relative spread about 1: 1.5 %, times two.
    assert images[0][..., :3].mean() == pytest.approx(images[1][..., :3].mean(), rel=0.03)
    assert images[0][..., 3].mean() == pytest.approx(images[1][..., 3].mean(), rel=0.02)


ENVIRONMENT = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
FROM_PYTHON = """
import sys
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from mi_ntf.render import register
register()
mi.Bitmap(mi.render(mi.load_file(sys.argv[2], visibility="none"))).write(sys.argv[1])
"""


@pytest.mark.parametrize("program", [("mitsuba",), ("mitsuba", "-t", "2"), ("mi-ntf", "render"),
                                     ("mi-ntf", "render", "-t", "1"), ("python", "-c", FROM_PYTHON)],
                         ids=lambda p: " ".join(p[:-1] if p[0] == "python" else p))
def test_one_core_is_enough(folder, tmp_path, program):
    """Mitsuba alone waits for ever: it reads and writes EXR files in another thread. `mitsuba -t 2` has none either."""
    OpenEXR.File({}, {"RGB": np.ones((4, 8, 3), np.float32)}).write(str(folder / "sky.exr"))
    path = write(folder, "one_core.xml", light=ENVIRONMENT)
    out = tmp_path / "a.exr"
    flags = (out,) if program[0] == "python" else ("-m", "llvm_ad_rgb", "-D", "visibility=none", "-o", out)
    done = run_on_one_core(*program, *flags, path, cwd=tmp_path)
    assert done.returncode == 0, done.stdout + done.stderr
    assert read_image(out)[..., :3].max() > 0.1


@pytest.mark.parametrize("locale", ["C", "xx_XX.UTF-8"])  # the latter is installed nowhere
@pytest.mark.parametrize("program", [("mitsuba",), ("mi-ntf", "render")], ids=lambda p: p[0])
def test_names_of_files_need_no_locale(folder, tmp_path, program, locale):
    place = tmp_path / "Schädel 頭"
    place.mkdir()
    (place / "Öl.safetensors").write_bytes((folder / "blobs.safetensors").read_bytes())
    (place / "scene.xml").write_text(SCENE.format(**NRF).replace("blobs.safetensors", "Öl.safetensors"))
    flags = ("-m", "llvm_ad_rgb", "-D", "visibility=none", "-D", "spp=1", "-o", place / "ß.exr")
    done = run_program(*program, *flags, place / "scene.xml", cwd=tmp_path, LC_ALL=locale)
    assert done.returncode == 0, done.stdout + done.stderr
    assert (place / "ß.exr").stat().st_size > 0


def test_the_vector_width_is_that_of_the_stock_program(folder, tmp_path):
    path = write(folder)
    flags = ("-m", "llvm_ad_rgb", "-D", "visibility=none", "-D", "spp=1", "-V", "4", "-S", "-o", "a.exr")
    for program in (("mitsuba",), ("mi-ntf", "render")):
        done = run_program(*program, *flags, path, cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        assert "<4 x float>" in done.stderr and "<8 x float>" not in done.stderr and "<16 x" not in done.stderr
    done = run_program("mi-ntf", "render", "-m", "llvm_ad_rgb", "-V", "6", path, cwd=tmp_path)
    assert done.returncode == 1 and "-V 6: the vector width must be a power of two, such as 8" in done.stderr


UNKNOWN = '(line 3, col 4): failed to instantiate integrator plugin of type "nrf": nrf integrator: unknown property "v'
PROGRAMS = [("mitsuba", "-m", "llvm_ad_rgb"), ("mi-ntf", "render", "-m", "llvm_ad_rgb"), ("mi-ntf", "explain"),
            ("mi-ntf", "bake", "-o", "maps.exr")]


@pytest.mark.parametrize("program", PROGRAMS, ids=lambda p: " ".join(p[:2]))
@pytest.mark.parametrize(
    ("name", "old", "new", "text"),
    [
        ("constructor", 'name="visibility" value="$vis', 'name="visiblity" value="$vis', UNKNOWN),
        ("field", "blobs.safetensors", "nowhere.safetensors", "nowhere.safetensors does not exist; make one with"),
        ("render", '"radius" value="1.5"', '"radius" value="0.5"', "give shape and medium the same placement"),
    ],
)
def test_an_error_is_one_sentence_without_frames(folder, tmp_path, program, name, old, new, text):
    path = folder / f"{name}.xml"
    path.write_text(SCENE.format(**NRF).replace(old, new))
    done = run_program(*program, path, cwd=tmp_path)
    told = [line for line in done.stderr.splitlines() if "rror:" in line or "exception:" in line]
    assert done.returncode == 1
    assert len(told) == 1 and text in told[0], done.stderr
    assert "Traceback" not in done.stderr and "  File" not in done.stderr


@pytest.mark.parametrize(
    ("name", "old", "new"),
    [
        ("spp", 'value="$spp"', 'value="0"'),  # by which Mitsuba's samplers divide
        ("sunsky", POINT, '<emitter type="timed_sunsky"/>'),  # cannot be drawn from inside of a loop
    ],
)
def test_nothing_ends_without_a_word(folder, tmp_path, name, old, new):
    path = folder / f"{name}.xml"
    path.write_text(SCENE.format(**NRF).replace(old, new))
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", path, cwd=tmp_path)
    told = done.stderr.partition("exception: ")[2].split("\x1b")[0].strip()
    assert done.returncode == 0 or (done.returncode == 1 and len(told.splitlines()) == 1), done.stderr


@pytest.mark.parametrize("program", PROGRAMS[:2], ids=lambda p: p[0])
def test_a_switch_shows_the_frames(folder, tmp_path, program):
    path = folder / "frames.xml"
    path.write_text(SCENE.format(**NRF).replace("blobs.safetensors", "nowhere.safetensors"))
    done = run_program(*program, path, cwd=tmp_path, MI_NTF_DEBUG="1")
    assert done.returncode == 1 and "Traceback" in done.stderr and "plugins/medium.py" in done.stderr


def test_from_python_an_error_stays_an_exception(folder, variant):
    """The exception has its own type, also where it leaves one of Dr.Jit's loops."""
    path = folder / "outside.xml"
    path.write_text(SCENE.format(**NRF).replace('"radius" value="1.5"', '"radius" value="0.5"'))
    loaded = variant.load_file(str(path))
    with pytest.raises(MiNtfError, match="give shape and medium the same placement"):
        loaded.integrator().render(loaded)


def test_ntf_emitter_shadows_a_floor(folder, tmp_path, variant):
    """Stock `path` with an ordinary floor: the field's shadow falls on it, where a march says it does."""
    mi_ntf.render.register()
    floor = """<scene version="3.9.0"><integrator type="path"><integer name="max_depth" value="2"/></integrator>
      <sensor type="orthographic"><transform name="to_world"><scale value="3"/>
        <lookat origin="0.4, 5, 0.3" target="0.4, -3, 0.3" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="32"/></film></sensor>
      <medium type="nrf" id="field"><string name="filename" value="blobs.safetensors"/></medium>
      <emitter type="ntf"><string name="visibility" value="{visibility}"/><ref id="field"/>
        <emitter type="directional"><vector name="direction" x="0" y="-1" z="0"/><rgb name="irradiance" value="3"/>
        </emitter></emitter>
      <shape type="rectangle"><transform name="to_world"><scale value="4"/><rotate x="1" angle="-90"/>
        <translate x="0.4" y="-2" z="0.3"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.5"/></bsdf></shape></scene>"""
    images = {}
    for visibility in ("raymarch", "none"):
        path = folder / f"floor_{visibility}.xml"
        path.write_text(floor.format(visibility=visibility))
        images[visibility] = np.array(variant.render(variant.load_file(str(path)), spp=16))[..., 0]
    open_floor = 0.5 * 3 / np.pi
    np.testing.assert_allclose(images["none"], open_floor, rtol=1e-4)
    corner = images["raymarch"][:3, :3]
    np.testing.assert_allclose(corner, open_floor, rtol=1e-3)
    # Middle of each pixel: the floor there, and the density above it summed in NumPy.
    loaded = variant.load_file(str(folder / "floor_none.xml"))
    v, u = np.mgrid[:32, :32].reshape(2, -1)
    film = variant.Point2f((u + 0.5) / 32, (v + 0.5) / 32)
    ray, _ = loaded.sensors()[0].sample_ray(0.0, 0.0, film, variant.Point2f(0.5))
    floor = np.array(ray(-(ray.o.y + 2) / ray.d.y))
    medium = variant.load_dict({"type": "nrf", "filename": str(folder / "blobs.safetensors")})
    depth = np.zeros(1024)
    for height in np.linspace(0, 3.6, 1801)[:-1] + 0.001:
        depth += 0.002 * np.array(medium.extinction(variant.Point3f(floor + np.array([[0], [height], [0]]))))
    truth = open_floor * np.exp(-depth).reshape(32, 32)
    steady = np.abs(truth - open_floor / 2) > 0.45 * open_floor  # a pixel at a shadow's edge is a mixture
    assert steady.mean() > 0.8 and 0.05 < (truth < 0.1).mean() < 0.3
    # Edges of the shadow pass through some of the other pixels as well, unseen from their middle.
    assert (np.abs(images["raymarch"] - truth)[steady] < 0.05).mean() > 0.95
    assert np.corrcoef(images["raymarch"].ravel(), truth.ravel())[0, 1] > 0.95

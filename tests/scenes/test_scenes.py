"""The shipped scenes: they load under both lights, and field and mesh stand at the same place."""

import importlib.util
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_ntf.data import capture as cap
from mi_ntf.data.schema import read_image

SCENES = Path(__file__).parents[2] / "scenes"
NAMES = ("statue", "globe", "knot")


@pytest.fixture(autouse=True, scope="module")
def variant():
    mi.set_variant("llvm_ad_rgb")


def sphere_of(path: Path) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere that bounds the field in a scene.xml."""
    shape = ET.parse(path).getroot().find("shape")
    center = shape.find("point[@name='center']")
    return np.array([float(center.get(k)) for k in "xyz"]), float(shape.find("float[@name='radius']").get("value"))


@pytest.mark.parametrize("name", NAMES)
def test_field_sphere_is_the_captures_similarity(name):
    shapes, _ = cap._load(SCENES / name / "mesh.xml")
    center, radius = cap.bounding_sphere(cap._outline(shapes))
    written_center, written_radius = sphere_of(SCENES / name / "scene.xml")
    # nine digits are written; the vertices are float32
    np.testing.assert_allclose(written_center, center, atol=1e-6)
    assert written_radius == pytest.approx(radius * cap.MARGIN, rel=1e-6)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("light", ["point", "env"])
def test_mesh_scene_renders_its_reference(name, light):
    scene = mi.load_file(str(SCENES / name / "mesh.xml"), light=light, res="256")
    image = np.array(mi.render(scene, spp=32))
    reference = read_image(SCENES / name / f"reference_{light}.exr")
    blocks = [x.reshape(16, 16, 16, 16, 4).mean((1, 3)) for x in (image, reference)]
    # One path has a standard deviation of about 220 % of the image's mean under the environment's small sun (less
    # under the point light): 32 paths x 256 pixels a block leave 2.4 %. A shift of 8 pixels costs 60 % and more.
    error = np.sqrt(((blocks[0] - blocks[1]) ** 2).mean((0, 1))) / blocks[1].mean((0, 1))
    assert (error < 0.05).all(), error


@pytest.mark.parametrize("name", NAMES)
def test_point_light_stands_outside_the_field(name):
    position = ET.parse(SCENES / name / "light_point.xml").getroot().find("emitter/point")
    center, radius = sphere_of(SCENES / name / "scene.xml")
    assert np.linalg.norm(np.array([float(position.get(k)) for k in "xyz"]) - center) > 1.5 * radius


def test_materials_stay_inside_the_fields_model():
    for name in NAMES:
        text = (SCENES / name / "mesh.xml").read_text()
        assert set(re.findall(r'bsdf type="(\w+)"', text)) <= {"diffuse", "blendbsdf", "roughconductor"}
        for value in re.findall(r'name="reflectance" value="([^"]+)"', text):
            assert all(0.1 <= float(v) <= 0.75 for v in value.split(","))
        assert sum(p.stat().st_size for p in (SCENES / name / "meshes").glob("*.ply")) < 2e6


def test_environment_is_the_script_s_and_its_sun_stands_where_it_says():
    spec = importlib.util.spec_from_file_location("make_env", SCENES / "common" / "make_env.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    stored = read_image(SCENES / "common" / "env.exr")[..., :3]
    np.testing.assert_allclose(stored, module.environment(), rtol=1e-6)  # last digit of exp differs by machine
    emitter = mi.load_dict({"type": "envmap", "filename": str(SCENES / "common" / "env.exr")})
    si = mi.SurfaceInteraction3f()
    si.wi = -mi.Vector3f(*(np.array([0.75, 0.62, 0.62]) / np.linalg.norm([0.75, 0.62, 0.62])).tolist())
    towards_sun = np.array(emitter.eval(si)).ravel()
    assert towards_sun[0] > 0.75 * stored[..., 0].max()  # bilinear lookup beside the brightest texel

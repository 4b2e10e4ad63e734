"""The virtual camera: geometry against Mitsuba's own sensor, radiance against closed forms, resuming, errors."""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.programs import run_on_one_core
from helpers.variants import VARIANT

from mi_ntf import cli
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture as cap
from mi_ntf.data import capture_scene, schema
from mi_ntf.data.poses import camera_to_world, view_directions
from mi_ntf.data.readers import load_dataset

SCENES = Path(__file__).parents[2] / "scenes"

SPHERE = """<scene version="3.9.0">
    <integrator type="path"/>
    <emitter type="constant"/>
    <shape type="sphere">
        <point name="center" x="2" y="-1" z="0.5"/> <float name="radius" value="0.7"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.4, 0.2"/></bsdf>
    </shape>
    <shape type="sphere">
        <point name="center" x="9" y="9" z="9"/> <float name="radius" value="0.1"/>
        <emitter type="area"><rgb name="radiance" value="5"/></emitter>
    </shape>
</scene>"""

MESHES = """<scene version="3.9.0">
    <shape type="cube"> <transform name="to_world"> <scale value="0.2"/> <translate x="3"/> </transform> </shape>
    <shape type="rectangle"> <transform name="to_world"> <rotate x="1" angle="40"/> <translate x="2.6" y="1"/>
    </transform> </shape>
</scene>"""


MEDIUM = """<scene version="3.9.0">
    <integrator type="volpath"> <integer name="max_depth" value="2"/> </integrator>
    <emitter type="constant"/>
    <shape type="sphere">
        <point name="center" x="2" y="-1" z="0.5"/> <float name="radius" value="0.7"/>
        <bsdf type="null"/>
        <medium type="homogeneous" name="interior">
            <float name="sigma_t" value="1.5"/> <rgb name="albedo" value="0.8, 0.4, 0.2"/>
        </medium>
    </shape>
</scene>"""

ON_FLOOR = """<scene version="3.9.0">
    <shape type="merge">
        <shape type="sphere">
            <point name="center" x="2" y="-1" z="0.5"/> <float name="radius" value="0.7"/>
            <bsdf type="diffuse" id="clay"/>
        </shape>
        <shape type="rectangle" id="lamp"> <emitter type="area"/> </shape>
    </shape>
    <default name="half" value="5"/>
    <shape type="rectangle" id="floor">
        <transform name="to_world"> <scale value="$half"/> <rotate x="1" angle="-90"/> <translate y="-2"/> </transform>
        <ref id="clay"/>
    </shape>
</scene>"""

BALL = """<scene version="3.9.0">
    <shape type="shapegroup" id="group"> <shape type="sphere"> <float name="radius" value="0.35"/> </shape> </shape>
    <shape type="instance">
        <ref id="group"/> <transform name="to_world"> <scale value="2"/> <translate x="2" y="-1" z="0.5"/> </transform>
    </shape>
</scene>"""


@pytest.fixture(autouse=True, scope="module")
def variant():
    mi.set_variant(VARIANT)


def write(folder, text=SPHERE):
    path = folder / "scene.xml"
    path.write_text(text)
    return path


def small(scene, out, **changes):
    return cap.capture(scene, out, **{"views": 3, "size": 33, "test_views": 1, "spp": 16, **changes})


@pytest.fixture(scope="module")
def sphere_set(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sphere")
    return small(write(folder), folder / "out"), folder / "out"


def test_similarity_leaves_out_the_emitter_and_keeps_the_margin(sphere_set):
    summary, out = sphere_set
    split = load_dataset(out)["train"]
    # 1000 points stand for the sphere, each for a patch of half an angle of 0.06: the ball may move by 0.06²/2
    np.testing.assert_allclose(split.center, [2, -1, 0.5], atol=0.002 * 0.7)
    assert split.radius == pytest.approx(0.7 * cap.MARGIN, rel=0.002)
    assert summary["rendered"] == 3 + 4 + 1 and summary["kept"] == 0
    assert [len(split.images) for split in load_dataset(out).values()] == [3, 4, 1]


def test_collocated_radiance_of_a_diffuse_sphere_is_the_closed_form(sphere_set):
    split = load_dataset(sphere_set[1])["train"]
    for i in range(3):
        distance = np.linalg.norm(split.light_pos[i] - split.center) - 0.7
        expected = np.array([0.8, 0.4, 0.2]) / np.pi * split.light_intensity[i] / distance**2
        # the middle pixel of 33 sees the nearest point; over it cos and distance change by 0.3 %, half floats by 0.05 %
        np.testing.assert_allclose(split.images[i, 16, 16, :3], expected, rtol=5e-3)
        assert split.images[i, 16, 16, 3] == 1 and (split.images[i, 0, 0] == 0).all()


def test_a_flash_beside_the_lens_lights_the_sphere_from_there(tmp_path):
    """The radiance of the diffuse sphere in the middle pixel is ⟨n,ω⟩ I/d² times albedo over π.

    The flash is right of, above and in front of the lens.
    """
    beside = np.array([0.6, 0.9, 0.3])
    small(write(tmp_path), tmp_path / "out", spp=1024, flash_offset=tuple(beside))
    split = load_dataset(tmp_path / "out")["train"]
    for i in range(3):
        camera, (right, up, back) = split.c2w[i][:3, 3], split.c2w[i][:3, :3].T
        np.testing.assert_allclose(split.light_pos[i], camera + beside @ [right, up, -back], atol=1e-6)  # float32
        to_flash = split.light_pos[i] - (np.array([2, -1, 0.5]) + 0.7 * back)
        distance = np.linalg.norm(to_flash)
        expected = np.array([0.8, 0.4, 0.2]) / np.pi * split.light_intensity[i] * (to_flash @ back) / distance**3
        # the cosine's deviation in the pixel is a percent, the mean's of 1024 paths a thirtieth of that
        np.testing.assert_allclose(split.images[i, 16, 16, :3], expected, rtol=5e-3)
    with pytest.raises(MiNtfError, match="forward at most half"):
        small(write(tmp_path), tmp_path / "far", flash_offset=(0.0, 0.0, 2.0))
    with pytest.raises(MiNtfError, match=r"flash_offset = .*, now flash_offset"):
        small(write(tmp_path), tmp_path / "out", spp=1024)


def test_photographs_of_a_medium_are_the_integral_over_light_dimmed_twice(tmp_path):
    small(write(tmp_path, MEDIUM), tmp_path / "out", size=32, views=2, spp=128)
    split = load_dataset(tmp_path / "out")["train"]
    measured, expected, offset = [], [], []
    for i, image in enumerate(split.images):
        origins, directions = schema.pixel_rays(split.c2w[i], split.focal[i], 32, 32, split.principal[i])
        middle = ((np.array([2, -1, 0.5]) - origins) * directions).sum(-1)
        across = np.linalg.norm(origins + middle[..., None] * directions - [2, -1, 0.5], axis=-1)
        half = np.sqrt(np.maximum(0.7**2 - across**2, 0))
        u = (np.arange(200) + 0.5) * (2 * half[..., None] / 200)  # length inside, in front of the scattering point
        falloff = np.exp(-2 * 1.5 * u) / (middle[..., None] - half[..., None] + u) ** 2
        column = 1.5 / (4 * np.pi) * falloff.sum(-1) * (2 * half / 200)
        radiance = column[..., None] * [0.8, 0.4, 0.2] * split.light_intensity[i]
        measured.append(image)
        expected.append(np.concatenate([radiance, 1 - np.exp(-1.5 * 2 * half)[..., None]], -1))
        offset.append(across)
        assert not image[across > 0.8].any()
    measured, expected, offset = np.stack(measured), np.stack(expected), np.stack(offset)
    for near, far in ((0.0, 0.3), (0.3, 0.6)):  # at the rim a pixel's mean is not its centre's value
        ring = (offset >= near) & (offset < far)
        # at least 20 000 paths, each with a deviation of about the mean: 0.7 %; the quadrature's error is below 0.01 %.
        # With the light dimmed once, the radiance would be 40 % higher.
        np.testing.assert_allclose(measured[ring].mean(0), expected[ring].mean(0), rtol=0.03)


def test_surface_integrators_do_not_photograph_media(tmp_path):
    volpath = capture_scene.load(write(tmp_path, MEDIUM)).integrator
    other = capture_scene.load(write(tmp_path, MEDIUM.replace("volpath", "path"))).integrator
    surface = capture_scene.load(write(tmp_path, SPHERE.replace('type="path"', 'type="direct"'))).integrator
    assert [x.class_name() for x in (volpath, other, surface)] == [
        "VolumetricPathIntegrator", "VolumetricPathIntegrator", "DirectIntegrator"]
    assert "max_depth = 2" in str(volpath) and "max_depth = 6" in str(other)


def test_white_surface_at_the_centre_has_radiance_one(sphere_set):
    split = load_dataset(sphere_set[1])["test"]
    distance = np.linalg.norm(split.light_pos[0] - split.center)
    np.testing.assert_allclose(split.light_intensity[0] / (np.pi * distance**2), 1.0, rtol=1e-6)  # float32
    np.testing.assert_allclose(split.light_pos[0], split.c2w[0, :3, 3], rtol=1e-6)


def test_pixel_rays_are_those_of_mitsubas_sensor():
    width, height, angle = 7, 5, 0.8
    c2w = camera_to_world(np.array([1.0, 2.0, 3.0]), np.array([0.2, -0.1, 0.4]))
    sensor = mi.load_dict({
        "type": "perspective", "fov": float(np.degrees(angle)), "fov_axis": "x",
        "to_world": mi.ScalarTransform4f(mi.ScalarMatrix4f(schema.mitsuba_to_opengl(c2w).tolist())),
        "film": {"type": "hdrfilm", "width": width, "height": height}})
    y, x = np.meshgrid((np.arange(height) + 0.5) / height, (np.arange(width) + 0.5) / width, indexing="ij")
    position = mi.Point2f(mi.Float(x.ravel().astype(np.float32)), mi.Float(y.ravel().astype(np.float32)))
    ray, _ = sensor.sample_ray(0.0, 0.5, position, mi.Point2f(0.5))
    origins, directions = schema.pixel_rays(c2w, schema.focal_length(angle, width), width, height)
    np.testing.assert_allclose(np.array(ray.d).T.reshape(height, width, 3), directions, atol=2e-6)  # float32 matrices
    offset = np.array(ray.o).T.reshape(height, width, 3) - origins  # Mitsuba starts rays on the near plane
    np.testing.assert_allclose(np.cross(offset, directions), 0.0, atol=2e-6)


def test_cameras_look_at_the_object_from_all_around():
    directions = view_directions(200, np.random.default_rng(3))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-12)
    assert np.linalg.norm(directions.mean(0)) < 0.02  # a lattice is balanced; random points would give 0.07
    nearest = np.sort(np.arccos(np.clip(directions @ directions.T, -1, 1)), axis=1)[:, 1]
    assert nearest.min() > 0.5 * np.sqrt(4 * np.pi / 200)  # no two views fall together
    for direction in [*directions, np.array([0, 1.0, 0]), np.array([0, -1.0, 0])]:
        c2w = camera_to_world(3 * direction, np.zeros(3))
        np.testing.assert_allclose(c2w[:3, 2], direction, atol=1e-12)
        np.testing.assert_allclose(c2w[:3, :3].T @ c2w[:3, :3], np.eye(3), atol=1e-12)
        assert np.linalg.det(c2w[:3, :3]) > 0


def test_meshes_lie_inside_the_unit_ball_and_inside_the_picture(tmp_path):
    scene = write(tmp_path, MESHES)
    points = capture_scene.outline(capture_scene.load(scene).shapes)
    summary = small(scene, tmp_path / "out", views=8)
    reach = np.linalg.norm((points - summary["center"]) / summary["radius"], axis=1).max()
    assert reach == pytest.approx(1 / cap.MARGIN, rel=1e-6)
    assert summary["radius"] / cap.MARGIN < np.linalg.norm(np.ptp(points, axis=0)) / 2  # tighter than the box's ball
    alpha = load_dataset(tmp_path / "out")["train"].images[..., 3]
    assert alpha[:, 16, 16].any() and alpha.max() == 1
    assert not alpha[:, [0, -1]].any() and not alpha[:, :, [0, -1]].any()


def test_a_second_run_keeps_what_exists_and_renders_what_is_missing_the_same(tmp_path):
    scene, out = write(tmp_path), tmp_path / "out"
    small(scene, out)
    before = {p: (p.stat().st_mtime_ns, p.read_bytes()) for p in sorted(out.rglob("*.exr"))}
    lost = out / "train" / "0001.exr"
    lost.unlink()
    summary = small(scene, out)
    assert (summary["rendered"], summary["kept"]) == (1, 7)
    for path, (modified, content) in before.items():
        assert path.stat().st_mtime_ns == modified or path == lost
        # the same seed makes the same image; only the order of float additions in the film may differ
        image = schema.read_image(path)
        path.write_bytes(content)
        np.testing.assert_allclose(image, schema.read_image(path), rtol=2e-3, atol=1e-4)


def test_other_settings_or_another_object_are_refused_by_name(tmp_path):
    scene, out = write(tmp_path), tmp_path / "out"
    small(scene, out)
    with pytest.raises(MiNtfError, match=r"captured with spp = 16, now spp = 8; use another folder, delete this one"):
        small(scene, out, spp=8)
    write(tmp_path, SPHERE.replace("0.8, 0.4, 0.2", "0.8, 0.4, 0.3"))
    with pytest.raises(MiNtfError, match=r"captured with object = "):
        small(scene, out)
    assert json.loads((out / "capture.json").read_text())["spp"] == 16


@pytest.mark.parametrize(("text", "message"), [
    ("<scene version='3.9.0'><emitter type='constant'/></scene>", "no shapes that reflect light"),
    ("<bsdf version='3.9.0' type='diffuse'/>", "not a scene; the root element must be <scene>"),
    ("<scene version='3.9.0'><shape type='sphere' id='ball'><medium type='homogeneous' name='exterior'/></shape>"
     "</scene>",
     "shape 'ball' has an exterior medium, in which the cameras would stand"),
])
def test_scenes_that_cannot_be_photographed_say_why(tmp_path, text, message):
    with pytest.raises(MiNtfError, match=message):
        small(write(tmp_path, text), tmp_path / "out")
    assert not (tmp_path / "out").exists()


def of_albedo(folder, value):
    """Return the scene file of the sphere with an albedo that only a raw texture may have."""
    mi.util.write_bitmap(str(folder / "albedo.exr"), np.full((2, 2, 3), value, np.float32), write_async=False)
    texture = """<texture type="bitmap" name="reflectance"><boolean name="raw" value="true"/>
        <string name="filename" value="albedo.exr"/></texture>"""
    return write(folder, SPHERE.replace('<rgb name="reflectance" value="0.8, 0.4, 0.2"/>', texture))


def test_radiance_beyond_half_precision_is_kept(tmp_path):
    small(of_albedo(tmp_path, 1e6), tmp_path / "out")
    images = load_dataset(tmp_path / "out")["train"].images
    assert np.isfinite(images).all() and images[..., :3].max() == pytest.approx(1.5e6, rel=0.5)


def test_a_texture_is_read_on_one_core(tmp_path):
    """Mitsuba alone waits for ever for an EXR file there."""
    words = "--views 1 --test-views 1 --size 8 --spp 1".split()
    done = run_on_one_core("mi-ntf", "capture", of_albedo(tmp_path, 0.5), tmp_path / "out", *words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "out").rglob("0000.*"))


def test_photographs_that_are_not_finite_are_not_written(tmp_path):
    with pytest.raises(MiNtfError, match=r"scene.xml: [0-9]+ pixels of view train/0000.exr are NaN or infinite"):
        small(of_albedo(tmp_path, 3e38), tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.exr"))


def test_the_manifest_says_where_the_scene_is_from_the_data_set(tmp_path):
    """A capture goes on although its folder was moved: the place is not compared."""
    scene, out = write(tmp_path), tmp_path / "sets" / "out"
    small(scene, out)
    manifest = json.loads((out / "capture.json").read_text())
    assert (out / manifest["folder"] / manifest["scene"]).resolve() == scene.resolve() and manifest["parameters"] == {}
    out.rename(tmp_path / "moved")
    assert small(scene, tmp_path / "moved")["rendered"] == 0


@pytest.mark.parametrize("text", ["", "[1, 2]", "{", "3"])
def test_a_damaged_note_of_the_settings(tmp_path, text):
    scene, out = write(tmp_path), tmp_path / "out"
    out.mkdir()
    (out / "capture.json").write_text(text)
    with pytest.raises(MiNtfError, match=r"capture.json: cannot be read .*use another folder or delete this one"):
        small(scene, out)


def test_missing_scene_and_bad_counts(tmp_path):
    with pytest.raises(MiNtfError, match=r"gone.xml does not exist; name a Mitsuba scene file"):
        small(tmp_path / "gone.xml", tmp_path / "out")
    with pytest.raises(MiNtfError, match="views is 0, must be 1 or more"):
        small(write(tmp_path), tmp_path / "out", views=0)


@pytest.mark.parametrize("name", capture_scene.POSITIONS)
def test_meshes_are_measured_by_their_vertices_under_either_name(monkeypatch, name):
    """Mitsuba 3.10 renames the parameter."""
    tetrahedron = np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    monkeypatch.setattr(mi, "traverse", lambda shape: {name: tetrahedron.ravel()})
    np.testing.assert_array_equal(capture_scene.outline([None]), tetrahedron)


def test_a_floor_is_left_out_by_its_name(tmp_path, capsys):
    """The photographs of the ball are those of the scene without the floor."""
    small(write(tmp_path, ON_FLOOR), tmp_path / "out", shapes="not:floor")
    assert "photographed: sphere; left out: lamp (area light), floor (rectangle)" in capsys.readouterr().err
    split = load_dataset(tmp_path / "out")["train"]
    np.testing.assert_allclose(split.center, [2, -1, 0.5], atol=0.002 * 0.7)
    assert split.radius == pytest.approx(0.7 * cap.MARGIN, rel=0.002)
    with pytest.raises(MiNtfError, match=r"captured with shapes = not:floor, now shapes = sphere; use another folder"):
        small(tmp_path / "scene.xml", tmp_path / "out", shapes="sphere")
    with pytest.raises(MiNtfError, match=r"no shape is called 'lamp'; the scene has sphere, floor \(lights are never"):
        small(tmp_path / "scene.xml", tmp_path / "out", shapes="sphere,lamp")


def test_a_floor_that_is_photographed_is_warned_of(tmp_path):
    """No warning comes when the user has chosen, or where the floor is small."""
    scene = write(tmp_path, ON_FLOOR)
    _, warning = capture_scene.load(scene).notes
    assert "floor (rectangle) is 5.8 times as large" in warning and warning.endswith("--shapes not:floor leaves it out")
    assert len(capture_scene.load(scene, "sphere,floor").notes) == 1
    assert len(capture_scene.load(scene, "", {"half": "0.8"}).notes) == 1


@pytest.mark.parametrize("name", ["statue", "knot", "globe", "cloud", "animal"])
def test_parts_of_the_shipped_objects_are_no_floor(name):
    (note,) = capture_scene.load(SCENES / name / "mesh.xml").notes
    assert note.startswith("photographed: ") and "left out" not in note


def test_an_instance_is_photographed(tmp_path):
    small(write(tmp_path, BALL), tmp_path / "out", views=1)
    alpha = load_dataset(tmp_path / "out")["train"].images[0, ..., 3]
    # Its box is known, so the picture is √3 times as wide as for the sphere, which takes a share of 1/3 of its disk.
    assert alpha[16, 16] == 1 and alpha.mean() == pytest.approx(np.pi / 4 / 3 / cap.MARGIN**2, rel=0.1)


def test_shapes_with_a_sensor_are_not_photographed(tmp_path):
    meter = '<shape type="cube"><sensor type="irradiancemeter"><film type="hdrfilm"/></sensor></shape></scene>'
    (note,) = capture_scene.load(write(tmp_path, MESHES.replace("</scene>", meter))).notes
    assert note == "photographed: cube, rectangle; left out: cube (sensor)"


@pytest.mark.parametrize("value", ["0.7", "0.2"])
def test_values_of_names_reach_the_object(tmp_path, value):
    default = '<integrator type="path"/> <default name="r" value="0.5"/>'
    scene = write(tmp_path, SPHERE.replace('<integrator type="path"/>', default).replace('value="0.7"', 'value="$r"'))
    words = ["--views", "1", "--test-views", "1", "--size", "8", "--spp", "1", "-D", f"r={value}", "-m", VARIANT]
    assert cli.main(["capture", str(scene), str(tmp_path / "set"), *words]) == 0
    described = json.loads((tmp_path / "set/transforms_train.json").read_text())
    assert described["unit_sphere"]["radius"] == pytest.approx(cap.MARGIN * float(value), rel=0.01)

"""A field of three balls, its photographs under a sky, and the same field with a patch of wrong albedo."""

import json
from pathlib import Path

import mitsuba as mi
import numpy as np
from helpers import scenes

from mi_ntf.data import schema
from mi_ntf.data.poses import camera_to_world, view_directions
from mi_ntf.refine import saving
from mi_ntf.refine.photographs import Camera
from mi_ntf.refine.subject import Subject
from mi_ntf.render.scene.environment_option import Environment

SIZE, ANGLE, RESOLUTION = 24, 0.7, 48
FOCAL = schema.focal_length(ANGLE, SIZE)
CENTER, RADIUS = np.array(scenes.SIMILARITY.center), scenes.SIMILARITY.radius
SKY = np.full((8, 16, 3), 0.8, np.float32)
SKY[:4] = [1.6, 1.5, 1.4]
MOVED = '<translate x="2" y="-1" z="0.5"/>'
"""Place of the field in the scene; photographs have the field's own coordinates."""


def write_scene(folder: Path, field: Path, integrator="") -> Path:
    """A scene with the field under the sky."""
    mi.Bitmap(SKY).write(str(folder / "sky.exr"))
    x, y, z = CENTER + np.array([2, -1, 0.5])
    path = folder / f"{field.stem}.xml"
    path.write_text(f"""<scene version="3.9.0">
        <integrator type="nrf">{integrator}<integer name="environment_lights" value="16"/></integrator>
        <emitter type="envmap"><string name="filename" value="{folder / 'sky.exr'}"/></emitter>
        <shape type="sphere"><point name="center" x="{x}" y="{y}" z="{z}"/><float name="radius" value="{RADIUS}"/>
            <bsdf type="null"/>
            <medium type="nrf" name="interior"><string name="filename" value="{field}"/>
                <integer name="resolution" value="{RESOLUTION}"/><transform name="to_world">{MOVED}</transform>
            </medium></shape></scene>""")
    return path


def subject(path: Path) -> Subject:
    return Subject(path, {}, Environment())


LAMP = (CENTER + RADIUS * np.array([1.5, 3.0, 2.0])).tolist()


def photograph(of: Subject, folder: Path, counts: dict[str, int], spp=64, lamp=False) -> Path:
    """Photographs of `counts` views by split, without a word on their light, or lit by a `lamp` of 40 W/sr."""
    light = {"pl_pos": LAMP, "pl_intensity": [40.0] * 3} if lamp else {}
    rng, camera, to_scene = np.random.default_rng(4), Camera(SIZE, SIZE), of.to_scene()
    for split, count in counts.items():
        (folder / split).mkdir(parents=True)
        frames = []
        for i, direction in enumerate(view_directions(count, rng)):
            c2w = camera_to_world(CENTER + 3.4 * RADIUS * direction, CENTER)
            camera.place(to_scene @ c2w, schema.focal_length(ANGLE, SIZE), np.full(2, SIZE / 2))
            image = of._full.render(of._scene, camera.sensor, 50 + i, spp).numpy()
            schema.write_exr(folder / split / f"{i}.exr", image)
            frames.append({"file_path": f"{split}/{i}.exr", "transform_matrix": c2w.tolist(), **light})
        (folder / f"transforms_{split}.json").write_text(json.dumps({
            "camera_angle_x": ANGLE, "w": SIZE, "h": SIZE, "frames": frames,
            "unit_sphere": {"center": CENTER.tolist(), "radius": RADIUS}}))
    return folder


def with_patch(of: Subject, path: Path, factor=0.8) -> np.ndarray:
    """Write the field with its albedo times `factor` on the left of a plane; return a mask of the voxels there."""
    x = np.array(of.lattice("albedo").centres()[0])
    values = of.get("albedo").numpy()
    patch = (x < -0.3).reshape(values.shape[:4])
    of.set({"albedo": mi.TensorXf(np.where(patch[..., None], factor * values, values))})
    saving.save(of, path, {"made": "by a test"})
    of.set({"albedo": mi.TensorXf(values)})
    return patch


def albedo(field: Path, folder: Path) -> np.ndarray:
    """Albedo (n, 3) of the field in the pixels of the photographs for training that show matter alone."""
    scene = mi.load_dict({"type": "scene", "light": {"type": "constant"},
                          "integrator": scenes.nrf("none", aovs="albedo"),
                          "ball": scenes.ball(field, resolution=RESOLUTION)})
    camera, found = Camera(SIZE, SIZE), []
    for frame in json.loads((folder / "transforms_train.json").read_text())["frames"]:
        camera.place(np.array(frame["transform_matrix"]), FOCAL, np.full(2, SIZE / 2))
        image = scene.integrator().render(scene, camera.sensor, 1, 16).numpy()
        found.append(image[image[..., 3] > 0.95][:, 4:7])
    return np.concatenate(found)

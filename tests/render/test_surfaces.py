"""Scene of ordinary shapes for rays, which is reused until a shape changes."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

from mi_ntf.render.transport import surfaces


def room() -> dict:
    """Return a floor as a mesh and two instances of a ball."""
    floor = mi.Mesh("floor", 4, 2)
    parameters = mi.traverse(floor)
    parameters["vertex_positions"] = np.float32([[-4, -1.5, -4], [4, -1.5, -4], [4, -1.5, 4], [-4, -1.5, 4]]).ravel()
    parameters["faces"] = np.uint32([[0, 2, 1], [0, 3, 2]]).ravel()
    parameters.update()
    group = {"type": "shapegroup", "ball": {"type": "sphere", "radius": 0.4}}
    places = {f"instance_{i}": {"type": "instance", "group": {"type": "ref", "id": "group"},
                                "to_world": mi.ScalarTransform4f().translate([1.6 - 3 * i, -0.9, 1])} for i in range(2)}
    return {"floor": floor, "group": group, **places}


@pytest.mark.parametrize("name", ["floor.vertex_positions", "group.ball.to_world", "instance_0.to_world"])
def test_shapes_are_built_again_when_one_moves(blobs, monkeypatch, name):
    built = []
    monkeypatch.setattr(surfaces, "_built", lambda shapes, make=surfaces._built: built.append(shapes) or make(shapes))
    scene = scenes.scene(blobs, scenes.nrf(samples=64), {"light": scenes.light("point")}, spp=4, size=16, shapes=room())
    parameters = mi.traverse(scene)
    first = scenes.render(scene)
    assert list(mi.traverse(scene).keys()) == list(parameters.keys())  # no shape has got another name
    for key in (k for k in parameters.keys() if k.endswith("reflectance.value")):
        parameters[key] = 0.3
    parameters.update()
    assert len(built) == 1 and scenes.render(scene)[..., :3].mean() < 0.99 * first[..., :3].mean()
    assert len(built) == 1
    key = next(k for k in parameters.keys() if k.endswith(name))
    value = parameters[key]
    parameters[key] = value + 0.3 if "positions" in key else value @ type(value)().translate([0.5, 0.3, 0])
    parameters.update()
    moved = scenes.render(scene)
    assert len(built) == 2 and np.abs(moved - first).max() > 0.1


def test_no_render_of_the_same_scene_compiles_again(blobs):
    """Another integrator object compiles nothing either, though it shares nothing that was built."""
    pane = {"type": "rectangle", "bsdf": {"type": "mask", "opacity": 0.5, "nested": {"type": "diffuse"}},
            "to_world": mi.ScalarTransform4f().translate([0, 0, 1.5])}
    lights = {"light": scenes.light("point"), "lamp": {"type": "point", "position": [2, 3, -1]}}
    scene = scenes.scene(blobs, scenes.nrf(samples=64), lights, spp=2, size=12, shapes={"pane": pane})
    compiled = []
    for _ in range(3):
        integrator = mi.load_dict({"type": "nrf", "samples": 64, "visibility": "raymarch"})
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history_clear()
            dr.eval(mi.render(scene, integrator=integrator, seed=1))
            dr.sync_thread()
            hashes = {k["hash"] for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT}
        compiled.append(hashes)
    assert compiled[2] <= compiled[0] | compiled[1]


def test_scenes_of_shapes_share_one_emitter():
    """The number of emitters that exist is part of the code of kernels that call emitters."""
    ball = mi.load_dict({"type": "sphere"})
    one, other = (surfaces._built([ball]) for _ in range(2))
    assert one.emitters()[0].ptr == other.emitters()[0].ptr


def test_nothing_shines_at_depth_0(blobs):
    lamp = {"lamp": {"type": "sphere", "center": [1.5, 0.5, 0.3], "radius": 0.3, "emitter": {"type": "area"}}}
    loaded = scenes.scene(blobs, {"type": "nrf", "visibility": "raymarch", "max_depth": 0}, lamp, size=16)
    assert not scenes.render(loaded)[..., :3].any()

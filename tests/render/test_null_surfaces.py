"""Surfaces that let light through before lights, fields and the camera, against stock ``volpath``."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest
from helpers.programs import run_program
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError

SEEDS = 4
CENTER = np.array(scenes.SIMILARITY.center)
CHECKER = {"type": "checkerboard", "color0": 0.1, "color1": 0.9,
           "to_uv": mi.scalar_rgb.ScalarTransform3f().scale(6.0)}
LEAF = {"type": "mask", "opacity": CHECKER, "nested": {"type": "twosided", "bsdf": {
    "type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.6, 0.3]}}}}
PANE = {"type": "thindielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.6, 0.3]}}


def sheet(place, size: float, bsdf: dict) -> dict:
    """Return a square of half side `size` that faces the object, at `place` relative to its centre."""
    look = mi.ScalarTransform4f().look_at((CENTER + place).tolist(), CENTER.tolist(), [0, 1, 0.1])
    return {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(size), "bsdf": bsdf}


def lamp() -> dict:
    return {**sheet([2.5, 3.0, 2.0], 0.7, {"type": "diffuse"}), "emitter": {"type": "area", "radiance": 20.0}}


TO_LIGHT, TO_CAMERA = [1.6, 1.7, 1.1], [0.6, 0.75, 2.5]
FLOOR = {"type": "rectangle", "bsdf": {"type": "diffuse"}, "to_world": mi.scalar_rgb.ScalarTransform4f()
         .translate([0.4, -1.5, 0.3]).rotate([1, 0, 0], -90).scale(4)}
CASES = {
    "leaf, point": (lambda: {"leaf": sheet(TO_LIGHT, 1.2, LEAF)}, ["point"], {}),
    "pane, directional": (lambda: {"pane": sheet(TO_LIGHT, 1.2, PANE)}, ["directional"], {}),
    "leaf and floor, area": (lambda: {"leaf": sheet(TO_LIGHT, 1.0, LEAF), "floor": FLOOR, "lamp": lamp()}, [], {}),
    "two panes at the camera, point": (
        lambda: {"near": sheet(TO_CAMERA, 0.5, PANE), "far": sheet([0.5, 0.6, 1.9], 0.6, LEAF)}, ["point"], {}),
    "null case, sky": (
        lambda: {"case": {"type": "sphere", "center": CENTER.tolist(), "radius": 3.0, "bsdf": {"type": "null"}}},
        ["env"], {}),
    "null case around the camera, depth 3": (
        lambda: {"case": {"type": "sphere", "center": CENTER.tolist(), "radius": 9.0, "bsdf": {"type": "null"}},
                 "floor": FLOOR}, ["point"], {"max_depth": 3}),
    "leaf at the camera, sky, all depths": (
        lambda: {"leaf": sheet(TO_CAMERA, 0.7, LEAF), "floor": FLOOR}, ["env"], {"max_depth": -1}),
    "leaf above, area, depth 3": (
        lambda: {"leaf": sheet(TO_LIGHT, 1.0, LEAF), "floor": {**FLOOR, "bsdf": {"type": "roughconductor"}},
                 "lamp": lamp()}, [], {"max_depth": 3}),
    "panes, emitters alone": (
        lambda: {"pane": sheet(TO_CAMERA, 0.6, PANE), "lamp": {**lamp(), "to_world": sheet(
            [-0.5, -0.5, -3], 1.0, {})["to_world"]}}, ["env"], {"max_depth": 1}),
}


SLOW = "leaf and floor, area", "null case around the camera, depth 3", "leaf at the camera, sky, all depths"


@pytest.mark.parametrize("case", [pytest.param(c, marks=[pytest.mark.slow] * (c in SLOW)) for c in CASES])
def test_agrees_with_volpath(blobs, case):
    """The z-test is per 4×4 block; means of 8×8 blocks agree within 2 % and four times their noise."""
    shapes, lights, options = CASES[case]
    draws = {"light_samples": 2} if "env" in lights else {}
    lights = {name: scenes.light(name) for name in lights}

    def renders(integrator, spp):
        loaded = scenes.scene(blobs, integrator, lights, spp=spp, size=24, shapes=shapes())
        return np.array([scenes.render(loaded, seed) for seed in range(SEEDS)])

    depth = {"max_depth": 2, **options}
    ours = renders({"type": "nrf", "visibility": "raymarch", "samples": 512, **draws, **depth}, 64)
    theirs = renders({"type": "volpath", **depth}, 1024)
    ztest.check(list(ours[..., :3]), list(theirs[..., :3]), case, block=4)
    np.testing.assert_allclose(ours[..., 3].mean(), theirs[..., 3].mean(), atol=5e-3)
    noise = np.hypot(*(np.std([ztest.block_means(i[..., :3], 8).sum(-1) for i in images], axis=0) / np.sqrt(SEEDS)
                       for images in (ours, theirs)))
    a, b = (ztest.block_means(i.mean(0)[..., :3], 8).sum(-1) for i in (ours, theirs))
    assert (np.abs(a - b) < 0.02 * np.maximum(b, 0.3 * b.max()) + 4 * noise).all()


def test_further_outputs_behind_a_pane(blobs):
    """Depth, normals and visibility behind a sheet have the fraction of the rays that cross it."""
    names = "depth, normal, albedo, opacity, visibility_lights"
    clear = {**LEAF, "opacity": 0.25, "nested": {"type": "diffuse"}}

    def outputs(shapes):
        loaded = scenes.scene(blobs, scenes.nrf(aovs=names), {"l": scenes.light("directional")}, spp=64, size=16,
                              shapes=shapes)
        return np.array(mi.render(loaded))[..., 4:]

    bare = outputs({})
    shown = outputs({"pane": sheet(TO_CAMERA, 0.9, {**clear, "opacity": 1e-6})})
    np.testing.assert_allclose(shown, bare, atol=0.01)  # samples lie elsewhere where marches begin at the pane
    half = outputs({"pane": sheet(TO_CAMERA, 0.9, clear)})
    inside = bare[..., 7] > 0.99
    near = 5.34 - np.linalg.norm(TO_CAMERA)  # where the camera's axis meets the pane, about
    np.testing.assert_allclose(half[inside][:, 0].mean(), (0.75 * bare[inside][:, 0] + 0.25 * near).mean(), rtol=0.02)
    np.testing.assert_allclose(half[inside][:, 7], 1, atol=0.01)
    np.testing.assert_allclose(half[inside][:, 8].mean(), bare[inside][:, 8].mean(), atol=0.01)


def test_runs_of_lights_behind_a_pane(blobs):
    """Each run of lights has its own choice of rays that cross the pane."""
    lights = {str(i): {**scenes.light("directional"), "direction": [-1, -1.2, 0.4 * i - 0.6]} for i in range(3)}
    shapes = {"pane": sheet(TO_CAMERA, 0.6, LEAF)}

    def pictures(memory):
        loaded = scenes.scene(blobs, scenes.nrf("transmittance_map", map_resolution=64, map_memory=memory), lights,
                              spp=64, size=16, shapes=shapes)
        return [scenes.render(loaded, seed) for seed in range(SEEDS)]

    ztest.check(pictures(1024.0), pictures(0.05), "runs of lights", block=4)


def test_places_of_lights_have_no_derivatives_through_surfaces(blobs):
    """Derivatives are refused, since the slope of a mask's own opacity would be missing."""
    scene = scenes.scene(blobs, scenes.nrf(), {"light": scenes.light("point")}, size=4, spp=1,
                         shapes={"leaf": sheet(TO_LIGHT, 1.2, LEAF)})
    parameters = mi.traverse(scene)
    place = mi.Point3f(parameters["light.position"])
    dr.enable_grad(place)
    parameters["light.position"] = place
    parameters.update()
    with pytest.raises(MiNtfError, match=r"gradients by light\.position: not supported beside surfaces that let light"):
        scene.integrator().render(scene)


def test_no_kernel_depends_on_how_many_rays_cross(blobs, tmp_path):
    """With another seed, and other numbers of rays behind each of four masks, every kernel is in the cache.

    It runs in its own process, since scheduled work of other tests would be part of kernels.
    """
    script = (f"import sys; sys.path[:0] = {[str(Path(__file__).parents[1]), str(Path(__file__).parent)]!r}\n"
              f"import mitsuba as mi; mi.set_variant({VARIANT!r})\nimport mi_ntf.render; mi_ntf.render.register()\n"
              "import test_null_surfaces; print(test_null_surfaces.compiled_by_another_seed(sys.argv[1]))")
    done = run_program("python", "-c", script, blobs, cwd=tmp_path)
    assert done.stdout.strip() == "[]", done.stdout + done.stderr


def compiled_by_another_seed(path) -> list:
    """Print the sizes of the kernels that a second picture of four masks compiles."""
    sheets = {str(i): sheet((1 - 0.1 * i) * np.array(TO_CAMERA), 0.9, {**LEAF, "opacity": 0.3}) for i in range(4)}
    scene = scenes.scene(path, scenes.nrf(samples=64), {"light": scenes.light("point")}, size=16, spp=16, shapes=sheets)
    scenes.render(scene, 0)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        scenes.render(scene, 1)
        return [k["size"] for k in dr.kernel_history([dr.KernelType.JIT]) if not k["cache_hit"]]

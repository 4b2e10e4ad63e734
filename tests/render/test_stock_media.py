"""Mitsuba's own participating media in the ``nrf`` integrator, beside closed forms and stock ``volpath``."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers import scenes, ztest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer.convex import planes_of
from mi_ntf.render.scene.media import find_media

POINT = {"type": "point", "position": [2, 3, 2], "intensity": {"type": "rgb", "value": [30, 25, 20]}}
COLOURS = {"type": "rgb", "value": [0.9, 0.5, 0.2]}
DEEP = 10.0 ** np.arange(-3, 5)


def turned(degrees: float) -> mi.ScalarTransform4f:
    """Return a rotation about a slanted axis."""
    return mi.ScalarTransform4f().rotate([0.6, 0.8, 0], degrees)


def puff(n: int = 24) -> np.ndarray:
    """Return a smooth density (z, y, x) that is empty outside of a ball."""
    z, y, x = np.meshgrid(*[np.linspace(-1, 1, n)] * 3, indexing="ij")
    waves = 1 + 0.8 * np.sin(7 * x + 3 * y) * np.cos(5 * z)
    return (np.clip(1 - np.sqrt(x * x + y * y + z * z), 0, None) * waves).astype(np.float32)


def smoke(scale: float = 4.0, phase: dict | None = None, degrees: float = 0.0) -> dict:
    """Return a ``heterogeneous`` medium of a puff, with a coloured albedo."""
    return {"type": "heterogeneous", "scale": scale, "phase": phase or {"type": "isotropic"},
            "sigma_t": {"type": "gridvolume", "grid": mi.VolumeGrid(puff()),
                        "to_world": turned(degrees).translate(-1).scale(2)},
            "albedo": {"type": "constvolume", "value": COLOURS}}


def fog(sigma: float, phase: dict | None = None) -> dict:
    """Return a ``homogeneous`` medium of this extinction."""
    return {"type": "homogeneous", "sigma_t": 1.0, "scale": sigma, "albedo": COLOURS,
            "phase": phase or {"type": "isotropic"}}


def scene(integrator: dict, shape: dict, medium: dict, light: dict, sensor: dict) -> mi.Scene:
    """Return a scene of one medium inside `shape`."""
    if "to_world" in shape:
        shape = shape | {"to_world": turned(shape["to_world"])}
    bounded = {**shape, "bsdf": {"type": "null"}, "interior": medium}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, "light": light,
                         "bounded": bounded})


def lens(size: int = 16) -> dict:
    """Return a camera that sees a box of side 2 at the origin."""
    to_world = mi.ScalarTransform4f().look_at([0.5, 1.0, 4], [0, 0, 0], [0, 1, 0])
    return {"type": "perspective", "fov": 40, "to_world": to_world,
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"},
                     "pixel_format": "rgba"}, "sampler": {"type": "independent", "sample_count": 16}}


CASES = {
    "smoke, forward lobe": ({"type": "cube"}, lambda: smoke(8.0, {"type": "hg", "g": 0.7}), 2),
    "smoke, backward lobe": ({"type": "cube"}, lambda: smoke(8.0, {"type": "hg", "g": -0.9}), 2),
    "blended lobes": ({"type": "cube"}, lambda: smoke(8.0, {"type": "blendphase", "weight": 0.3,
                                                           "a": {"type": "hg", "g": 0.8}, "b": {"type": "isotropic"}}),
                      2),
    "tabulated lobe": ({"type": "cube"}, lambda: smoke(8.0, {"type": "tabphase", "values": "0.2, 0.5, 1.0, 0.4, 3.0"}),
                       2),
    "turned grid": ({"type": "cube", "to_world": 30}, lambda: smoke(degrees=30.0), 2),
    "fog in a turned box": ({"type": "cube", "to_world": 35}, lambda: fog(4.0, {"type": "rayleigh"}), 2),
    "fog in a ball": ({"type": "sphere"}, lambda: fog(1.0), 2),
    "five edges": ({"type": "cube"}, smoke, 5),
}


@pytest.mark.parametrize("case", CASES)
def test_swapping_the_integrator_keeps_the_picture(case):
    """Every case passes a z-test against stock ``volpath`` with the same XML."""
    shape, medium, depth = CASES[case]

    def pictures(integrator: dict, spp: int) -> list:
        loaded = scene({**integrator, "max_depth": depth}, shape, medium(), POINT, sensor=lens())
        return [np.array(mi.render(loaded, spp=spp, seed=1000 * s + 7))[..., :3] for s in range(4)]

    ztest.check(pictures({"type": "nrf", "visibility": "raymarch"}, 64), pictures({"type": "volpath"}, 1024), case,
                block=4)


@pytest.mark.parametrize("method", ["transmittance_map", "transmittance_volume", "transmittance_atlas"])
def test_lookups_agree_with_marching(method):
    """Tables follow smoke to 2 % in blocks of the picture."""

    def picture(visibility: str) -> np.ndarray:
        medium = smoke(8.0, {"type": "hg", "g": 0.5})
        loaded = scene({"type": "nrf", "visibility": visibility}, {"type": "cube"}, medium, POINT, lens())
        return np.array(mi.render(loaded, spp=64, seed=3))[..., :3]

    assert ztest.block_difference(picture(method), picture("raymarch"), 4).max() < 0.02


@pytest.mark.parametrize("method", ["transmittance_map", "transmittance_volume", "transmittance_atlas"])
@pytest.mark.parametrize("depth", [100.0, 1e4])
def test_lookups_in_dense_media(method, depth):
    """Where a texel is thicker than a mean free path, its part of a ray is marched: blocks are right to 6 %.

    Lookups alone err by 20 to 180 % there.
    """
    def picture(visibility: str) -> np.ndarray:
        loaded = scene({"type": "nrf", "visibility": visibility}, {"type": "cube", "to_world": 30}, fog(depth / 2),
                       POINT, lens())
        return np.array(mi.render(loaded, spp=16, seed=3))[..., :3]

    assert ztest.block_difference(picture(method), picture("raymarch"), 4, 0.2).max() < 0.06


@pytest.mark.parametrize("shape", ["cube", "sphere"])
@pytest.mark.parametrize("depth", DEEP, ids=lambda d: f"{d:g}")
def test_optical_depths(shape, depth):
    """Opacity and light of a slab and a ball equal their closed forms from depth 10⁻³ to 10⁴.

    The sun shines along the rays of the camera, so a ray of length s returns albedo/(8π) (1 − e^(−2 σ s)). The noise of
    65 536 samples is 0.2 %. At depth 10⁻³ single precision rounds the sum over 384 cells by 0.6 %.
    """
    size = 16
    camera = lens(size) | {"type": "orthographic", "to_world": mi.ScalarTransform4f().look_at(
        [0, 0, 5], [0, 0, 0], [0, 1, 0]).scale([0.5, 0.5, 1])}
    camera.pop("fov")
    sun = {"type": "directional", "direction": [0, 0, -1], "irradiance": 1.0}
    loaded = scene({"type": "nrf", "visibility": "raymarch"}, {"type": shape}, fog(depth / 2), sun, sensor=camera)
    image = np.array(mi.render(loaded, spp=256))
    x, y = np.meshgrid(*[(np.arange(16 * size) + 0.5) / (16 * size) - 0.5] * 2)
    length = 2 * np.sqrt(1 - x * x - y * y) if shape == "sphere" else np.full_like(x, 2.0)
    opacity = np.mean(1 - np.exp(-depth / 2 * length))
    light = 0.9 / (8 * np.pi) * np.mean(1 - np.exp(-depth * length))
    tolerance = 8e-3 if depth < 2e-3 else 1e-3
    assert abs(image[..., 3].mean() / opacity - 1) < tolerance
    assert abs(image[..., 0].mean() / light - 1) < tolerance + 3 * 0.002 * (depth > 20)


def ply(folder: Path, vertices: np.ndarray, faces: np.ndarray) -> dict:
    """Return a mesh of these vertices and faces."""
    mesh = mi.Mesh("mesh", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.astype(np.float32).ravel(), np.ravel(faces)
    parameters.update()
    path = folder / "mesh.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


def elbow() -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a closed mesh: a prism over an L."""
    outline = np.array([[-1, -1], [1, -1], [1, 0], [0, 0], [0, 1], [-1, 1]], float)
    vertices = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (-0.6, 0.6)])
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [(a, c, b) for a, b, c in top] + [(a + 6, b + 6, c + 6) for a, b, c in top]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    return vertices, np.array(faces)


def ball(bumps: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return vertices and faces of a ball of 20 480 triangles, or of one with hollows and bumps."""
    mesh = trimesh.creation.icosphere(5)
    x, y, z = mesh.vertices.T
    radius = 1 - bumps * (0.6 - np.sin(4 * x + 1) * np.cos(5 * y) * np.sin(3 * z + 2) - 0.4 * np.cos(9 * x))
    return np.array(mesh.vertices * radius[:, None]), np.array(mesh.faces, np.uint32)


@pytest.mark.parametrize("shape", [elbow, lambda: ball(0.2)], ids=["elbow", "bumps"])
def test_a_mesh_bounds_a_medium(shape, tmp_path):
    """Fog inside a mesh that is not convex passes a z-test against ``volpath``; block means agree within 2 %."""
    mesh = ply(tmp_path, *shape())

    def pictures(integrator: dict, spp: int) -> list:
        loaded = scene({**integrator, "max_depth": 2}, mesh, fog(2.0), POINT, sensor=lens())
        return [np.array(mi.render(loaded, spp=spp, seed=1000 * s + 7))[..., :3] for s in range(4)]

    ours, theirs = pictures({"type": "nrf", "visibility": "raymarch"}, 64), pictures({"type": "volpath"}, 2048)
    ztest.check(ours, theirs, "mesh", block=4)
    assert ztest.block_difference(np.mean(ours, 0), np.mean(theirs, 0), 4, 0.2).max() < 0.03  # noise of volpath


def test_dense_fog_in_a_mesh_of_a_ball(tmp_path):
    """Fog 40 mean free paths thick in a mesh of a ball has the light of fog in the shape ``sphere`` within 1.5 %.

    There is no comparison with ``volpath``, which is 0.7 % too dark at this depth and 26 % at 2000.
    """
    means = [np.mean(mi.render(scene({"type": "nrf", "visibility": "raymarch"}, shape, fog(20.0), POINT, lens()),
                               spp=64)) for shape in (ply(tmp_path, *ball()), {"type": "sphere"})]
    assert abs(means[0] / means[1] - 1) < 0.015


SUN = {"type": "directional", "direction": [0.2, -1, 0.3], "irradiance": 3.0}
SKY = {"type": "constant", "radiance": 0.7}


def bounded(medium: dict, **shape) -> dict:
    """Return a shape around the object of the scenes' helper, with a medium inside."""
    return {"type": "sphere", "center": [0.4, -0.2, 0.3], "radius": 1.5, "bsdf": {"type": "null"}, **shape,
            "interior": medium}


@pytest.mark.parametrize("light", [SUN, SKY], ids=["sun", "sky"])
@pytest.mark.parametrize("integrator", ["path", "direct"])
def test_smoke_casts_its_shadow_on_a_floor(light, integrator):
    """Stock ``path`` or ``direct`` under an ``ntf`` light equals stock ``volpath`` with the medium in the scene."""
    shape, diffuse = bounded(fog(1.2)), {"type": "diffuse"}
    wrapped = {"type": "ntf", "visibility": "raymarch", "light": light, "smoke": shape}
    ours = scenes.floor({"type": integrator}, {"light": wrapped}, diffuse)
    theirs = scenes.floor({"type": "volpath", "max_depth": 2}, {"light": light}, diffuse, smoke=shape)
    images = [[scenes.render(s, seed, spp)[..., :3] for seed in range(4)] for s, spp in ((ours, 128), (theirs, 1024))]
    ztest.check(*images, f"shadow under {integrator}", block=2)
    bare = scenes.render(scenes.floor({"type": integrator}, {"light": light}, diffuse), 0, 128)[..., :3]
    with pytest.raises(AssertionError, match="values pass"):
        ztest.check([bare] * 4, images[1], "without a shadow", block=2)


@pytest.mark.parametrize(("light", "method", "tolerance"), [
    (SUN, "transmittance_map", 0.02), (SKY, "transmittance_atlas", 0.02), (SUN, "transmittance_volume", 0.02)],
    ids=["map", "atlas", "volume"])
def test_shadows_of_smoke_are_looked_up(light, method, tolerance):
    """Lookups of the shadow on a floor differ from the march by 2 % of the light without smoke at most, RMS."""
    bare, march, lookup = (scenes.render(scenes.floor(
        {"type": "direct"}, {"light": {"type": "ntf", "visibility": visibility, "light": light,
                                       "smoke": bounded(fog(1.2))}}, {"type": "diffuse"}), 0, 64)[..., :3]
        for visibility in ("none", "raymarch", method))
    assert np.sqrt(((lookup - march) ** 2).mean() / (bare**2).mean()) < tolerance


def test_a_medium_in_the_scene_is_shadowed_once():
    """The ``nrf`` integrator takes the bare light of an ``ntf`` emitter whose medium is in the scene."""
    shape = bounded(fog(1.2))
    wrapped = {"type": "ntf", "light": SUN, "smoke": shape}
    once, twice = (scenes.render(scenes.floor({"type": "nrf", "visibility": "raymarch"}, {"light": light},
                                              {"type": "diffuse"}, smoke=shape), 0, 32)[..., :3]
                   for light in (SUN, wrapped))
    np.testing.assert_allclose(twice, once, rtol=1e-4, atol=1e-5)


def test_the_shadow_follows_the_parameters_of_the_medium():
    """The extinction of a nested medium is a parameter of the scene."""
    loaded = scenes.floor({"type": "direct"}, {"light": {"type": "ntf", "light": SUN, "smoke": bounded(fog(1.2))}},
                          {"type": "diffuse"})
    before = scenes.render(loaded, 0, 16)[..., :3].mean()
    parameters = mi.traverse(loaded)
    parameters["light.shape.interior_medium.scale"] = 0.01
    parameters.update()
    assert scenes.render(loaded, 0, 16)[..., :3].mean() > 1.1 * before


@pytest.mark.parametrize(("nested", "text"), [
    (lambda: fog(1.0), "no place for a nested HomogeneousMedium; it takes a light and an nrf medium, or a light and a"),
    (lambda: {"type": "sphere"}, "has no medium inside"),
    (lambda: {"type": "cylinder", "interior": fog(1.0)}, "media fill spheres, cubes and closed meshes alone"),
    (lambda: {"type": "sphere", "exterior": fog(1.0)}, "has an exterior medium")])
def test_what_casts_no_shadow_is_told(nested, text):
    with pytest.raises((MiNtfError, RuntimeError), match=text):
        mi.load_dict({"type": "scene", "light": {"type": "ntf", "light": SUN, "smoke": nested()}})


def test_a_medium_stands_beside_a_field(blobs):
    """A medium out of the field's way adds its light, and a field in front of it shadows it."""
    around = {"fog": {"type": "sphere", "center": [0.4, -0.2, 0.3], "radius": 1.6, "bsdf": {"type": "null"},
                      "interior": fog(0.05)}}
    alone, both = (mi.render(scenes.scene(blobs, scenes.nrf(visibility="raymarch"), {"light": POINT}, size=16,
                                          shapes=shapes), spp=32) for shapes in ({}, around))
    assert 1.0 < np.mean(both) / np.mean(alone) < 3.0


def refused(shape: dict, medium: dict, integrator: dict | None = None) -> str:
    with pytest.raises((MiNtfError, RuntimeError)) as caught:
        mi.render(scene(integrator or {"type": "nrf"}, shape, medium, POINT, sensor=lens(4)), spp=1)
    return str(caught.value)


def test_what_media_cannot_do_is_told():
    coloured = fog(1.0) | {"sigma_t": {"type": "rgb", "value": [0.1, 0.2, 0.3]}}
    assert "another sigma_t in each colour channel" in refused({"type": "cube", "id": "box"}, coloured)
    assert "each direction another extinction" in refused({"type": "cube"}, fog(1.0, {"type": "sggx", "S": {
        "type": "gridvolume", "grid": mi.VolumeGrid(np.ones((1, 1, 1, 6), np.float32))}}))
    assert "no trained field" in refused({"type": "cube"}, fog(1.0), {"type": "nrf", "visibility": "ray_network"})
    assert "no trained field" in refused({"type": "cube"}, fog(1.0), {"type": "nrf", "map_source": "network",
                                                                     "visibility": "transmittance_map"})


def test_a_medium_without_an_end_is_refused():
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": fog(1.0), "exterior": fog(1.0)}
    with pytest.raises(MiNtfError, match="has an exterior medium"):
        find_media(mi.load_dict({"type": "scene", "ball": ball}))


@pytest.mark.parametrize("bsdf", ["thindielectric", "roughdielectric"])
def test_a_surface_bounds_a_medium(bsdf):
    """Fog in glass has the light of ``volpath``, whose surface reflects and refracts."""
    ball = {"type": "sphere", "bsdf": {"type": bsdf}, "interior": fog(1.0)}

    def pictures(integrator: dict, spp: int) -> list:
        loaded = mi.load_dict({"type": "scene", "integrator": {**integrator, "max_depth": 5}, "sensor": lens(),
                               "light": {"type": "constant"}, "ball": ball})
        return [np.array(mi.render(loaded, spp=spp, seed=1000 * s + 7))[..., :3] for s in range(4)]

    ztest.check(pictures({"type": "nrf", "visibility": "raymarch", "light_samples": 2}, 64),
                pictures({"type": "volpath"}, 256), bsdf, block=4)


def test_the_same_medium_is_sampled_once(blobs):
    loaded = scene({"type": "nrf"}, {"type": "cube"}, smoke(), POINT, sensor=lens(4))
    first, again = find_media(loaded)[0], find_media(loaded)[0]
    assert first.source is again.source
    parameters = mi.traverse(loaded)
    key = next(k for k in parameters.keys() if k.endswith("interior_medium.scale"))
    parameters[key] = 2.0
    parameters.update()
    assert find_media(loaded)[0].source.majorant == pytest.approx(first.source.majorant / 2)


@pytest.mark.parametrize(("outline", "triangles"), [
    ([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)]),
    ([(0, 0), (3, 0), (3, 2), (2, 2), (2, 1), (1, 1), (1, 2), (0, 2)],
     [(0, 1, 4), (0, 4, 5), (0, 5, 6), (0, 6, 7), (1, 2, 3), (1, 3, 4)])], ids=["L", "U"])
def test_a_step_makes_a_mesh_concave(rng, outline, triangles):
    """Faces of a step are parallel to the outer ones, whatever their order."""
    body = trimesh.creation.extrude_triangulation(np.array(outline, float), np.array(triangles), 1.0)
    for _ in range(20):
        assert planes_of(body.vertices, body.faces[rng.permutation(len(body.faces))]) is None
    whole = body.convex_hull
    assert planes_of(whole.vertices, whole.faces) is not None

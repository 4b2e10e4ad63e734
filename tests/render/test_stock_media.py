"""Mitsuba's own participating media in the ``nrf`` integrator, beside closed forms and stock ``volpath``."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest

from mi_ntf.core.errors import MiNtfError
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
    """Two logistics a texel follow smoke to 2 % in blocks of the picture."""

    def picture(visibility: str) -> np.ndarray:
        medium = smoke(8.0, {"type": "hg", "g": 0.5})
        loaded = scene({"type": "nrf", "visibility": visibility}, {"type": "cube"}, medium, POINT, lens())
        return np.array(mi.render(loaded, spp=64, seed=3))[..., :3]

    assert ztest.block_difference(picture(method), picture("raymarch"), 4).max() < 0.02


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


def test_a_mesh_bounds_a_medium(tmp_path):
    """Fog inside an L-shaped mesh, which is not convex, has the light of ``volpath`` within 2 %."""
    def picture(integrator: dict, spp: int) -> np.ndarray:
        loaded = scene(integrator, elbow(tmp_path), fog(2.0), POINT, sensor=lens())
        return np.mean([np.array(mi.render(loaded, spp=spp, seed=s))[..., :3] for s in range(2)], 0)

    ours, theirs = picture({"type": "nrf"}, 64), picture({"type": "volpath", "max_depth": 2}, 1024)
    assert abs(ours.mean() / theirs.mean() - 1) < 0.02
    assert ztest.block_difference(ours, theirs, 4, 0.2).max() < 0.06  # noise of volpath


def elbow(folder: Path) -> dict:
    """Return a closed mesh: a prism over an L."""
    outline = np.array([[-1, -1], [1, -1], [1, 0], [0, 0], [0, 1], [-1, 1]], float)
    vertices = np.concatenate([np.column_stack([outline, np.full(6, z)]) for z in (-0.6, 0.6)])
    top = [(0, 1, 2), (0, 2, 3), (0, 3, 5), (3, 4, 5)]
    faces = [(a, c, b) for a, b, c in top] + [(a + 6, b + 6, c + 6) for a, b, c in top]
    for i in range(6):
        j = (i + 1) % 6
        faces += [(i, j, j + 6), (i, j + 6, i + 6)]
    mesh = mi.Mesh("elbow", len(vertices), len(faces))
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"], parameters["faces"] = vertices.astype(np.float32).ravel(), np.ravel(faces)
    parameters.update()
    path = folder / "elbow.ply"
    mesh.write_ply(str(path))
    return {"type": "ply", "filename": str(path)}


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

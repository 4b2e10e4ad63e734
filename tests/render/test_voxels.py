"""Fields of voxels beside stock ``volpath`` on the grid that they were imported from, and beside closed forms."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest

import mi_ntf
from mi_ntf.core import voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import grids
from mi_ntf.exported_grid import export
from mi_ntf.importing import import_grid
from mi_ntf.infer import bricks
from mi_ntf.infer.visibility import REGISTRY

BOUNDS = np.array([[-0.6, -1.0, -0.8], [1.0, 0.7, 0.9]])
"""The box of the grid. Its voxels have three lengths."""
LIGHTS = {"point": scenes.light("point"), "constant": {"type": "constant", "radiance": 0.7}}
UNTRAINED = ("raymarch", "transmittance_map", "transmittance_volume", "transmittance_atlas", "auto")


def puff() -> np.ndarray:
    """Return a density (z, y, x) of 14 × 16 × 17 voxels that reaches two faces of its box."""
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in (14, 16, 17)), indexing="ij")
    waves = 1 + 0.8 * np.sin(7 * x + 3 * y) * np.cos(5 * z)
    return (3 * np.clip(1 - np.sqrt((x - 0.3) ** 2 + (y + 0.2) ** 2 + z * z), 0, None) * waves).astype(np.float32)


def colours() -> np.ndarray:
    """Return an albedo (z, y, x, 3) of fewer voxels."""
    z, y, x = np.meshgrid(*(np.linspace(0, 1, n) for n in (5, 4, 6)), indexing="ij")
    return np.stack([0.3 + 0.6 * x, 0.9 - 0.5 * y, 0.2 + 0.7 * z], -1).astype(np.float32)


@pytest.fixture(scope="module")
def files(tmp_path_factory) -> dict[str, Path]:
    """Return the grid, its albedo, and the field that was imported from both."""
    mi_ntf.Field.from_grid(np.ones((2, 2, 2)))  # sets a variant
    folder = tmp_path_factory.mktemp("grid")
    paths = {name: folder / f"{name}.vol" for name in ("density", "albedo")}
    grids.write_vol(paths["density"], puff(), BOUNDS)
    mi.VolumeGrid(colours()).write(str(paths["albedo"]))
    field = folder / "field.safetensors"
    import_grid(paths["density"], field, scale=2.0, albedo=str(paths["albedo"]), phase=0.6)
    return {**paths, "field": field}


def stock(files: dict[str, Path]) -> dict:
    """Return Mitsuba's own medium of the grid and its albedo, in the box of the grid."""
    box = mi.ScalarTransform4f().translate(BOUNDS[0].tolist()).scale((BOUNDS[1] - BOUNDS[0]).tolist())
    volumes = {name: {"type": "gridvolume", "filename": str(files[key]), "raw": True, "to_world": box}
               for name, key in (("sigma_t", "density"), ("albedo", "albedo"))}
    return {"type": "heterogeneous", "scale": 2.0, "phase": {"type": "hg", "g": 0.6}, **volumes}


def pictures(medium: dict, integrator: dict, light: str, spp: int, seeds: int = 4) -> list[np.ndarray]:
    """Return pictures of a medium in the box of the grid."""
    centre, half = BOUNDS.mean(0).tolist(), (np.ptp(BOUNDS, axis=0) / 2).tolist()
    loaded = mi.load_dict({
        "type": "scene", "integrator": {**integrator, "max_depth": 2, "hide_emitters": True}, "light": LIGHTS[light],
        "sensor": {"type": "perspective", "fov": 35, "film": scenes.film(16),
                   "to_world": mi.ScalarTransform4f().look_at([1.5, 1.0, 4], centre, [0, 1, 0])},
        "box": {"type": "cube", "to_world": mi.ScalarTransform4f().translate(centre).scale(half),
                "bsdf": {"type": "null"}, "interior": medium}})
    return [np.array(mi.render(loaded, spp=spp, seed=1000 * s + 3))[..., :3] for s in range(seeds)]


@pytest.fixture(scope="module")
def references(files) -> dict[str, list[np.ndarray]]:
    """Return stock ``volpath``'s pictures of the grid under each light."""
    return {light: pictures(stock(files), {"type": "volpath"}, light, 1024) for light in LIGHTS}


@pytest.mark.parametrize("light", LIGHTS)
@pytest.mark.parametrize("integrator", ["nrf", "volpath"])
def test_an_imported_grid_renders_as_mitsubas_own(files, references, integrator, light):
    """Extinction, albedo, box and phase function of the field agree with ``gridvolume`` and ``hg``, by a z-test."""
    medium = {"type": "nrf", "filename": str(files["field"])}
    marched = {"type": "nrf", "visibility": "raymarch", "light_samples": 4}
    settings = marched if integrator == "nrf" else {"type": "volpath"}
    ztest.check(pictures(medium, settings, light, 64 if integrator == "nrf" else 1024), references[light],
                f"{integrator} {light}", block=4)


@pytest.mark.parametrize("method", UNTRAINED)
def test_lookups_serve_voxels(files, references, method):
    """The mean of each method's picture is within 2 % of ``volpath``'s."""
    medium = {"type": "nrf", "filename": str(files["field"])}
    (picture,) = pictures(medium, {"type": "nrf", "visibility": method}, "point", 64, seeds=1)
    reference = np.mean(references["point"], axis=0)
    assert abs(picture.mean() / reference.mean() - 1) < 0.02


@pytest.mark.parametrize("options, expected", [
    ({"visibility": "neural_transmittance"}, "no networks"),
    ({"visibility": "visibility_mlp"}, "no networks"),
    ({"visibility": "transmittance_map", "map_source": "network"}, "no networks"),
])
def test_methods_that_are_trained_are_refused(files, options, expected):
    """One sentence names the field and the methods that serve it."""
    with pytest.raises(Exception, match=expected):
        pictures({"type": "nrf", "filename": str(files["field"])}, {"type": "nrf", **options}, "point", 1, seeds=1)


@pytest.mark.parametrize("options, expected", [({"representation": "network"}, "choose grid"),
                                               ({"resolution": 64}, "leave resolution out")])
def test_the_medium_refuses_options_of_networks(files, options, expected):
    """The sentence names the property and the remedy."""
    with pytest.raises(Exception, match=expected):
        mi.load_dict(scenes.ball(files["field"], voxels.Voxels(*BOUNDS, (2, 2, 2)).similarity, **options))


def test_every_method_is_known_to_these_tests():
    """A new visibility method is either trained or tried here."""
    assert {*UNTRAINED, "none", "ray_network", "neural_transmittance", "visibility_mlp", "auto"} == {*REGISTRY, "auto"}


@pytest.mark.parametrize("sigma", [1e-3, 0.1, 1.0, 10.0])
def test_a_homogeneous_slab_has_the_closed_form(sigma):
    """The transmittance of a slab of thickness 0.5 is exp(−σ/2) for perpendicular rays, from voxels of one value."""
    field = mi_ntf.Field.from_grid(np.full((1, 3, 2), sigma), bounds=((0, 0, 0), (2, 2, 0.5)))
    rng = np.random.default_rng(1)
    origins = np.column_stack([rng.uniform(0.1, 1.9, (64, 2)), np.full(64, -1.0)])
    found = field.transmittance(origins, np.tile([0.0, 0.0, 1.0], (64, 1)))
    assert np.abs(found - np.exp(-sigma / 2)).max() < 1e-3  # measured: see the march's step


def test_a_function_becomes_the_same_field_as_its_grid():
    """Density and albedo at the centres of voxels are the function's; both give the same picture."""
    low, high = np.array([0.0, -1.0, 2.0]), np.array([1.0, 1.0, 3.0])

    def sigma(p: np.ndarray) -> np.ndarray:
        return 5 * p[:, 0] * (p[:, 1] + 1)

    def albedo(p: np.ndarray) -> np.ndarray:
        return np.stack([p[:, 0], 0 * p[:, 0] + 0.5, p[:, 2] - 2], 1)

    field = mi_ntf.Field.from_function(sigma, albedo, (low, high), phase=-0.3, resolution=20)
    rng = np.random.default_rng(3)
    points = low + (rng.integers(0, (10, 20, 10), (200, 3)) + 0.5) / 10 * [1, 1, 1]
    assert np.abs(field.density(points) - sigma(points)).max() < 1e-3
    assert np.abs(field.reflectance(points).albedo - albedo(points)).max() < 1e-3
    assert field.phase == -0.3
    z, y, x = np.meshgrid(*((np.arange(n) + 0.5) / 10 for n in (10, 20, 10)), indexing="ij")
    centres = low + np.stack([x, y, z], -1).reshape(-1, 3)
    grid = mi_ntf.Field.from_grid(sigma(centres).reshape(10, 20, 10), albedo(centres).reshape(10, 20, 10, 3),
                                  (low, high), phase=-0.3)
    first, second = (mi_ntf.relight(f, scenes.light("point"), size=16, spp=4) for f in (field, grid))
    assert first.mean() > 0.002 and np.allclose(first, second, rtol=1e-4, atol=1e-6)


def test_the_function_of_a_field_gets_its_shape_checked():
    """The sentence names the function and the shape."""
    with pytest.raises(MiNtfError, match="sigma returned an array of shape"):
        mi_ntf.Field.from_function(lambda p: np.zeros(3))


def test_a_freed_field_in_memory_is_one_sentence():
    """A scene that outlives its field cannot load it again."""
    field = mi_ntf.Field.from_grid(np.ones((2, 2, 2)))
    shape = field.shape()
    mi_ntf.clear_caches()
    del field
    with pytest.raises(Exception, match="was freed; keep the"):
        mi.load_dict(shape)


def test_export_and_import_return_the_same_voxels(files, tmp_path):
    """The bricks of extinction are equal word by word, and the file is readable for Mitsuba."""
    export(files["field"], tmp_path / "out.vol")
    import_grid(tmp_path / "out.vol", tmp_path / "again.safetensors", phase=0.6)
    first, again = (voxels.load(path, load_header(path)) for path in (files["field"], tmp_path / "again.safetensors"))
    for name in ("index", "words", "resolution"):
        assert (first[f"density.{name}"] == again[f"density.{name}"]).all()
    assert np.allclose(first["density.range"], again["density.range"], rtol=1e-6)
    read = np.array(mi.VolumeGrid(str(tmp_path / "out.vol")))
    assert np.abs(read.reshape(puff().shape) - 2 * puff()).max() < 2e-5 * puff().max()


def load_header(path: Path) -> voxels.Voxels:
    """Return the header of a field of voxels."""
    from mi_ntf.core.field_file import load_header

    header = load_header(path)
    assert isinstance(header, voxels.Voxels)
    return header


def surface_voxels(path: Path, folder: Path) -> Path:
    """Return a file of voxels of a trained field, with its reflectance as that of a surface."""
    field = mi_ntf.Field.load(path)
    n = 96
    low, high = field.center - field.radius, field.center + field.radius
    axis = (np.arange(n) + 0.5) / n
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    points = low + np.stack([x, y, z], -1).reshape(-1, 3) * (high - low)
    density = field.density(points).reshape(n, n, n, 1)
    surface = field.reflectance(points)
    values = np.column_stack([surface.normal, surface.albedo, surface.roughness, surface.specular]).reshape(n, n, n, 10)
    mask = density[..., 0] > 0
    header = voxels.Voxels(tuple(low.tolist()), tuple(high.tolist()), (n, n, n), (n, n, n), None)
    voxels.save(folder / "surface.safetensors", header, bricks.of_dense(density, mask),
                bricks.of_dense(values.astype(np.float32), mask))
    return folder / "surface.safetensors"


def test_voxels_reflect_as_a_surface(tmp_path):
    """Voxels sampled from a field of skins render like the field: the mean is within 5 %."""
    trained = scenes.write_blobs(tmp_path)
    field = mi_ntf.Field.load(surface_voxels(trained, tmp_path))
    origin, target = [0.4, -0.2, 6.0], [0.4, -0.2, 0.3]
    sensor = {"type": "perspective", "fov": 30, "film": scenes.film(32),
              "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 1, 0])}
    found, expected = (mi_ntf.relight(f, scenes.light("point"), sensor=sensor, visibility="raymarch",
                                      hide_emitters=True) for f in (field, mi_ntf.Field.load(trained)))
    assert expected.mean() > 0.01
    assert abs(found.mean() / expected.mean() - 1) < 0.05


def test_outliers_do_not_take_the_digits_of_a_grid():
    """One voxel of 10⁶ beside a density of 2."""
    density = np.full((16, 16, 16), 2.0)
    density[0, 0, 0] = 1e6
    field = mi_ntf.Field.from_grid(density, bounds=((-1, -1, -1), (1, 1, 1)))
    assert field.density([[0.5, 0.5, 0.5]]) == pytest.approx(2.0, rel=1e-3)


def test_dense_matter_is_no_outlier():
    """Voxels of optical depth 5000 that are all alike keep their extinction, which rays through corners see."""
    field = mi_ntf.Field.from_grid(np.full((2, 2, 2), 1e4), bounds=((0, 0, 0), (1, 1, 1)))
    assert field.density([[0.5, 0.5, 0.5]]) == pytest.approx(1e4, rel=1e-3)


@pytest.mark.parametrize("size", [1e-9, 1e12])
def test_density_has_the_same_digits_at_any_scale(size):
    """A cube of edge `size` and optical depth 1."""
    field = mi_ntf.Field.from_grid(np.full((2, 2, 2), 1 / size), bounds=((0, 0, 0), (size, size, size)))
    tau = field.transmittance(size * np.array([[0.5, 0.5, -1.0]]), [[0.0, 0.0, 1.0]])
    assert tau == pytest.approx(np.exp(-1), rel=2e-3)

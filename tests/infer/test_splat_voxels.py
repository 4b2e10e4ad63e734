"""Voxels of Gaussian splats, looked up by the march, against the sum of error functions."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from helpers.splats import on_mesh
from helpers.variants import VARIANT

from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.splats import Splats, density, optical_depth
from mi_ntf.field import Field
from mi_ntf.importing_splats import of_splats
from mi_ntf.infer import splat_field
from mi_ntf.infer.splat_voxels import THINNEST, TRILINEAR

MOST_ERROR = 3e-3
"""Largest root mean square error of the transmittance of random rays."""


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


def random_rays(field: Field, count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays from outside through points of the box of the matter, many of which pass the object."""
    rng = np.random.default_rng(seed)
    out = rng.normal(size=(count, 3))
    origins = field.center + 1.2 * field.radius * out / np.linalg.norm(out, axis=1, keepdims=True)
    targets = field.center + field.radius * rng.uniform(-0.6, 0.6, (count, 3))
    directions = targets - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def error(splats: Splats, field: Field, count: int) -> float:
    origins, directions = random_rays(field, count)
    truth = np.exp(-optical_depth(splats, origins, directions))
    assert 0.02 < np.mean((truth > 0.01) & (truth < 0.99)), "few rays are in between"
    return float(np.sqrt(np.mean((field.transmittance(origins, directions) - truth) ** 2)))


def round_splats() -> Splats:
    rng = np.random.default_rng(5)
    turns = rng.normal(size=(60, 4))
    return Splats(rng.uniform(-1, 1, (60, 3)), rng.uniform(0.08, 0.4, (60, 3)),
                  turns / np.linalg.norm(turns, axis=1, keepdims=True), rng.uniform(0.05, 0.9, 60),
                  rng.uniform(0, 1, (60, 3)))


def test_transmittance_of_splats_of_any_form():
    splats = round_splats()
    field = Field.of_voxels(*of_splats(splats))
    assert error(splats, field, 800) < MOST_ERROR / 2
    points = np.random.default_rng(6).uniform(-1.2, 1.2, (500, 3))
    truth = density(splats, points)
    assert np.abs(field.density(points) - truth).mean() < 0.01 * truth.mean()


def test_transmittance_of_a_mesh_of_5000_discs():
    splats = on_mesh(trimesh.creation.torus(0.7, 0.3), 5000)
    assert error(splats, Field.of_voxels(*of_splats(splats)), 800) < MOST_ERROR


@pytest.mark.slow
def test_transmittance_of_a_mesh_of_100000_discs():
    mesh = trimesh.creation.torus(0.7, 0.3, major_sections=256, minor_sections=128)
    splats = on_mesh(mesh, 100_000, opacity=0.1)  # opaque discs of this size leave two of 800 rays in between
    assert error(splats, Field.of_voxels(*of_splats(splats)), 800) < MOST_ERROR


def test_thin_splats_keep_their_optical_depth_across():
    """Discs of a hundredth of a voxel, one above the other: any ray across them meets what it should."""
    turn = np.tile([0.8, 0.36, 0.48, 0.0], (3, 1))
    centres = np.array([[0, 0, 0.0], [0.1, 0.05, 0.02], [-0.05, 0.1, 0.3]])
    splats = Splats(centres, np.tile([0.4, 0.4, 2e-4], (3, 1)), turn, np.array([0.5, 0.9, 0.3]), np.ones((3, 3)))
    field = Field.of_voxels(*of_splats(splats, 64))
    rng = np.random.default_rng(1)
    directions = np.tile(splats.normals()[:1], (200, 1)) + rng.normal(size=(200, 3)) * 0.1
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = rng.uniform(-0.2, 0.2, (200, 3)) - 6 * directions
    truth = np.exp(-optical_depth(splats, origins, directions))
    assert np.abs(field.transmittance(origins, directions) - truth).max() < 0.02


def test_colours_and_normals_are_those_of_the_nearest_splats():
    """Of a sphere of discs, red above and blue below; normals point outwards."""
    splats = on_mesh(trimesh.creation.icosphere(4), 5000)
    above = splats.centres[:, 2:] > 0
    splats = Splats(splats.centres, splats.scales, splats.rotations, splats.opacities,
                    np.where(above, [0.8, 0.1, 0.1], [0.1, 0.1, 0.8]))
    field = Field.of_voxels(*of_splats(splats))
    rng = np.random.default_rng(2)
    points = rng.normal(size=(400, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    normal, albedo, roughness, specular = field.reflectance(points * rng.uniform(0.97, 1.05, (400, 1)))
    assert (np.sum(normal * points, 1) > 0.95).all() and (roughness == 1).all() and (specular == 0).all()
    upper, lower = albedo[points[:, 2] > 0.3], albedo[points[:, 2] < -0.3]
    assert np.allclose(upper, [0.8, 0.1, 0.1], atol=0.02) and np.allclose(lower, [0.1, 0.1, 0.8], atol=0.02)


def test_voxels_follow_the_shortest_axes_and_bounds():
    """Nine tenths of the cross-section are at least a voxel thick, unless that takes too many voxels."""
    splats = round_splats()
    lattice = splat_field.lattice_of(splats, None)
    assert splats.scales.min() < 1.5 * lattice.size < 3 * splats.scales.min()
    assert splat_field.lattice_of(splats, 100).counts.max() == pytest.approx(100, abs=10)
    tiny = Splats(splats.centres, splats.scales * 1e-5, splats.rotations, splats.opacities, splats.colours)
    assert splat_field.lattice_of(tiny, None).counts.max() < splat_field.MOST_VOXELS + 16


def test_a_box_leaves_out_far_splats_and_cuts_large_ones():
    """Six small splats around the origin, one far away, and a wide one whose matter ends at the sides of the box."""
    few, box = round_splats().take(np.arange(8)), np.array([[-2.0, -1.5, -1.2], [2.0, 1.5, 1.2]])
    centres, scales = np.array(few.centres), np.array(few.scales)
    centres[6], centres[7], scales[7] = (500, 0, 0), (0.2, 0.1, 0.0), (3.0, 0.6, 0.6)
    splats = Splats(centres, scales, np.tile([1.0, 0, 0, 0], (8, 1)), few.opacities, few.colours)
    header, *parts = of_splats(splats, 128, bounds=box)
    size = (header.high[0] - header.low[0]) / header.counts[0]
    assert (np.abs(np.array([header.low, header.high]) - box).max(0) < 16 * size).all() and header.high[0] < 3
    assert header.provenance["splats"] == 7
    field, near = Field.of_voxels(header, *parts), splats.take(np.array([0, 1, 2, 3, 4, 5, 7]))
    points = np.random.default_rng(6).uniform(box[0], box[1], (500, 3))
    truth = density(near, points)
    assert np.abs(field.density(points) - truth).mean() < 0.01 * truth.mean()
    assert (field.density(np.array([[header.high[0] + 0.1, 0.1, 0], [500, 0, 0]])) == 0).all()
    with pytest.raises(MiNtfError, match=r"no splat has its centre in the box \[\[7"):
        of_splats(splats, 128, bounds=np.array([[7.0, 7, 7], [8, 8, 8]]))


def test_the_box_of_most_splats_is_proposed_where_a_few_are_far():
    splats = on_mesh(trimesh.creation.icosphere(3), 2000)
    assert splat_field.crowded_box(splats) is None
    far = Splats(np.where(np.arange(2000)[:, None] % 200 == 0, 50 * splats.centres, splats.centres), splats.scales,
                 splats.rotations, splats.opacities, splats.colours)
    box = splat_field.crowded_box(far)
    assert ((box[0] < -1) & (box[0] > -1.3) & (box[1] > 1) & (box[1] < 1.3)).all()


def test_voxels_become_longer_where_their_blocks_would_be_too_many(monkeypatch):
    splats = on_mesh(trimesh.creation.icosphere(3), 2000)
    monkeypatch.setattr(splat_field, "MOST_BLOCKS", 300)
    header, arrays, _ = of_splats(splats)
    assert len(arrays["words"]) < 3 * 300 and max(header.counts) < 80


def test_the_thinnest_gaussian_is_sampled_right():
    """Its sum over voxels and the interpolation's variance are what the module says."""
    offsets = np.linspace(0, 1, 21)[:, None]
    sums = np.exp(-0.5 * ((np.arange(-9, 10) - offsets) / THINNEST) ** 2).sum(1) / (np.sqrt(2 * np.pi) * THINNEST)
    assert np.abs(sums - 1).max() < 0.0145
    x = np.linspace(-1, 1, 200001)
    assert np.trapezoid(x**2 * (1 - np.abs(x)), x) == pytest.approx(TRILINEAR, rel=1e-6)


def test_nothing_to_import_is_said_in_a_sentence():
    splats = round_splats()
    faint = Splats(splats.centres, splats.scales, splats.rotations, splats.opacities * 1e-3, splats.colours)
    with pytest.raises(MiNtfError, match="no splat has an opacity"):
        of_splats(faint)
    with pytest.raises(MiNtfError, match="resolution is 8, expected 16 to 2048"):
        of_splats(splats, 8)


def test_a_splat_larger_than_the_box_leaves_the_voxels_fine():
    """A floater in a box of bounds counts as much as the box is wide, and the box does not grow by its reach."""
    splats = round_splats()
    large = Splats(*(np.concatenate([values, values[:1]]) for values in vars(splats).values()))
    large.scales[-1] = 50.0
    bounds = np.array([[-1.5] * 3, [1.5] * 3])
    alone, beside = (of_splats(s, bounds=bounds)[0] for s in (splats, large))
    assert min(beside.counts) > 0.5 * min(alone.counts)
    assert (np.abs([beside.low, beside.high]) < 1.9).all()

"""Voxels of closed meshes beside the volume of the meshes and of a box."""

import numpy as np
import pytest
import trimesh

from mi_ntf.core.mesh_voxels import fraction_inside

LOW, HIGH = np.array([-1.1, -1.2, -0.6]), np.array([1.0, 1.3, 0.7])


@pytest.mark.parametrize("shape", [trimesh.creation.torus(0.7, 0.25), trimesh.creation.icosphere(3, 0.5)],
                         ids=["torus", "ball"])
def test_the_volume_is_that_of_the_mesh(shape):
    """The sum of all fractions is the volume within 1e-3, whichever way the faces look."""
    faces = np.array(shape.faces)
    faces[::2] = faces[::2, ::-1]
    fractions = fraction_inside(shape.vertices, faces, LOW, HIGH, np.array([60, 50, 40]))
    assert fractions.shape == (40, 50, 60) and fractions.dtype == np.float32
    assert fractions.sum() * np.prod((HIGH - LOW) / [60, 50, 40]) == pytest.approx(shape.volume, rel=1e-3)


def test_fractions_of_a_box():
    """A box that covers part of a voxel along z has this part exactly."""
    box = trimesh.creation.box(bounds=[[0, 0, 0.25], [4, 2, 1.75]])
    fractions = fraction_inside(box.vertices, box.faces, np.zeros(3), np.array([4.0, 3.0, 2.0]), np.array([4, 3, 2]))
    np.testing.assert_allclose(fractions[:, :2], 0.75, atol=1e-6)
    assert fractions[:, 2].max() == 0


def test_a_mesh_beyond_the_box_is_clipped():
    """The parts of a mesh outside the box count for the inside of the lines that cross them."""
    box = trimesh.creation.box(extents=[10, 10, 10])
    np.testing.assert_array_equal(fraction_inside(box.vertices, box.faces, LOW, HIGH, np.array([3, 4, 5])), 1)

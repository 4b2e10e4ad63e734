"""Splats that fit a mesh, and their figures on few of them."""

import numpy as np
import trimesh

from benchmarks import splats
from mi_ntf.core.splats import optical_depth
from mi_ntf.field import Field


def test_fitted_splats_cover_a_ball():
    """Rays through the ball are blocked, and those that pass at a distance of two discs are not."""
    ball = trimesh.creation.icosphere(4)
    made = splats.fitted(ball, 1500)
    rng = np.random.default_rng(0)
    along = rng.normal(size=(60, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside = np.cross(along, rng.normal(size=along.shape))
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    wide = float(made.scales.max())
    for distance, low, high in ((0.85, 4, np.inf), (1 + 2 * wide, 0, 0.05)):
        depth = optical_depth(made, distance * aside - 3 * along, along)
        assert (depth >= low).all() and (depth <= high).all(), (distance, depth.min(), depth.max())
    assert np.isclose(np.linalg.norm(made.rotations, axis=1), 1).all() and (made.scales > 0).all()


def test_error_of_voxels_is_small(tmp_path):
    made = splats.fitted(trimesh.creation.icosphere(3), 300)
    field = Field.from_splats(splats.write_ply(tmp_path / "a.ply", made))
    row = splats.error(made, field)
    assert row["random"] < 3e-3 and row["grazing"] < 0.02 and row["partly_clear_rays"] > 20

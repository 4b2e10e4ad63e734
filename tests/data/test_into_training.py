"""Every form becomes the same rays and the same hull in the trainer."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from data import forms  # noqa: E402

from mi_ntf.data import images  # noqa: E402
from mi_ntf.data.readers import load_dataset  # noqa: E402
from mi_ntf.data.schema import Split  # noqa: E402
from mi_ntf.train import rays  # noqa: E402
from mi_ntf.train.config import FastConfig  # noqa: E402


def test_rays_of_all_forms_are_the_same_lines(tmp_path):
    """Lines are compared in world coordinates, within 1e-5 for float32 and lengths up to 4."""
    expected = None
    for form in (forms.capture, forms.blender, forms.nrhints, forms.nerfstudio):
        split = load_dataset(form(tmp_path / form.__name__), lambda _: None)["train"]
        result = rays.Photographs(split)[:]
        np.testing.assert_array_equal(result.target.numpy(), images.linear(split.images).reshape(-1, 4))
        world = result.o.numpy() * split.radius + split.center
        expected = (world, result.d.numpy()) if expected is None else expected
        np.testing.assert_allclose(world, expected[0], atol=1e-5)
        np.testing.assert_allclose(result.d.numpy(), expected[1], atol=1e-5)


def test_principal_point_and_focal_lengths_reach_rays_and_hull():
    """A window cut out of a picture, stretched in y by repeated rows, sees the same lines and leaves the same hull."""
    def split(pictures, focal, principal):
        n = len(pictures)
        return Split(pictures.astype(np.float32), forms.C2W[:n], np.tile(focal, (n, 1)), np.tile(principal, (n, 1)),
                     forms.C2W[:n, :3, 3].astype(np.float32), np.ones((n, 3), np.float32), np.zeros(3), 1.0)

    f, size = forms.FOCAL, forms.SIZE
    whole = split(forms.PICTURES, [f, f], [size / 2, size / 2])
    cut = split(np.repeat(forms.PICTURES[:, 2:, 3:], 3, axis=1), [f, 3 * f], [size / 2 - 3, 3 * (size / 2 - 2)])
    whole, cut = rays.Photographs(whole), rays.Photographs(cut)
    a = whole[:].d.reshape(len(forms.C2W), size, size, 3)[:, 2:, 3:]
    b = cut[:].d.reshape(len(forms.C2W), 3 * (size - 2), size - 3, 3)[:, 1::3]
    np.testing.assert_allclose(a, b, atol=1e-6)  # float32
    for hull in (rays.visual_hull(whole, 24), rays.visual_hull(cut, 24)):
        axis = (torch.arange(24) + 0.5) / 12 - 1
        x = torch.stack(torch.meshgrid(axis, axis, axis, indexing="ij"), -1).numpy()
        inside = np.any([np.linalg.norm(x - c, axis=-1) < r for c, r in forms.SPHERES], axis=0)
        assert hull.numpy()[inside].all() and hull.float().mean() < 0.5


def test_a_light_away_from_one_camera_is_seen(tmp_path):
    split = load_dataset(forms.nrhints(tmp_path), lambda _: None)["train"]
    assert rays.Photographs(split).on_lens
    split.light_pos[3] += 0.5
    result = rays.Photographs(split)
    assert not result.on_lens
    np.testing.assert_allclose(result.flash[3].numpy() * split.radius + split.center, split.light_pos[3], rtol=1e-6)


def test_finer_photographs_are_learned_on_finer_grids():
    """Steps and cells shrink by √2 for pixels of 1/128, by a third at 1/144 and beyond.

    The camera is 4 radii away with a focal length of 512. Coarser pixels change nothing.
    """
    n = len(forms.PICTURES)
    split = Split(forms.PICTURES.astype(np.float32), forms.C2W[:n].copy(), np.tile([512.0, 256.0], (n, 1)),
                  np.zeros((n, 2)), np.zeros((n, 3)), np.ones((n, 3)), np.array([0.5, 0, 0]), 2.0)
    split.c2w[:, :3, 3] = [0.5, 0, 8]
    pixel = rays.pixel_width(split)
    assert pixel == pytest.approx(1 / 128)
    recipe = FastConfig(step=0.01, cells=96, bake=128)
    result = [(c.step, c.cells, c.bake) for c in (recipe.sharpened(pixel * s) for s in (4, 2, 1, 0.5, 0.1))]
    finest = (0.01 / 1.5, 144, 192)
    for (step, *cells), row in zip(result, [(0.01, 96, 128)] * 2 + [(0.00707, 136, 181)] + [finest] * 2, strict=True):
        assert (step, *cells) == pytest.approx(row, rel=1e-3)

"""The picture of `mi-ntf compare`."""

import numpy as np
import pytest
from matplotlib import colormaps
from skimage import io

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import compare_picture, metrics
from mi_ntf.evaluate.compare import compare


def _has(pixels: np.ndarray, colour) -> int:
    """Return the number of pixels that have about this colour, 0 to 1."""
    return int((np.abs(pixels[..., :3] / 255 - np.asarray(colour)[:3]).max(-1) < 0.02).sum())


def test_four_panels_show_what_they_say(tmp_path):
    """Left half too dark, right half too bright: blue and red at the ends of the scale, FLIP as its own map says."""
    reference = np.ones((40, 60, 3)) * [0.2, 0.4, 0.2]
    factor = np.where(np.arange(60) < 30, 0.5, 1.5)[None, :, None]
    image = reference * factor
    result = {"relative_rmse": 0.5, "flip": metrics.flip(image, reference)}
    compare_picture.draw(tmp_path / "p.png", image, reference, result)
    assert [p.name for p in tmp_path.iterdir()] == ["p.png"]
    pixels = io.imread(tmp_path / "p.png")
    panel = (3.2 * 110) * (3.2 * 110 * 40 / 60)  # drawn somewhat smaller
    half = 0.3 * panel
    width = pixels.shape[1]
    left, right = pixels[:, : width // 2], pixels[:, width // 2:]
    assert _has(left, metrics.srgb(reference[0, 0])) > 2 * half  # the reference
    assert _has(left, metrics.srgb(image[0, 0])) > half and _has(left, metrics.srgb(image[0, -1])) > half
    relative = compare_picture.difference(image, reference)
    scale = compare_picture.round_scale(np.abs(relative).max())
    for value in (relative[0, 0], relative[0, -1]):
        assert _has(right, colormaps["RdBu_r"](0.5 + value / scale / 2)) > half
    each = metrics.flip_map(image, reference)
    for value in (each[20, 10], each[20, 50]):
        assert _has(right, colormaps["magma"](float(value))) > half / 2  # the edge between the halves is smooth


def test_difference_is_signed_and_relative_to_the_whole_reference():
    reference = np.zeros((2, 2, 3))
    reference[0] = 2  # RMS √2
    image = reference.copy()
    image[0, 0, 0] += 0.3
    image[1, 1] -= 3
    np.testing.assert_allclose(compare_picture.difference(image, reference), np.array([[0.1, 0], [0, -3]]) / np.sqrt(2))


@pytest.mark.parametrize(("value", "scale"),
                         [(0, 0.001), (0.001, 0.001), (0.0011, 0.002), (0.05, 0.05), (0.051, 0.1), (0.2, 0.2), (7, 10)])
def test_scale_is_a_round_number(value, scale):
    assert compare_picture.round_scale(value) == pytest.approx(scale)


def test_equal_and_odd_shapes_are_drawn(tmp_path):
    for shape in ((1, 200, 3), (300, 12, 3)):
        image = np.full(shape, 0.3)
        compare_picture.draw(tmp_path / "p.png", image, image, {"relative_rmse": 0, "flip": 0})
        assert io.imread(tmp_path / "p.png").std() > 5


def test_compare_refuses_a_bad_name_before_it_reads(tmp_path):
    with pytest.raises(MiNtfError, match=r"p.jpg: the name ends in '.jpg', expected .png"):
        compare("nowhere.exr", "nowhere.exr", compare_picture.Path("p.jpg"))


def test_compare_writes_it_and_names_it(tmp_path):
    pixels = np.uint8(np.random.default_rng(1).integers(40, 200, (24, 30, 3)))
    for name, picture in (("a.png", pixels), ("b.png", pixels // 2)):
        io.imsave(tmp_path / name, picture, check_contrast=False)
    result = compare(tmp_path / "a.png", tmp_path / "b.png", tmp_path / "c.png")
    assert result["picture"] == str(tmp_path / "c.png")
    assert io.imread(tmp_path / "c.png").shape[1] > 1200

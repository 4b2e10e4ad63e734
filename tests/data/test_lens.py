"""Photographs through a distorting lens become those of a pinhole: spots of light are where its formula puts them.

The oracle is the published formula of Brown and Conrady in NumPy. Neither OpenCV nor anything of `lens` draws.
"""

import json

import numpy as np
import pytest
from data import forms
from PIL import Image
from scipy.spatial.transform import Rotation

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import colmap, images, lens, photographs
from mi_ntf.data.readers import load_dataset
from mi_ntf.data.schema import Camera

pytest.importorskip("cv2", reason="lenses need OpenCV: pip install 'mi-ntf[train]'")

WIDTH, HEIGHT = 220, 160
F, CX, CY = 190.0, 118.5, 71.25  # a principal point far from the middle
MODELS = {
    "SIMPLE_RADIAL": ([F, CX, CY, 0.11], (F, F), (0.11,)),
    "RADIAL": ([F, CX, CY, -0.18, 0.06], (F, F), (-0.18, 0.06)),
    "OPENCV": ([F, 1.1 * F, CX, CY, 0.12, -0.05, 0.004, -0.006], (F, 1.1 * F), (0.12, -0.05, 0.004, -0.006)),
    "FULL_OPENCV": ([F, 1.1 * F, CX, CY, -0.1, 0.04, -0.003, 0.005, 0.01, 0.06, 0.02, -0.01], (F, 1.1 * F),
                    (-0.1, 0.04, -0.003, 0.005, 0.01, 0.06, 0.02, -0.01)),
}
"""COLMAP's parameters of a camera; its focal lengths; its k1, k2, p1, p2, k3, k4, k5, k6 as far as it has them."""


def bend(x, y, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0):
    """Return the place of the direction (x, y, 1) by COLMAP's `models.h`, the same as OpenCV's documentation."""
    r = x * x + y * y
    radial = (1 + k1 * r + k2 * r**2 + k3 * r**3) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    return (x * radial + 2 * p1 * x * y + p2 * (r + 2 * x * x), y * radial + p1 * (r + 2 * y * y) + 2 * p2 * x * y)


def spots(focal, bent) -> tuple[np.ndarray, np.ndarray]:
    """Return directions (K, 2), slopes right and down, and a photograph of spots in them.

    The images of the directions are well inside the photograph. It is linear RGB (HEIGHT, WIDTH, 3) with a Gaussian
    spot of 2 pixels' deviation at each.
    """
    column, row = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    result, light = [], np.zeros((HEIGHT, WIDTH))
    for x, y in np.array(np.meshgrid(np.linspace(-0.5, 0.42, 6), np.linspace(-0.3, 0.38, 5))).reshape(2, -1).T:
        bent_x, bent_y = bend(x, y, *bent)
        u, v = CX + focal[0] * bent_x, CY + focal[1] * bent_y
        if 16 < u < WIDTH - 16 and 16 < v < HEIGHT - 16:
            result.append((x, y))
            light += 0.8 * np.exp(-((column - u) ** 2 + (row - v) ** 2) / 8)
    assert len(result) > 12
    return np.array(result), np.repeat(light[..., None], 3, -1)


def check_spots(stored, directions, focal, principal):
    """Check that the pinhole sees each direction at the centroid of its spot in the 8-bit picture.

    The error is below 1/25 of a pixel: resampling takes positions to 1/32 of a pixel, and the lens's scale changes over
    a spot. The half pixel by which OpenCV's coordinates differ would show.
    """
    value = images.linear(stored)[..., 1].astype(np.float64)
    for place in principal + directions * focal:
        left, top = np.floor(place).astype(int) - 8
        assert left >= 0 and top >= 0
        window = value[top : top + 17, left : left + 17]
        rows, columns = np.mgrid[top : top + 17, left : left + 17] + 0.5
        result = np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum()
        np.testing.assert_allclose(result, place, atol=1 / 25)


def write_colmap(folder, model, params, picture):
    """Four views, all with the same picture, before a mask that shows its upper left three quarters."""
    place = folder / "sparse" / "0"
    place.mkdir(parents=True)
    (place / "cameras.txt").write_text(f"7 {model} {WIDTH} {HEIGHT} {' '.join(map(str, params))}\n")
    (place / "points3D.txt").write_text("")
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[: 3 * HEIGHT // 4, : 3 * WIDTH // 4] = 255
    lines = []
    for i, c2w in enumerate(forms.C2W[:4]):
        rotation = (c2w[:3, :3] * (1, -1, -1)).T
        x, y, z, w = Rotation.from_matrix(rotation).as_quat()
        pose = [w, x, y, z, *(-rotation @ c2w[:3, 3])]
        lines.append(f"{i + 1} {' '.join(map(str, pose))} 7 {i}.png\n\n")
        for kind, pixels in (("images", picture), ("masks", mask)):
            (folder / kind).mkdir(exist_ok=True)
            Image.fromarray(pixels).save(folder / kind / f"{i}.png")
    (place / "images.txt").write_text("".join(lines))
    return folder


@pytest.mark.parametrize("model", MODELS)
def test_colmaps_lenses_are_undone(tmp_path, model):
    params, focal, bent = MODELS[model]
    directions, light = spots(focal, bent)
    picture = images.levels(np.concatenate([light, light[..., :1]], -1))
    folder = write_colmap(tmp_path, model, params, picture)
    messages = []
    split = load_dataset(folder, messages.append, background="black")["train"]
    assert messages[0].endswith("4 photographs, 220x160 pixels, lens distortion undone, black background")
    np.testing.assert_allclose(split.principal[0], [CX, CY])
    assert split.focal[0, 1] / split.focal[0, 0] == pytest.approx(focal[1] / focal[0])
    for stored in split.images:
        assert stored.dtype == np.uint8 and stored.shape == (HEIGHT, WIDTH, 4)
        check_spots(stored, directions, split.focal[0], split.principal[0])


def test_masks_go_through_the_lens_alike_and_leave_no_empty_border(tmp_path):
    """The edge of a mask is the curve that the formula gives, and every pixel comes from within the photograph."""
    params, focal, bent = MODELS["SIMPLE_RADIAL"]
    picture = np.full((HEIGHT, WIDTH, 3), 188, np.uint8)
    folder = write_colmap(tmp_path, "SIMPLE_RADIAL", params, picture)
    pictures, _, (result, *_), _ = photographs.load(colmap.read(folder).views["train"])
    stored = pictures[0]
    np.testing.assert_array_equal(stored[stored[..., 3] == 255][:, :3], 188)  # flat light stays what it was
    x = (np.arange(WIDTH) + 0.5 - CX) / result[0]
    y = (np.arange(HEIGHT) + 0.5 - CY) / result[1]
    u, v = bend(*np.meshgrid(x, y), *bent)
    u, v = CX + focal[0] * u, CY + focal[1] * v
    assert 0.499 < u.min() and u.max() < WIDTH - 0.499 and 0.499 < v.min() and v.max() < HEIGHT - 0.499
    within = (u < 3 * WIDTH // 4 - 0.6) & (v < 3 * HEIGHT // 4 - 0.6)  # a pixel's centre by half a pixel: it is full
    beyond = (u > 3 * WIDTH // 4 + 0.6) | (v > 3 * HEIGHT // 4 + 0.6)
    assert (stored[within, 3] == 255).all() and (stored[beyond] == 0).all()


@pytest.mark.parametrize("bent", [(0.2, 0, 0, 0), (-0.2, 0, 0, 0), (0.1, 0.1, 0.01, -0.01), (-0.1, 0.05, 0, 0, 0.01)])
def test_the_picture_shows_all_that_it_can(bent):
    """Every pixel comes from the photograph; by a focal length a thousandth shorter some would not."""
    camera = Camera(F, 1.1 * F, CX, CY, bent)
    pinhole = lens.straight(camera, (WIDTH, HEIGHT))
    border = np.array([(u, v) for u in np.arange(WIDTH) + 0.5 for v in (0.5, HEIGHT - 0.5)]
                      + [(u, v) for u in (0.5, WIDTH - 0.5) for v in np.arange(HEIGHT) + 0.5])

    def margin(factor):
        x, y = bend(*((border - (CX, CY)) / (pinhole.fx * factor, pinhole.fy * factor)).T, *bent)
        u, v = CX + camera.fx * x, CY + camera.fy * y
        return min(u.min() - 0.5, WIDTH - 0.5 - u.max(), v.min() - 0.5, HEIGHT - 0.5 - v.max())

    assert margin(1) > -0.01 and margin(0.999) < 0
    assert (pinhole.fx > camera.fx) == (bent[0] > 0)


def test_without_distortion_nothing_is_touched(tmp_path, monkeypatch):
    """Level by level, and without OpenCV."""
    monkeypatch.setattr(lens, "opencv", None)
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3)).astype(np.uint8)
    folder = write_colmap(tmp_path, "OPENCV", [F, F, CX, CY, 0, 0, 0, 0], picture)
    stored, _, focal, _ = photographs.load(colmap.read(folder).views["train"])
    np.testing.assert_array_equal(stored[0][..., :3], picture * (stored[0][..., 3:] == 255))
    np.testing.assert_array_equal(focal, F)


@pytest.mark.parametrize("bent", [(-3.0, 0, 0, 0), (1e300, 0, 0, 0), (50.0, 900.0, 0, 0), (0, 0, 5.0, 0)])
def test_lenses_that_fold_the_picture(tmp_path, bent):
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    with pytest.raises(MiNtfError, match=r"image '\d.png': its lens distortion \[.*\] folds the picture or lea"):
        load_dataset(write_colmap(tmp_path, "OPENCV", [60, 60, CX, CY, *bent], picture), lambda _: None)


@pytest.mark.parametrize("per_frame", [False, True])
def test_nerfstudios_lenses_are_undone(tmp_path, per_frame):
    """Its k1, k2, p1, p2, k3, for all frames or for each."""
    bent = {"k1": 0.12, "k2": -0.05, "p1": 0.004, "p2": -0.006, "k3": 0.02, "k4": 0.0}
    directions, light = spots((F, 1.1 * F), list(bent.values())[:5])
    (tmp_path / "images").mkdir()
    Image.fromarray(images.levels(np.concatenate([light, np.ones_like(light[..., :1])], -1))).save(
        tmp_path / "images/a.png")
    camera = {"fl_x": F, "fl_y": 1.1 * F, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, **bent}
    frames = [{"file_path": "images/a.png", "transform_matrix": c2w.tolist(), **(camera if per_frame else {})}
              for c2w in forms.C2W[:4]]
    wrong = {key: 0.9 * value for key, value in camera.items()}
    text = {"camera_model": "OPENCV", "frames": frames, **(wrong if per_frame else camera)}
    (tmp_path / "transforms.json").write_text(json.dumps(text))
    split = load_dataset(tmp_path, lambda _: None)["train"]
    check_spots(split.images[0], directions, split.focal[0], split.principal[0])

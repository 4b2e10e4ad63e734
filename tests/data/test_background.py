"""What a black background tells of photographs without masks, against silhouettes that are known."""

import json

import numpy as np
import pytest
from data import forms
from PIL import Image
from scipy import ndimage
from train import two_spheres

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images, masks, schema
from mi_ntf.data.readers import load_dataset

pytest.importorskip("cv2", reason="a black background needs OpenCV: pip install 'mi-ntf[train]'")

SIZE = 160
FOCAL = schema.focal_length(forms.ANGLE, SIZE)


def photograph(c2w, room=0.002, noise=0.0015, rng=None) -> tuple[np.ndarray, np.ndarray]:
    """Return 8-bit RGB levels and alpha of the two spheres in a room that is not quite dark.

    The camera is not quite without noise, and one sphere has a black band. Linear light is below 1.
    """
    rng = np.random.default_rng(0) if rng is None else rng
    picture = two_spheres.photograph(c2w, FOCAL, SIZE, 2) * (forms.SCALE, forms.SCALE, forms.SCALE, 1)
    picture[70:80, :, :3] *= 0.01
    light = picture[..., :3] + room * (1 - picture[..., 3:]) + rng.normal(0, noise, (SIZE, SIZE, 3))
    return images.levels(np.concatenate([light, picture[..., 3:]], -1))[..., :3], picture[..., 3]


@pytest.mark.parametrize("view", range(5))
@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_matter_lies_in_the_silhouette_and_emptiness_outside_of_it(view, dtype):
    levels, alpha = photograph(forms.C2W[view])
    stored = np.concatenate([levels, np.full((SIZE, SIZE, 1), 255, np.uint8)], -1)
    result = masks.from_background(stored if dtype == np.uint8 else images.linear(stored), "here")
    assert set(np.unique(result)) == {masks.EMPTY, masks.UNKNOWN, masks.MATTER}
    assert (result[alpha < 0.5] != masks.MATTER).all() and (result[alpha > 0] != masks.EMPTY).all()
    core = ndimage.binary_erosion(alpha == 1, iterations=4) & (np.abs(np.arange(SIZE) - 74.5) > 8)[:, None]
    bright = core & (images.LINEAR[levels].max(-1) > 0.25 * images.LINEAR[levels].max())
    assert (result[bright] == masks.MATTER).mean() > 0.99
    far = ndimage.distance_transform_edt(alpha == 0) > (2 * masks.CLOSE + masks.AROUND) * SIZE
    assert (result[far] == masks.EMPTY).all() and far.mean() > 0.2


def test_dust_is_dropped_and_parts_of_the_object_are_kept():
    light = np.zeros((200, 300, 4), np.float32)
    light[..., 3] = 1
    light[60:140, 100:180, :3] = 0.5
    light[60:140, 184:200, :3] = 0.4   # a part beyond a narrow shadow
    light[90:110, 120:140, :3] = 0     # a hole
    light[20:22, 20:22, :3] = 0.6      # dust
    result = masks.from_background(light, "here")
    assert (result[10:32, 10:32] == masks.EMPTY).all()
    assert (result[92:108, 122:138] == masks.UNKNOWN).all()
    assert (result[62:138, 181:183] == masks.UNKNOWN).all()
    assert (result[64:84, 104:176] == masks.MATTER).all() and (result[64:136, 188:196] == masks.MATTER).all()


def test_an_object_that_leaves_the_picture():
    light = np.full((100, 150, 4), 1e-4, np.float32)
    light[60:, 50:100, :3] = 0.3
    result = masks.from_background(light, "here")
    assert (result[63:, 53:97] == masks.MATTER).all() and (result[:40] == masks.EMPTY).all()


@pytest.mark.parametrize(("room", "text"), [
    (0.2, r"a.png: its background is not black: the median of its border is 0.2\d*, its brightest percent 0.\d+ in "
          r"linear light, .* up to 8% of that; darken the room, or make masks .*`rembg p -om .* --masks DIR"),
    (None, r"a.png: its background is not black: the median of its border is 0, its brightest percent 0 in")])
def test_what_is_not_dark_is_refused_with_what_to_do(room, text):
    pixels = np.zeros((SIZE, SIZE, 3), np.uint8) if room is None else photograph(forms.C2W[0], room=room)[0]
    with pytest.raises(MiNtfError, match=text):
        masks.from_background(np.concatenate([pixels, pixels[..., :1]], -1), "a.png")


def write(folder, **room):
    """Write a Blender data set of opaque photographs in a dark room."""
    rng = np.random.default_rng(4)
    for split, views in forms.splits().items():
        frames = []
        for i in views:
            (folder / split).mkdir(exist_ok=True)
            Image.fromarray(photograph(forms.C2W[i], rng=rng, **room)[0]).save(folder / split / f"{i}.png")
            frames.append({"file_path": f"{split}/{i}", "transform_matrix": forms.C2W[i].tolist()})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": forms.ANGLE, "frames": frames}))
    return folder


def test_a_data_set_without_masks(tmp_path):
    messages = []
    splits = load_dataset(write(tmp_path), messages.append, background="black")
    split = splits["train"]
    assert not any(s.masked for s in splits.values()) and split.images.dtype == np.uint8
    assert messages[0].endswith("16 photographs, 160x160 pixels, black background")
    assert any("are known to be empty" in s for s in messages)
    assert any("sphere is found from the lit regions' visual hull" in s for s in messages)
    for center, radius in forms.SPHERES:
        assert np.linalg.norm(center - split.center) + radius <= split.radius
    assert split.radius < 1.3 * forms.true_bounds()[1]  # the margin of silhouettes is 0.03 of 160 pixels and more
    np.testing.assert_array_equal(split.images[0][..., :3], np.asarray(Image.open(tmp_path / "train/0.png")))
    # the estimate is from what is clearly lit, of an albedo of 0.7 at most
    np.testing.assert_allclose(split.light_intensity, forms.INTENSITY * 0.7 / 0.8, rtol=0.5)


def test_faults_of_the_option(tmp_path):
    write(tmp_path, room=0.1)
    with pytest.raises(MiNtfError, match=r"train/0.png: its background is not black: .*\(read as NeRF-synthetic"):
        load_dataset(tmp_path, lambda _: None, background="black")
    with pytest.raises(MiNtfError, match=r"background is 'white', must be 'black', for photographs with a flash in a"):
        load_dataset(tmp_path, lambda _: None, background="white")
    with pytest.raises(MiNtfError, match=r"masks \(.*\) and background 'black' are both given; .*leave one of the two"):
        load_dataset(tmp_path, lambda _: None, background="black", masks=tmp_path)
    with pytest.raises(MiNtfError, match=r"train/0.png: has no alpha channel and no mask .*say --background black"):
        load_dataset(tmp_path, lambda _: None)

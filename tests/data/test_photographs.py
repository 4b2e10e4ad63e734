"""Photographs with their masks, scaled, in the smallest type that holds them, without more memory than that."""

import dataclasses
import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
from data import forms
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import file_names, images, lens, photographs, schema
from mi_ntf.data.readers import load_dataset


def view(path: Path, masks=(), camera=0.6, **more) -> schema.View:
    return schema.View(f"{path.name} of the test", path, path.name, list(masks), np.eye(4), camera, **more)


def read(path: Path, masks=(), **more):
    return photographs.read(view(path, masks, **more), None, False, lens.Straightener())[0]


def light(level):
    return images.LINEAR[np.asarray(level)]


def test_jpeg_takes_its_alpha_from_the_mask(tmp_path):
    photo, mask = tmp_path / "a.jpg", tmp_path / "masks" / "a.jpg.png"
    mask.parent.mkdir()
    Image.fromarray(np.full((8, 8, 3), (200, 100, 50), np.uint8)).save(photo, quality=100, subsampling=0)
    grey = np.zeros((8, 8), np.uint8)
    grey[:, 4:], grey[:, 7] = 255, 128
    Image.fromarray(grey).save(mask)
    places = file_names.mask_places(tmp_path / "masks", "images/a.jpg")
    assert mask in places and places == file_names.mask_places(tmp_path / "masks", "a.jpg")
    pixels = images.linear(read(photo, places))
    # one level of 255 is what JPEG's own rounding of a flat block may change, half a level what storing adds; sRGB's
    # slope is below 2.3
    np.testing.assert_allclose(pixels[0, 5, :3], light([200, 100, 50]), atol=2.3 / 255)
    np.testing.assert_allclose(pixels[0, 7, :3], light([200, 100, 50]) * 128 / 255, atol=1.5 * 2.3 / 255)
    assert (pixels[:, :4] == 0).all() and (pixels[:, 4:7, 3] == 1).all()
    assert (images.read_image(photo)[..., 3] == 1).all()
    Image.fromarray(grey[:4]).save(mask)
    with pytest.raises(MiNtfError, match=r"a.jpg.png: is 8x4, its photograph .*a.jpg is 8x8; a mask has the size"):
        read(photo, [mask])
    mask.write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"a.jpg.png: cannot be read as a mask"):
        read(photo, [mask])
    mask = mask.with_suffix(".tif")
    Image.fromarray(np.zeros((8, 8), np.float32)).save(mask)
    with pytest.raises(MiNtfError, match=r"a.jpg.tif: cannot be read as a mask \(.mode 'F'.\); write it as 8-bit"):
        read(photo, [mask])


def test_a_photograph_without_alpha_and_mask_is_refused(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(MiNtfError, match=r"a.png: has no alpha channel and no mask \(.*masks/a.png\); training must .* "
                                         "name the masks' folder with --masks DIR, .* --background black"):
        read(tmp_path / "a.png", file_names.mask_places(tmp_path / "masks", "a.png"))


def test_exr_without_alpha_is_opaque_or_masked(tmp_path):
    with OpenEXR.File({}, {"RGB": np.full((2, 3, 3), 0.25, np.float32)}) as file:
        file.write(str(tmp_path / "a.exr"))
    pixels = images.read_image(tmp_path / "a.exr")
    assert pixels.shape == (2, 3, 4) and (pixels[..., 3] == 1).all() and (pixels[..., :3] == 0.25).all()
    Image.fromarray(np.array([[0, 255, 51]] * 2, np.uint8)).save(tmp_path / "mask.png")
    pixels = read(tmp_path / "a.exr", [tmp_path / "none.png", tmp_path / "mask.png"])
    np.testing.assert_allclose(pixels[0, :, 0], [0, 0.25, 0.05], rtol=1e-6)  # float32
    np.testing.assert_allclose(pixels[0, :, 3], [0, 1, 0.2], rtol=1e-6)


def test_alpha_goes_before_a_mask_that_was_not_asked_for(tmp_path):
    Image.fromarray(np.full((1, 1, 4), (200, 100, 50, 51), np.uint8)).save(tmp_path / "a.png")
    Image.fromarray(np.full((1, 1), 102, np.uint8)).save(tmp_path / "m.png")
    for first, level in ((False, 51), (True, 102)):
        pixel = images.linear(read(tmp_path / "a.png", [tmp_path / "m.png"], mask_first=first))[0, 0]
        assert pixel[3] == pytest.approx(level / 255)
        np.testing.assert_allclose(pixel[:3], light([200, 100, 50]) * level / 255, atol=0.5 * 2.3 / 255)


@pytest.mark.parametrize(("values", "dtype"), [
    ([0.5, 0.5], np.float16), ([0.5, 6e4], np.float16), ([0.5, 7e4], np.float32), ([7e4, 0.5], np.float32),
    ([1e-5, 2e-5], np.float32), ([0.0, 0.5], np.float16)])
def test_the_type_that_holds_the_light_of_all(tmp_path, values, dtype):
    """Half precision has 11 bits of what is between 6e-5 and 65504."""
    views = []
    for i, value in enumerate(values):
        with OpenEXR.File({}, {"RGB": np.full((2, 3, 3), value, np.float32)}) as file:
            file.write(str(tmp_path / f"{i}.exr"))
        views.append(dataclasses.replace(view(tmp_path / f"{i}.exr"), masks=[tmp_path / "m.png"]))
    Image.new("L", (3, 2), 255).save(tmp_path / "m.png")
    stored = photographs.load(views)[0]
    assert stored.dtype == dtype
    np.testing.assert_allclose(images.linear(stored)[:, 0, 0, 0], values, rtol=5e-4)


def test_bytes_among_floating_point_are_light_all_the_same(tmp_path):
    """Whatever comes first: what is held already is made light when the first other photograph comes."""
    Image.fromarray(np.full((2, 3, 4), 99, np.uint8)).save(tmp_path / "0.png")
    schema.write_exr(tmp_path / "1.exr", np.full((2, 3, 4), 0.25))
    for order in ((0, 1), (1, 0)):
        views = [(view(tmp_path / "0.png"), view(tmp_path / "1.exr"))[i] for i in order]
        stored = photographs.load(views)[0]
        assert stored.dtype == np.float16
        # half a level of the 8 bits over black, and half precision
        np.testing.assert_allclose(stored[order.index(0), 0, 0, :3], light(99) * 99 / 255, atol=0.5 * 2.3 / 255)
        assert (stored[order.index(1)] == 0.25).all()


# --- size ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("width", "height", "size", "expected"), [
    (60, 40, 30, (30, 20)), (61, 40, 30, (30, 20)), (41, 60, 16, (11, 16)), (60, 40, 60, (60, 40)),
    (60, 40, 99, (60, 40))])
def test_scaled_photographs_have_the_same_mean_light(tmp_path, width, height, size, expected):
    """Scaling conserves the mean of linear light over black and of alpha.

    The camera is scaled by the real factor of each side. Neither the means of levels nor of straight colour are
    conserved.
    """
    rng = np.random.default_rng(3)
    alpha = np.maximum(rng.integers(-255, 256, (height, width)), 0)
    png = np.concatenate([rng.integers(0, 256, (height, width, 3)), alpha[..., None]], -1).astype(np.uint8)
    Image.fromarray(png).save(tmp_path / "a.png")
    schema.write_exr(tmp_path / "a.exr", images.read_image(tmp_path / "a.png"))
    camera = schema.Camera(90.0, 80.0, 0.4 * width, 0.7 * height)
    for name, dtype, error in (("a.png", np.uint8, 0.5 * 2.3 / 255 / np.sqrt(11 * 16)), ("a.exr", np.float16, 5e-4)):
        stored, _, focal, principal = photographs.load([view(tmp_path / name, camera=camera)], size)
        assert stored.dtype == dtype and stored.shape[2:0:-1] == expected
        whole = images.read_image(tmp_path / name)
        # storing rounds each pixel by half a level at most; the mean of independent roundings is nearer by their root
        np.testing.assert_allclose(images.linear(stored).mean((0, 1, 2)), whole.mean((0, 1)), atol=2 * error)
        factor = np.array(expected) / (width, height)
        np.testing.assert_allclose(focal[0], (90, 80) * factor, rtol=1e-12)
        np.testing.assert_allclose(principal[0], (0.4 * width, 0.7 * height) * factor, rtol=1e-12)


def test_what_stands_at_the_principal_point_still_does(tmp_path):
    """A spot of light in a picture that no factor divides; 1/100 of a pixel is what 8 bits leave."""
    x, y = np.meshgrid(np.arange(120) + 0.5, np.arange(90) + 0.5)
    spot = 0.8 * np.exp(-((x - 70) ** 2 + (y - 33) ** 2) / 50)
    rgba = images.levels(np.stack([spot] * 3 + [np.ones_like(spot)], -1))
    Image.fromarray(rgba).save(tmp_path / "a.png")
    stored, _, _, principal = photographs.load([view(tmp_path / "a.png", camera=schema.Camera(99, 99, 70, 33))], 47)
    assert stored.shape[1:3] == (35, 47)
    value = images.linear(stored[0])[..., 0]
    x, y = np.meshgrid(np.arange(47) + 0.5, np.arange(35) + 0.5)
    np.testing.assert_allclose([(value * x).sum() / value.sum(), (value * y).sum() / value.sum()], principal[0],
                               atol=0.01)


def test_size_of_a_data_set(tmp_path):
    messages = []
    split = load_dataset(forms.blender(tmp_path), messages.append, size=12)["train"]
    assert messages[0].endswith("16 photographs, 24x24 pixels, scaled to 12x12")
    assert split.images.shape[1:] == (12, 12, 4)
    np.testing.assert_allclose(split.focal, forms.FOCAL / 2)
    expected = forms.PICTURES[forms.splits()["train"]].reshape(14, 12, 2, 12, 2, 4).mean((2, 4))
    np.testing.assert_allclose(images.linear(split.images), expected, atol=(2 * 2.3 + 1) * 0.5 / 255)  # 8 bits, twice
    messages = []
    assert load_dataset(tmp_path, messages.append, size=48)["train"].images.shape[1:] == (24, 24, 4)
    assert "size 48 is more than the photographs have (24x24): they are left as they are" in messages
    with pytest.raises(MiNtfError, match=r"size is 7, must be 8 or more: the pixels of the photographs' longer side"):
        load_dataset(tmp_path, messages.append, size=7)


# --- memory ----------------------------------------------------------------------------------------------------------

PEAK = """
import sys
from pathlib import Path
import cv2, numpy, OpenEXR, PIL.Image
from mi_ntf.data.readers import load_dataset
from mi_ntf.data.schema import fingerprint

def peak():  # ru_maxrss would begin with what the process had that started this one
    (line,) = [line for line in open("/proc/self/status") if line.startswith("VmHWM")]
    return 1024 * int(line.split()[1])

before = peak()
splits = load_dataset(Path(sys.argv[1]), lambda _: None, size=int(sys.argv[2]) or None)
fingerprint(splits)
print(before, peak(), sum(s.images.nbytes for s in splits.values()))
"""


def peak(folder: Path, size: int) -> tuple[int, int]:
    """Bytes that a fresh process needs to read `folder`, beyond its modules, and bytes of the photographs as stored."""
    done = subprocess.run([sys.executable, "-c", PEAK, str(folder), str(size)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    before, after, stored = map(int, done.stdout.split())
    return after - before, stored


def many(folder: Path, name: str, count: int, width: int, height: int, **camera) -> Path:
    """Write a nerfstudio data set of `count` views, all of the photograph `name` of a white disc."""
    frames = [{"file_path": name, "transform_matrix": forms.C2W[i % len(forms.C2W)].tolist()} for i in range(count)]
    text = {"w": width, "h": height, "fl_x": 1.5 * width, "cx": width / 2, "cy": height / 2, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(text | camera))
    y, x = np.ogrid[:height, :width]
    disc = ((x - width / 2) ** 2 + (y - height / 2) ** 2 < (height / 4) ** 2).astype(np.uint8) * 255
    rgba = np.repeat(disc[..., None], 4, -1)
    Image.fromarray(rgba if name.endswith("png") else rgba[..., :3].copy()).save(folder / name, compress_level=1)
    (folder / "masks").mkdir()
    Image.fromarray(disc).save(folder / "masks" / f"{Path(name).stem}.png", compress_level=1)
    return folder


def test_many_photographs_take_little_more_than_their_bytes(tmp_path):
    """Reading 60 photographs of 800² takes their 154 MB of bytes (614 as float32) and 80 MB more.

    The 80 MB (58 measured) hold a photograph's pixels in several types, a table of its sums, the hull's cells, and
    samples for the flash.
    """
    memory, stored = peak(many(tmp_path, "a.png", 60, 800, 800), 0)
    assert stored == 60 * 800 * 800 * 4
    assert memory < stored + (80 << 20), f"{memory / 2**20:.0f} MiB for {stored / 2**20:.0f}"


def test_large_photographs_are_read_one_at_a_time(tmp_path):
    """Memory does not depend on the number of photographs, here of 12 megapixels with lens distortion.

    Linear light, its straight copy and two maps take 16, 16 and 8 bytes a pixel, 480 MB; the file's pixels and the mask
    take 50 MB.
    """
    memory, stored = peak(many(tmp_path, "a.jpg", 5, 4000, 3000, k1=0.04, k2=-0.01), 768)
    assert stored == 5 * 768 * 576 * 4
    assert memory < 650e6, f"{memory / 1e6:.0f} MB"


def test_masks_of_folders_of_photographs_are_told_apart(tmp_path):
    """Only `images` and its smaller copies have masks without a folder."""
    left, right, whole, small = (file_names.mask_places(tmp_path, f"{folder}/a.jpg")
                                 for folder in ("images_left", "images_right", "images", "images_4"))
    assert tmp_path / "images_left" / "a.png" in left and not set(left) & set(right)
    assert whole == small and tmp_path / "a.png" in whole

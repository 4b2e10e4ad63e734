"""Colour spaces, alpha and masks, and what is said about files that cannot be read."""

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images


def linear(srgb):
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 255), st.integers(0, 255))
def test_png_becomes_linear_and_premultiplied(tmp_path_factory, value, alpha):
    path = tmp_path_factory.mktemp("png") / "a.png"
    Image.fromarray(np.array([[[value, 255, 0, alpha]]], np.uint8), "RGBA").save(path)
    s, a = linear(value / 255), alpha / 255
    for pixel in (images.read_image(path)[0, 0], images.read_photograph(path, [])[0, 0]):
        np.testing.assert_allclose(pixel, [s * a, a, 0.0, a], atol=1e-6)  # float32


def test_jpeg_takes_its_alpha_from_the_mask(tmp_path):
    photo, mask = tmp_path / "a.jpg", tmp_path / "masks" / "a.jpg.png"
    mask.parent.mkdir()
    Image.fromarray(np.full((8, 8, 3), (200, 100, 50), np.uint8)).save(photo, quality=100, subsampling=0)
    grey = np.zeros((8, 8), np.uint8)
    grey[:, 4:], grey[:, 7] = 255, 128
    Image.fromarray(grey).save(mask)
    assert mask in images.mask_places(tmp_path, "images/a.jpg") + images.mask_places(tmp_path, "a.jpg")
    pixels = images.read_photograph(photo, images.mask_places(tmp_path, "a.jpg"))
    color = np.array([linear(c / 255) for c in (200, 100, 50)])
    # one level of 255 is what JPEG's own rounding of a flat block may change; sRGB's slope is below 2.3
    np.testing.assert_allclose(pixels[0, 5, :3], color, atol=2.3 / 255)
    np.testing.assert_allclose(pixels[0, 7, :3], color * 128 / 255, atol=2.3 / 255)
    assert (pixels[:, :4] == 0).all() and (pixels[:, 4:7, 3] == 1).all()
    assert (images.read_image(photo)[..., 3] == 1).all()
    Image.fromarray(grey[:4]).save(mask)
    with pytest.raises(MiNtfError, match=r"a.jpg.png: is 8x4, its photograph .*a.jpg is 8x8; a mask has the size"):
        images.read_photograph(photo, [mask])
    mask.write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"a.jpg.png: cannot be read as a mask"):
        images.read_photograph(photo, [mask])


def test_a_photograph_without_alpha_and_mask_is_refused(tmp_path):
    Image.fromarray(np.zeros((2, 2, 3), np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(MiNtfError, match=r"a.png: has no alpha channel and no mask \(.*masks/a.png\); training must"):
        images.read_photograph(tmp_path / "a.png", images.mask_places(tmp_path, "a.png"))


def test_exr_without_alpha_is_opaque_or_masked(tmp_path):
    rgb = np.full((2, 3, 3), 0.25, np.float32)
    with OpenEXR.File({}, {"RGB": rgb}) as file:
        file.write(str(tmp_path / "a.exr"))
    pixels = images.read_image(tmp_path / "a.exr")
    assert pixels.shape == (2, 3, 4) and (pixels[..., 3] == 1).all() and (pixels[..., :3] == 0.25).all()
    Image.fromarray(np.array([[0, 255, 51]] * 2, np.uint8)).save(tmp_path / "mask.png")
    pixels = images.read_photograph(tmp_path / "a.exr", [tmp_path / "none.png", tmp_path / "mask.png"])
    np.testing.assert_allclose(pixels[0, :, 0], [0, 0.25, 0.05], rtol=1e-6)  # float32
    np.testing.assert_allclose(pixels[0, :, 3], [0, 1, 0.2], rtol=1e-6)


def test_files_that_cannot_be_read(tmp_path):
    pixels = np.zeros((4, 6, 4), np.float32)
    pixels[1, 2, 0], pixels[3, 3, 3] = np.nan, np.inf
    images.write_exr(tmp_path / "1.exr", pixels)
    with pytest.raises(MiNtfError, match=r"1.exr: 2 pixels are NaN or infinite .half .*; write it with 32 bits"):
        images.read_image(tmp_path / "1.exr")
    (tmp_path / "1.exr").write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"1.exr: cannot be read as an image"):
        images.read_image(tmp_path / "1.exr")
    (tmp_path / "1.exr").rename(tmp_path / "1.tif")
    with pytest.raises(MiNtfError, match=r"1.tif: images of type ..tif. are not read; convert it to .exr"):
        images.read_image(tmp_path / "1.tif")
    with pytest.raises(MiNtfError, match=r"2.png does not exist; the data set is incomplete"):
        images.read_image(tmp_path / "2.png")
    Image.fromarray(np.zeros((2, 2), np.uint16)).save(tmp_path / "16.png")
    with pytest.raises(MiNtfError, match=r"16.png: image of mode 'I;16'; write it with 8 bits a channel, or as EXR"):
        images.read_image(tmp_path / "16.png")
    with OpenEXR.File({}, {"Y": np.zeros((2, 2), np.float32)}) as file:
        file.write(str(tmp_path / "y.exr"))
    with pytest.raises(MiNtfError, match=r"y.exr: has channels Y, lacks R, G, B"):
        images.read_image(tmp_path / "y.exr")


def test_bright_pixels_keep_their_value(tmp_path):
    """Half precision where it holds the image: it is half as large; single where it would write infinity."""
    pixels = np.full((2, 2, 4), 0.5, np.float32)
    images.write_exr(tmp_path / "dim.exr", pixels)
    pixels[0, 0, 1] = 1e6
    images.write_exr(tmp_path / "bright.exr", pixels)
    np.testing.assert_array_equal(images.read_image(tmp_path / "bright.exr"), pixels)
    for name, dtype in (("dim", np.float16), ("bright", np.float32)):
        with OpenEXR.File(str(tmp_path / f"{name}.exr")) as file:
            assert file.channels()["RGBA"].pixels.dtype == dtype

"""Colour spaces, alpha and masks, and what is said about files that cannot be read."""

import sys

import numpy as np
import OpenEXR
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import exr, images

cv2 = pytest.importorskip("cv2", reason="TIFF needs OpenCV: pip install 'mi-ntf[train]'")


def linear(srgb):
    return srgb / 12.92 if srgb <= 0.04045 else ((srgb + 0.055) / 1.055) ** 2.4


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 255), st.integers(0, 255))
def test_png_becomes_linear_and_premultiplied(tmp_path_factory, value, alpha):
    path = tmp_path_factory.mktemp("png") / "a.png"
    Image.fromarray(np.array([[[value, 255, 0, alpha]]], np.uint8), "RGBA").save(path)
    s, a = linear(value / 255), alpha / 255
    np.testing.assert_allclose(images.read_image(path)[0, 0], [s * a, a, 0.0, a], atol=1e-6)  # float32


def test_levels_over_black_are_the_files_where_it_is_opaque():
    """Every pair of level and alpha, against the formula; a table looks them up."""
    alpha, level = (a.astype(np.uint8) for a in np.meshgrid(np.arange(256), np.arange(256), indexing="ij"))
    straight = images.Decoded(np.repeat(level[..., None], 3, -1), alpha, True)
    stored = images.as_levels(straight)
    np.testing.assert_array_equal(stored[255, :, :3], np.repeat(np.arange(256)[:, None], 3, 1))
    np.testing.assert_array_equal(stored[..., 3], alpha)
    np.testing.assert_array_equal(images.as_levels(images.Decoded(straight.rgb, None, True), alpha), stored)
    light = np.array([linear(v / 255) for v in range(256)]) * alpha / 255
    near = np.array([linear(max(v, 0) / 255) for v in np.arange(256) - 0.5]), np.array(
        [linear(v / 255) for v in np.arange(256) + 0.5])
    for near_level in (stored[..., 1], images.levels(images.as_linear(straight))[..., 1]):
        assert (light >= near[0][near_level] - 1e-6).all() and (light <= near[1][near_level] + 1e-6).all()  # float32
    np.testing.assert_array_equal(images.levels(images.linear(stored)), stored)


@pytest.mark.parametrize(("dtype", "one"), [(np.uint16, 65535), (np.float32, 1), (np.float64, 1)])
def test_tiff_of_more_than_8_bits_is_linear(tmp_path, dtype, one):
    bgra = (np.random.default_rng(0).random((3, 5, 4)) * one).astype(dtype)
    if one == 1:
        bgra[..., :3] *= 3  # radiance has no end
    values = bgra.astype(np.float64) / one
    straight = values[..., 3:] if dtype == np.uint16 else 1  # of floating point alpha is premultiplied, as in EXR
    for name, stored, expected in (
            ("a.tif", bgra, np.concatenate([values[..., 2::-1] * straight, values[..., 3:]], -1)),
            ("b.TIFF", bgra[..., :3], np.concatenate([values[..., 2::-1], np.ones((3, 5, 1))], -1)),
            ("c.tif", bgra[..., 0], np.concatenate([np.repeat(values[..., :1], 3, -1), np.ones((3, 5, 1))], -1))):
        assert cv2.imwrite(str(tmp_path / name), stored)
        assert images.decode(tmp_path / name).assumed == (
            ("a TIFF file of 16 bits without a colour profile holds linear light",) if dtype == np.uint16 else ())
        np.testing.assert_allclose(images.read_image(tmp_path / name), expected, rtol=1e-6, atol=1e-7)  # float32


def test_tiff_of_8_bits_is_srgb_and_what_is_no_tiff_is_refused(tmp_path):
    rgba = np.random.default_rng(0).integers(0, 256, (4, 3, 4)).astype(np.uint8)
    for suffix in ("tif", "png"):
        Image.fromarray(rgba).save(tmp_path / f"a.{suffix}")
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.tif"), images.read_image(tmp_path / "a.png"))
    assert images.size_of(tmp_path / "a.tif") == (3, 4)
    cv2.imwrite(str(tmp_path / "i.tif"), np.zeros((2, 2, 3), np.int32))
    with pytest.raises(MiNtfError, match=r"i.tif: TIFF of 3 channels of int32; write it as RGB with 8 or 16 bits or"):
        images.read_image(tmp_path / "i.tif")
    cv2.imwrite(str(tmp_path / "n.tif"), np.full((2, 2, 3), np.nan, np.float32))
    with pytest.raises(MiNtfError, match=r"n.tif: 4 pixels are NaN or infinite"):
        images.read_image(tmp_path / "n.tif")
    (tmp_path / "n.tif").write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"n.tif: cannot be read as an image .*OpenCV finds no image in it"):
        images.read_image(tmp_path / "n.tif")


def test_without_opencv_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "cv2", None)
    (tmp_path / "a.tif").touch()
    with pytest.raises(MiNtfError, match=r"a.tif: TIFF of more than 8 bits needs the extra `train` \(cv2 missing"):
        images.read_image(tmp_path / "a.tif")


def test_sizes_by_the_head_alone(tmp_path):
    exr.write_exr(tmp_path / "a.exr", np.zeros((4, 6, 4)))
    Image.new("RGB", (7, 3)).save(tmp_path / "a.jpg")
    cv2.imwrite(str(tmp_path / "a.tif"), np.zeros((2, 5, 3), np.float32))  # Pillow does not know these
    assert [images.size_of(tmp_path / f"a.{s}") for s in ("exr", "jpg", "tif", "png")] == [(6, 4), (7, 3), None, None]


def test_files_that_cannot_be_read(tmp_path):
    pixels = np.zeros((4, 6, 4), np.float32)
    pixels[1, 2, 0], pixels[3, 3, 3] = np.nan, np.inf
    exr.write_exr(tmp_path / "1.exr", pixels)
    with pytest.raises(MiNtfError, match=r"1.exr: 2 pixels are NaN or infinite .half .*; write it with 32 bits"):
        images.read_image(tmp_path / "1.exr")
    (tmp_path / "1.exr").write_bytes(b"no image")
    with pytest.raises(MiNtfError, match=r"1.exr: cannot be read as an image"):
        images.read_image(tmp_path / "1.exr")
    (tmp_path / "1.exr").rename(tmp_path / "1.gif")
    with pytest.raises(MiNtfError, match=r"1.gif: images of type ..gif. are not read; convert it to .exr, .tif, .png"):
        images.read_image(tmp_path / "1.gif")
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
    exr.write_exr(tmp_path / "dim.exr", pixels)
    pixels[0, 0, 1] = 1e6
    exr.write_exr(tmp_path / "bright.exr", pixels)
    np.testing.assert_array_equal(images.read_image(tmp_path / "bright.exr"), pixels)
    for name, dtype in (("dim", np.float16), ("bright", np.float32)):
        with OpenEXR.File(str(tmp_path / f"{name}.exr")) as file:
            assert file.channels()["RGBA"].pixels.dtype == dtype


@pytest.mark.parametrize("suffix", ["webp", "bmp"])
def test_other_files_of_8_bits(tmp_path, suffix):
    rgb = np.random.default_rng(0).integers(0, 256, (4, 3, 3)).astype(np.uint8)
    Image.fromarray(rgb).save(tmp_path / f"a.{suffix}", lossless=True)
    np.testing.assert_array_equal(images.decode(tmp_path / f"a.{suffix}").rgb, rgb)
    assert images.size_of(tmp_path / f"a.{suffix}") == (3, 4)


@pytest.mark.parametrize("suffix", [".heic", ".HEIC", ".cr2", ".avif"])
def test_photographs_of_telephones_and_raw_files_say_what_to_do(tmp_path, suffix):
    (tmp_path / f"a{suffix}").write_bytes(b"\0\0\0\x18ftypheic" + bytes(99))
    with pytest.raises(MiNtfError, match=rf"a{suffix}: images of type '{suffix}' are not read; convert it to .exr, "):
        images.decode(tmp_path / f"a{suffix}")


def test_photographs_of_200_megapixels(tmp_path, recwarn):
    """Telephones take such; Pillow refuses them by default, and warns of half as many."""
    Image.new("1", (20000, 10000)).save(tmp_path / "a.png", compress_level=1)
    assert images.size_of(tmp_path / "a.png") == (20000, 10000)
    with pytest.raises(MiNtfError, match=r"a.png: image of mode '1'; write it"):  # its pixels would fill a gigabyte
        images.decode(tmp_path / "a.png")
    assert not recwarn.list


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("tag", [3, 6])
def test_tiff_that_libraries_would_turn_is_refused(tmp_path, dtype, tag):
    Image.fromarray(np.zeros((4, 6), dtype)).save(tmp_path / "a.tif", tiffinfo={274: tag})
    with pytest.raises(MiNtfError, match=f"TIFF with Exif orientation {tag} is not read"):
        images.decode(tmp_path / "a.tif")

"""Reading images as `mi-ntf compare` does, and its error texts."""

import json

import numpy as np
import OpenEXR
import pytest
from helpers.variants import VARIANT
from skimage import io

from mi_ntf.commands import options
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import metrics
from mi_ntf.evaluate.compare import compare, compare_arrays, print_table, read_image
from mi_ntf.evaluate.limits import METRICS


@pytest.fixture
def rgba():
    rng = np.random.default_rng(3)
    alpha = rng.uniform(0, 1, (16, 20, 1))
    return np.float32(np.concatenate([rng.uniform(0, 2, (16, 20, 3)) * alpha, alpha], axis=-1))


def _write(path, channels):
    with OpenEXR.File({"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(path))


def write_exr(path, pixels):
    _write(path, {c: np.ascontiguousarray(pixels[..., i]) for i, c in enumerate("RGBA"[:pixels.shape[-1]])})


def test_exr_round_trip_and_comparison(tmp_path, rgba):
    write_exr(tmp_path / "a.exr", rgba)
    np.testing.assert_array_equal(read_image(tmp_path / "a.exr"), rgba)
    write_exr(tmp_path / "b.exr", rgba[..., :3] * 1.1)
    result = compare(tmp_path / "b.exr", tmp_path / "a.exr")
    assert list(result)[: len(METRICS)] == list(METRICS)
    assert result["rmse"] == pytest.approx(0.1 * np.sqrt(np.mean(rgba[..., :3] ** 2)), rel=1e-5)
    assert result["relative_rmse"] == pytest.approx(0.1, rel=1e-5)
    assert result["max_abs"] == pytest.approx(0.1 * rgba[..., :3].max(), rel=1e-5)
    assert result["psnr"] == pytest.approx(metrics.psnr(rgba[..., :3] * 1.1, rgba[..., :3]), rel=1e-5)


def test_aov_layers_are_dropped(tmp_path, rgba):
    channels = {c: np.ascontiguousarray(rgba[..., i]) for i, c in enumerate("RGBA")}
    _write(tmp_path / "aov.exr", channels | {"albedo.R": channels["R"] * 0 + 5, "depth.T": channels["R"] * np.nan})
    np.testing.assert_array_equal(read_image(tmp_path / "aov.exr"), rgba)


def test_images_of_mitsuba_are_read(tmp_path, rgba):
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(VARIANT)
    mi.Bitmap(rgba).write(str(tmp_path / "m.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "m.exr"), rgba)
    mi.Bitmap(rgba[..., :1]).write(str(tmp_path / "grey.exr"))
    np.testing.assert_array_equal(read_image(tmp_path / "grey.exr")[..., 2], rgba[..., 0])


def test_png_is_srgb_with_straight_alpha(tmp_path):
    encoded = np.zeros((12, 12, 4), np.uint8)
    encoded[..., :3] = 188  # sRGB 0.737 is linear 0.503
    encoded[..., 3] = 102  # 0.4
    io.imsave(tmp_path / "a.png", encoded, check_contrast=False)
    # float32 of the curve
    np.testing.assert_allclose(read_image(tmp_path / "a.png")[3, 4], [0.502886 * 0.4] * 3 + [0.4], rtol=1e-5)
    io.imsave(tmp_path / "grey.png", encoded[..., 0], check_contrast=False)
    np.testing.assert_allclose(read_image(tmp_path / "grey.png")[3, 4], [0.502886] * 3 + [1], rtol=1e-5)


def test_errors_name_the_fault(tmp_path, rgba):
    write_exr(tmp_path / "a.exr", rgba)
    with pytest.raises(MiNtfError, match=r"nowhere.exr does not exist; render it first"):
        compare(tmp_path / "nowhere.exr", tmp_path / "a.exr")
    write_exr(tmp_path / "small.exr", rgba[:12])
    with pytest.raises(MiNtfError, match=r"small.exr has 20×12 pixels, .*a.exr has 20×16; render both at one size"):
        compare(tmp_path / "small.exr", tmp_path / "a.exr")
    broken = rgba.copy()
    broken[3, 4:7, 1] = np.nan
    broken[0, 0] = np.inf
    write_exr(tmp_path / "nan.exr", broken)
    with pytest.raises(MiNtfError, match=r"nan.exr: 4 of 320 pixels are NaN or infinite"):
        compare(tmp_path / "nan.exr", tmp_path / "a.exr")
    (tmp_path / "fake.exr").write_bytes(b"not an image")
    with pytest.raises(MiNtfError, match=r"fake.exr is no readable EXR"):
        read_image(tmp_path / "fake.exr")
    (tmp_path / "fake.png").write_bytes(b"not an image")
    with pytest.raises(MiNtfError, match=r"fake.png is no readable PNG"):
        read_image(tmp_path / "fake.png")
    (tmp_path / "a.jpg").write_bytes(b"")
    with pytest.raises(MiNtfError, match=r"unknown ending '.jpg'; give .exr or .png"):
        read_image(tmp_path / "a.jpg")
    _write(tmp_path / "depth.exr", {"Z": np.zeros((4, 4), np.float32)})
    with pytest.raises(MiNtfError, match=r"no part has the channels R, G, B or Y; found Z"):
        read_image(tmp_path / "depth.exr")


def test_aligned_and_masked_figures(rng):
    """An object of wrong albedo over a background that is wrong in its own way."""
    truth = rng.uniform(0.1, 1, (24, 24, 3))
    alpha = np.zeros((24, 24))
    alpha[6:18, 4:20] = 1
    inside = alpha > 0
    truth[~inside] *= 0.2
    image = truth * np.array([1.25, 0.8, 2.0])
    result = compare_arrays(image, truth, alpha)
    assert result["aligned"]["factors"] == pytest.approx([0.8, 1.25, 0.5])
    assert result["aligned"]["relative_rmse"] < 1e-12 and result["aligned"]["ssim"] == pytest.approx(1)
    assert result["masked"]["coverage"] == pytest.approx(12 * 16 / 24**2)
    image[~inside] = rng.uniform(0, 5, (24 * 24 - 12 * 16, 3))
    result = compare_arrays(image, truth, alpha)
    assert result["masked_aligned"]["factors"] == pytest.approx([0.8, 1.25, 0.5])
    assert result["masked_aligned"]["relative_rmse"] < 1e-12 < 0.1 < result["aligned"]["relative_rmse"]
    expected = np.sqrt(((image - truth)[inside] ** 2).mean() / (truth[inside] ** 2).mean())
    assert result["masked"]["relative_rmse"] == pytest.approx(expected)
    assert result["masked"]["max_abs"] == pytest.approx(np.abs(image - truth)[inside].max())
    errors = metrics.srgb(image) - metrics.srgb(truth)
    assert result["masked"]["psnr"] == pytest.approx(-10 * np.log10((errors[inside] ** 2).mean()))


@pytest.mark.parametrize("alpha", [None, np.ones((16, 16)), np.zeros((16, 16))], ids=["none", "full", "empty"])
def test_no_mask_where_alpha_tells_nothing(alpha, rng):
    truth = rng.uniform(size=(16, 16, 3))
    assert "masked" not in compare_arrays(truth, truth, alpha)


def test_black_channels_stay_black(rng):
    truth = rng.uniform(size=(16, 16, 3)) * [1, 0, 1]
    assert compare_arrays(truth / 2, truth)["aligned"]["factors"] == pytest.approx([2, 1, 2])


def test_one_factor_takes_out_of_every_metric_what_it_can(rng):
    """Raw figures and aligned ones of a large enough picture: all metrics but LPIPS."""
    truth = rng.uniform(0.1, 0.4, (176, 176, 3))
    result = compare_arrays(truth * 2, truth)
    assert result["rmse"] == pytest.approx(np.sqrt(np.mean(truth**2))) and result["aligned"]["rmse"] < 1e-12
    assert result["ms_ssim"] < 0.98 and result["aligned"]["ms_ssim"] == pytest.approx(1)
    assert result["ldr_flip"] > 0.05 and result["aligned"]["ldr_flip"] < 1e-5
    assert "not_measured" not in result and "lpips" not in result


def test_small_pictures_lack_what_needs_larger_ones(rng, capsys):
    truth = rng.uniform(size=(10, 12, 3))
    result = compare_arrays(truth, truth, np.arange(12) * np.ones((10, 1)) > 5)
    assert result["ms_ssim"] is result["ssim"] is result["masked"]["ms_ssim"] is result["aligned"]["ssim"] is None
    assert result["not_measured"] == {
        "ssim": {"reason": "needs 11×11 pixels, the image has 12×10", "remedy": "render larger"},
        "ms_ssim": {"reason": "needs 176×176 pixels, the image has 12×10", "remedy": "render larger"}}
    assert result["psnr"] == np.inf and result["ldr_flip"] == result["flip"] == 0
    print_table(result)
    text = capsys.readouterr().out
    assert "not measured:" in text and "176×176" in text and "to measure MS-SSIM: render larger" in text


def test_table_shows_every_metric(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    figures = dict.fromkeys(METRICS, 0.125)
    print_table(figures | {"aligned": figures | {"factors": [0.5, 1.0, 2.0]}, "masked": figures | {"coverage": 0.25},
                           "picture": "a.png"})
    text = capsys.readouterr().out
    assert text.count("0.125") == 3 * len(METRICS) and "HDR-FLIP" in text and "PSNR, dB" in text
    assert "aligned: red, green, blue times 0.5000, 1.0000, 2.0000" in text and "object: 25.0%" in text
    assert "picture: a.png" in text and max(map(len, text.splitlines())) <= 80


def test_grey_png_of_16_bits(tmp_path):
    from PIL import Image

    levels = np.linspace(0, 65535, 64).astype(np.uint16).reshape(8, 8)
    Image.fromarray(levels).save(tmp_path / "a.png")
    expected = metrics.linear(levels / np.float32(65535))
    for channel in range(3):
        np.testing.assert_allclose(read_image(tmp_path / "a.png")[..., channel], expected, atol=1e-5)


def test_the_picture_is_none_of_the_images(tmp_path, rgba):
    write_exr(tmp_path / "a.exr", rgba)
    (tmp_path / "b.png").write_bytes(b"kept")
    with pytest.raises(MiNtfError, match="is one of the images to compare"):
        compare(tmp_path / "a.exr", tmp_path / "b.png", tmp_path / "b.png")
    assert (tmp_path / "b.png").read_bytes() == b"kept"


def test_figures_that_are_no_numbers_are_null_in_json(capsys):
    options.print_report({"psnr": float("inf"), "error": float("nan")}, True, print)
    assert json.loads(capsys.readouterr().out, parse_constant=pytest.fail) == {"psnr": None, "error": None}

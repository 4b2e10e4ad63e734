"""Limits on metrics, as `mi-ntf compare` judges them."""

import numpy as np
import OpenEXR
import pytest

from mi_ntf import cli
from mi_ntf.evaluate import metrics, perceptual
from mi_ntf.evaluate.limits import METRICS, Limits, broken, given

RESULT = {"psnr": 30.0, "ssim": 0.9, "relative_rmse": 0.1, "max_abs": 2.0, "flip": float("nan"), "ms_ssim": None,
          "masked": {"psnr": 20.0, "relative_rmse": 0.4, "ms_ssim": None},
          "not_measured": {"ms_ssim": {"reason": "too small", "remedy": "render larger"}}}


def test_every_metric_has_a_function_and_a_limit_in_its_direction():
    names = list(vars(Limits()))
    assert names == ["max_relative_rmse", "max_rmse", "min_psnr", "min_ssim", "min_ms_ssim", "max_flip", "max_ldr_flip",
                     "max_lpips", "max_abs"]
    assert all(callable(getattr(perceptual if name == "lpips" else metrics, name)) for name in METRICS)
    assert not given(Limits()) and given(Limits(max_abs=0.0))


@pytest.mark.parametrize(
    ("limits", "masked", "failing"),
    [
        ({}, False, []),
        ({"min_psnr": 30.0, "max_relative_rmse": 0.1, "max_abs": 2.0}, False, []),  # the limit itself is allowed
        ({"min_psnr": 30.1, "max_relative_rmse": 0.0999}, False, ["relative_rmse", "psnr"]),
        ({"max_abs": 1.9, "min_ssim": 0.91}, False, ["ssim", "max_abs"]),
        ({"min_psnr": 30.0, "max_relative_rmse": 0.1}, True, ["relative_rmse", "psnr"]),
        ({"min_psnr": 20.0, "max_relative_rmse": 0.4}, True, []),
        ({"max_flip": 1e9}, False, ["flip"]),  # NaN
        ({"min_psnr": float("nan")}, False, ["psnr"]),
        ({"min_ms_ssim": 0.0}, False, ["ms_ssim"]),
    ],
)
def test_limits(limits, masked, failing):
    found = broken(RESULT, Limits(**limits), masked)
    assert [failure["metric"] for failure in found] == failing


def test_equal_pictures_keep_a_limit_on_infinite_psnr():
    assert broken({"psnr": np.inf}, Limits(min_psnr=99.0)) == []


def test_lines_name_metric_value_and_limit():
    [failure] = broken(RESULT, Limits(max_relative_rmse=0.25), masked=True)
    assert failure == {"metric": "relative_rmse", "value": 0.4, "limit": 0.25,
                       "says": "relative RMSE of the object is 0.4, more than --max-relative-rmse 0.25 allows"}
    [failure] = broken(RESULT, Limits(min_ms_ssim=0.9))
    assert failure["value"] is None and failure["says"] == (
        "MS-SSIM was not measured, so --min-ms-ssim 0.9 cannot be judged: too small; render larger")
    [failure] = broken({"psnr": 30.0}, Limits(min_psnr=20.0), masked=True)
    assert failure["says"].endswith("cannot be judged: the reference has no alpha that tells an object from a "
                                    "background; leave --masked out")


def test_the_command_judges_object_or_whole_picture(tmp_path, capsys, rng):
    """A wrong background beside a right object: the whole breaks the limit that the object keeps."""
    reference = np.float32(rng.uniform(0.2, 1, (32, 40, 4)))
    reference[..., 3] = np.arange(40) < 16
    image = reference.copy()
    image[:, 30:, :3] *= 2
    for name, pixels in (("a.exr", image), ("b.exr", reference)):
        channels = {c: np.ascontiguousarray(pixels[..., i]) for i, c in enumerate("RGBA")}
        with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
            file.write(str(tmp_path / name))
    line = ["compare", str(tmp_path / "a.exr"), str(tmp_path / "b.exr"), "--max-relative-rmse", "0.1", "--max-abs", "5"]
    assert cli.main([*line, "--masked"]) == 0
    progress = f"comparing {tmp_path / 'a.exr'}\n"
    assert capsys.readouterr().err.removeprefix("starting compare\n") == progress
    assert cli.main(line) == 1
    out, err = capsys.readouterr()
    value = metrics.relative_rmse(image[..., :3], reference[..., :3])
    assert err.removeprefix("starting compare\n") == progress + (
        f"mi-ntf: relative RMSE is {value:.6g}, more than --max-relative-rmse 0.1 allows\n")
    assert "relative RMSE" in out and "largest error" in out

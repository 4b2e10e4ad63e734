"""Photographs that are scaled copies of those that the cameras are of."""

import json

import numpy as np
import pytest
from data import forms
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.readers import load_dataset


def enlarged(folder, factor: int, count: int = forms.VIEWS):
    """Enlarge the first `count` photographs and masks of `folder` by `factor`."""
    for kind in ("images", "masks"):
        for path in sorted((folder / kind).glob("*.png"))[:count]:
            image = Image.open(path)
            image.resize((factor * image.width, factor * image.height), Image.Resampling.NEAREST).save(path)
    return folder


@pytest.mark.parametrize("form", [forms.colmap, forms.nerfstudio])
def test_cameras_are_scaled_with_the_photographs(tmp_path, form):
    messages = []
    split = load_dataset(enlarged(form(tmp_path), 3), messages.append)["train"]
    np.testing.assert_allclose(split.focal, 3 * forms.FOCAL)
    np.testing.assert_allclose(split.principal, 3 * forms.SIZE / 2)
    assert split.images.shape[1:3] == (72, 72)
    assert sum(text.startswith("assumed: photographs are copies scaled by 3, and so the cameras are scaled by that "
                               "(72x72, ") for text in messages) == 1


def test_a_pixel_of_rounding(tmp_path):
    """Photographs of 24x24, of cameras of 101x99 pixels."""
    forms.nerfstudio(tmp_path)
    data = json.loads((tmp_path / "transforms.json").read_text())
    data.update(w=101, h=99, cx=50.5, cy=49.5, fl_x=99.0, fl_y=98.0)
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    split = load_dataset(tmp_path, lambda _: None)["train"]
    np.testing.assert_allclose(split.focal[0], (99 * 24 / 101, 98 * 24 / 99))
    np.testing.assert_allclose(split.principal[0], 12)


@pytest.mark.parametrize(("change", "text"), [
    (lambda f: enlarged(f, 2, 15),
     r"000.png: is 48x48, .*image '000.png' says 24x24; photograph and camera must belong"),
    (lambda f: [Image.open(p).crop((1, 1, 23, 23)).save(p) for k in ("images", "masks") for p in (f / k).iterdir()],
     r"000.png: is 22x22, .*image '000.png' says 24x24; photograph and camera must belong"),
    (lambda f: [Image.open(p).crop((0, 0, 12, 24)).save(p) for k in ("images", "masks") for p in (f / k).iterdir()],
     r"000.png: is 12x24, .*image '000.png' says 24x24; photograph and camera must belong"),
], ids=["not all", "cropped", "cropped to another shape"])
def test_what_is_no_scaled_copy_is_refused(tmp_path, change, text):
    change(forms.colmap(tmp_path))
    with pytest.raises(MiNtfError, match=text):
        load_dataset(tmp_path, lambda _: None)

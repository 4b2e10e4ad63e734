"""EXR files as renderers write them: windows, layers and parts, primaries."""

import numpy as np
import OpenEXR
import pytest
from data import forms

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import exr, images
from mi_ntf.data.readers import load_dataset

PICTURE = np.random.default_rng(0).random((6, 8, 4)).astype(np.float32)


def write(path, layers: dict[str, np.ndarray], **header):
    """Write one part with the channels of `layers`: pictures (H, W, 3 or 4) by the names before R, G, B, A."""
    channels = {f"{name}{c}": np.ascontiguousarray(picture[..., k]) for name, picture in layers.items()
                for k, c in enumerate("RGBA"[:picture.shape[-1]])}
    with OpenEXR.File(header, channels) as file:
        file.write(str(path))


def windows(data, display) -> dict:
    """Return the header of windows (left, top, right, bottom), ends included."""
    return {f"{name}Window": (np.array(box[:2], np.int32), np.array(box[2:], np.int32))
            for name, box in (("data", data), ("display", display))}


@pytest.mark.parametrize(("data", "display", "rows", "columns"), [
    ((2, 3, 9, 8), (0, 0, 11, 9), slice(3, 9), slice(2, 10)),       # within
    ((-2, -1, 5, 4), (0, 0, 5, 4), slice(-1, 5), slice(-2, 6)),     # overscan left and above
    ((12, 11, 19, 16), (10, 10, 15, 14), slice(1, 7), slice(2, 10)),  # a corner elsewhere, overscan right and below
])
@pytest.mark.parametrize("alpha", [True, False])
def test_the_picture_is_the_display_window(tmp_path, data, display, rows, columns, alpha):
    """The oracle draws on a canvas with a border and cuts the display window out."""
    write(tmp_path / "a.exr", {"": PICTURE if alpha else PICTURE[..., :3]}, **windows(data, display))
    width, height = display[2] - display[0] + 1, display[3] - display[1] + 1
    canvas = np.zeros((height + 20, width + 20, 4), np.float32)
    canvas[rows.start + 10:rows.stop + 10, columns.start + 10:columns.stop + 10] = PICTURE
    image = images.decode(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.rgb, canvas[10:-10, 10:-10, :3])
    assert (image.alpha is None) != alpha
    assert not alpha or (image.alpha == canvas[10:-10, 10:-10, 3]).all()
    assert images.size_of(tmp_path / "a.exr") == exr.size(tmp_path / "a.exr") == (width, height)
    assert image.assumed == ("an EXR file's picture is its display window, beyond the data window empty",)


def test_field_of_view_of_cropped_renderings(tmp_path):
    forms.blender(tmp_path)
    for split, views in forms.splits().items():
        for i in views:
            (tmp_path / f"{split}/r_{i}.png").unlink()
            part = forms.PICTURES[i, 3:20, 2:22].astype(np.float32)
            write(tmp_path / f"{split}/r_{i}.exr", {"": part}, **windows((2, 3, 21, 19), (0, 0, 23, 23)))
    messages = []
    split = load_dataset(tmp_path, messages.append)["train"]
    np.testing.assert_allclose(split.focal, forms.FOCAL)
    np.testing.assert_allclose(split.images[:, 3:20, 2:22], forms.PICTURES[:14, 3:20, 2:22], atol=1e-3)
    assert any(text.startswith("assumed: an EXR file's picture is its display window") for text in messages)


@pytest.mark.parametrize(("names", "chosen"), [
    (["", "albedo."], ""), (["ViewLayer.Combined.", "ViewLayer.DiffCol."], "ViewLayer.Combined."),
    (["beauty.", "diffuse."], "beauty."), (["View Layer.Image."], "View Layer.Image."), (["Layer.RGBA.", "a.b."],
                                                                                        "Layer.RGBA.")])
def test_layers(tmp_path, names, chosen):
    layers = {name: PICTURE if name == chosen else PICTURE[..., :3] * 0.5 for name in names}
    write(tmp_path / "a.exr", layers)
    image = images.decode(tmp_path / "a.exr")
    np.testing.assert_array_equal(np.concatenate([image.rgb, image.alpha[..., None]], -1), PICTURE)
    text = (f"the layer '{chosen[:-1]}' of an EXR file is its picture",)
    assert image.assumed == (text if chosen else ())


@pytest.mark.parametrize("names", [("depth", "beauty", "diffuse"), ("diffuse", "beauty"), ("depth", "beauty")])
def test_parts(tmp_path, names):
    """By the part's name, wherever it stands."""
    channels = {"depth": {"Z": PICTURE[..., 0].copy()},
                "beauty": {c: PICTURE[..., k].copy() for k, c in enumerate("RGB")},
                "diffuse": {c: PICTURE[..., 3 - k].copy() for k, c in enumerate("RGB")}}
    with OpenEXR.File([OpenEXR.Part({}, channels[name], name) for name in names]) as file:
        file.write(str(tmp_path / "a.exr"))
    image = images.decode(tmp_path / "a.exr")
    np.testing.assert_array_equal(image.rgb, PICTURE[..., :3])
    assert image.assumed == ("the layer 'beauty' of an EXR file is its picture",)


@pytest.mark.parametrize(("names", "header", "text"), [
    (["a.Combined.", "b.Combined."], {}, r"a.exr: has the layers \['a.Combined', 'b.Combined'\], of which none alone "
                                         "is called combined, beauty, rgba; write the rendered picture as R, G, B, A"),
    (["DiffCol.", "GlossCol."], {}, r"a.exr: has the layers \['DiffCol', 'GlossCol'\], of which none alone"),
    ([""], {"chromaticities": (0.713, 0.293, 0.165, 0.83, 0.128, 0.044, 0.32168, 0.33767)},
     r"a.exr: its 'chromaticities' are \[0.713, .* other primaries than Rec. 709's; convert it"),
    ([""], windows((0, 0, 7, 5), (0, 0, 1 << 20, 5)), r"a.exr: its display window is 1048577x6 pixels; write it with"),
])
def test_refused(tmp_path, names, header, text):
    write(tmp_path / "a.exr", {name: PICTURE for name in names}, **header)
    with pytest.raises(MiNtfError, match=text):
        images.decode(tmp_path / "a.exr")


NAMES = {"lower case": "rgba", "Nuke": ("red", "green", "blue", "alpha"),
         "title case": ("Red", "Green", "Blue", "Alpha")}


@pytest.mark.parametrize("names", NAMES.values(), ids=NAMES)
@pytest.mark.parametrize("layer", ["", "rgba."])
def test_names_of_channels(tmp_path, names, layer):
    with OpenEXR.File({}, {layer + name: PICTURE[..., k].copy() for k, name in enumerate(names)}) as file:
        file.write(str(tmp_path / "a.exr"))
    image = images.decode(tmp_path / "a.exr")
    np.testing.assert_array_equal(np.concatenate([image.rgb, image.alpha[..., None]], -1), PICTURE)


def test_the_composite_goes_before_the_layers_of_blender(tmp_path):
    write(tmp_path / "a.exr", {"ViewLayer.Combined.": PICTURE * 0.5, "Composite.Combined.": PICTURE})
    np.testing.assert_array_equal(images.decode(tmp_path / "a.exr").rgb, PICTURE[..., :3])


def test_whole_numbers_are_refused(tmp_path):
    write(tmp_path / "a.exr", {"": (255 * PICTURE).astype(np.uint32)})
    with pytest.raises(MiNtfError, match=r"a.exr: its channels are whole numbers, whose white is not known; write it "):
        images.decode(tmp_path / "a.exr")

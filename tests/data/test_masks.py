"""Masks of any depth and colours: shares where they are white on black, labels where they cannot be shares."""

import numpy as np
import pytest
from data import forms
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import masks
from mi_ntf.data.readers import load_dataset

SHOWS = np.zeros((24, 24), bool)
SHOWS[4:20, 6:18] = True
SHARES = np.where(SHOWS, 255, 0).astype(np.uint8)
SHARES[4, 6:18] = np.arange(12) * 20


def labels(*colours) -> np.ndarray:
    """Return stripes of `colours` in the object's place, and 0 elsewhere."""
    picture = np.zeros((*SHOWS.shape, *np.shape(colours[0])), np.uint16 if np.max(colours) > 255 else np.uint8)
    for i, colour in enumerate(colours):
        picture[:, i::len(colours)] = colour
    picture[~SHOWS] = 0
    return picture


def palette(*colours) -> Image.Image:
    image = Image.fromarray(SHOWS.astype(np.uint8)).convert("L")
    image = Image.frombytes("P", image.size, image.tobytes())
    image.putpalette(sum(colours, ()))
    return image


def cut_out(mode: str) -> Image.Image:
    """Return the object in its own colours, with black and grey among them, before transparency."""
    rng = np.random.default_rng(0)
    rgb = rng.integers(0, 256, (24, 24, 3)).astype(np.uint8)
    return Image.fromarray(np.concatenate([rgb, SHARES[..., None]], -1)).convert(mode)


@pytest.mark.parametrize("picture", [
    SHARES, SHARES.astype(np.uint16) * 257, SHARES.astype(np.uint16),
    np.concatenate([np.repeat(SHARES[..., None], 3, -1), np.full((24, 24, 1), 255, np.uint8)], -1),
    cut_out("RGBA"), cut_out("LA"),
], ids=["8 bits", "16 bits", "8 of 16 bits", "opaque RGBA", "RGBA cut-out", "LA cut-out"])
def test_shares(tmp_path, picture):
    path = tmp_path / "m.png"
    (picture if isinstance(picture, Image.Image) else Image.fromarray(picture)).save(path)
    np.testing.assert_array_equal(masks.read(path)[0], SHARES)


@pytest.mark.parametrize("picture", [
    labels((255, 0, 0)), labels((0, 0, 90)), labels((128, 0, 0), (0, 128, 0), (64, 64, 192)),
    palette((0, 0, 0), (128, 0, 0)), palette((0, 0, 0), (1, 1, 1)), Image.fromarray(SHOWS),
    labels(1), labels(1, 2, 3), labels(76), labels(128), labels(1).astype(np.uint16), labels(1, 300),
], ids=["red", "blue", "three colours", "palette", "palette of 0 and 1", "one bit", "0 and 1", "numbers", "grey of red",
        "half", "0 and 1 of 16 bits", "numbers of 16 bits"])
def test_labels(tmp_path, picture):
    path = tmp_path / "m.png"
    (picture if isinstance(picture, Image.Image) else Image.fromarray(picture)).save(path)
    np.testing.assert_array_equal(masks.read(path)[0], np.where(SHOWS, 255, 0))


@pytest.mark.parametrize(("picture", "text"), [
    (np.random.default_rng(0).integers(0, 256, (48, 48, 3)).astype(np.uint8) * np.tri(48, dtype=np.uint8)[..., None],
     r"m.png: is coloured, and it has more than 256 colours, so it is no mask of labels on black; write the object"),
    (labels((255, 0, 0)) + np.array([0, 40, 40], np.uint8), r"m.png: is coloured, and nothing in it is black, so"),
    (np.arange(576).reshape(24, 24).astype(np.uint8) // 2, r"m.png: its brightest level is 127 of 255, and it has 128 "
     "levels, so neither is white the object nor are they labels; write the object white"),
], ids=["a picture", "no black", "dark shares"])
def test_what_is_no_mask_is_refused(tmp_path, picture, text):
    Image.fromarray(picture).save(tmp_path / "m.png")
    with pytest.raises(MiNtfError, match=text):
        masks.read(tmp_path / "m.png")


@pytest.mark.parametrize(("level", "alpha"), [(0, 0), (1, 255), (102, 102), (255, 255)])
def test_a_mask_of_one_level(tmp_path, level, alpha):
    """A share, but for 1: the object of a mask of 0 and 1 that fills the picture."""
    Image.new("L", (3, 2), level).save(tmp_path / "m.png")
    assert (masks.read(tmp_path / "m.png")[0] == alpha).all()


def test_a_grey_mask_with_the_colours_noise_of_jpeg_is_no_coloured_one(tmp_path):
    noise = np.random.default_rng(0).integers(-7, 8, (24, 24, 3))
    Image.fromarray((SHARES[..., None] + noise).clip(0, 255).astype(np.uint8)).save(tmp_path / "m.png")
    result, note = masks.read(tmp_path / "m.png")
    assert np.abs(result.astype(int) - SHARES).max() <= 7 and note is None


def test_red_masks_of_a_data_set_are_said(tmp_path):
    forms.colmap(tmp_path)
    expected = []
    for path in sorted((tmp_path / "masks").iterdir()):
        shows = np.asarray(Image.open(path)) > 100
        expected.append(shows)
        Image.fromarray(shows[..., None] * np.array([200, 0, 0], np.uint8)).save(path)
    messages = []
    result = load_dataset(tmp_path, messages.append)["val"].images[0]
    np.testing.assert_array_equal(result[..., 3], 255 * expected[7])
    assert any(text.startswith("assumed: a coloured mask shows the object where it is not black (16 photographs, first")
               for text in messages)


@pytest.mark.parametrize("opaque", [True, False])
def test_an_opaque_alpha_channel_is_no_mask(tmp_path, opaque):
    """Screenshots and many editors write one; a cut-out's alpha goes before the folder of masks."""
    forms.colmap(tmp_path)
    for path in (tmp_path / "images").iterdir():
        with Image.open(path) as image:
            image.putalpha(255 if opaque else Image.fromarray(SHARES))
        image.save(path)
    messages = []
    pictures = load_dataset(tmp_path, messages.append)["train"].images
    if opaque:
        np.testing.assert_array_equal(pictures[0, ..., 3], forms.straight_srgb(forms.PICTURES[0])[..., 3])
        assert "assumed: an alpha channel that is opaque throughout gives way to a mask (16 photographs" in " ".join(
            messages)
    else:
        np.testing.assert_array_equal(pictures[0, ..., 3], SHARES)


@pytest.mark.parametrize("name", ["{}_mask.png", "{}.mask.png", "{}.png.mask.png", "{}.webp", "{}.bmp"])
def test_masks_as_other_programs_name_them(tmp_path, name):
    forms.colmap(tmp_path)
    expected = load_dataset(tmp_path, lambda _: None)["train"].images
    for path in sorted((tmp_path / "masks").iterdir()):
        with Image.open(path) as image:
            image.load()
        path.unlink()
        image.save(tmp_path / "masks" / name.format(path.stem), lossless=True)
    np.testing.assert_array_equal(load_dataset(tmp_path, lambda _: None)["train"].images, expected)

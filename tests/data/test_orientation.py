"""Photographs with an Exif orientation, and portraits among landscapes: pixels, masks and rays stay together."""

import json
from pathlib import Path

import numpy as np
import pytest
from data import forms
from PIL import Image, ImageOps

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import exif, images, masks, schema
from mi_ntf.data.inspect import inspect
from mi_ntf.data.readers import load_dataset

LANDSCAPES = forms.PICTURES[:, 3:21]
"""(VIEWS, 18, 24, 4), of which the principal point is the middle."""
ROLL = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
"""A camera rolled to the left: what it sees turns to the right."""


def write(folder: Path, tags=(1,), poses: str = "stored", masks: str = "stored", portraits=(), pictures=LANDSCAPES
          ) -> Path:
    """Write a nerfstudio set of opaque PNG with the Exif orientations `tags` in turn.

    `poses` and `masks` are "stored", as the file's pixels lie, or "upright". `portraits` are taken with the camera held
    upright, without a tag.
    """
    frames = []
    for kind in ("images", "masks"):
        (folder / kind).mkdir(parents=True)
    for i, c2w in enumerate(forms.C2W):
        tag, levels = tags[i % len(tags)], forms.straight_srgb(pictures[i])
        if i in portraits:
            levels, c2w = np.rot90(levels, -1), c2w @ ROLL
        stored = exif.turned(levels, exif.INVERSE[tag]) if poses == "upright" else levels
        mask = exif.turned(stored, tag) if masks == "upright" else stored
        tag_of = Image.Exif()
        tag_of[exif.ORIENTATION] = tag
        Image.fromarray(np.ascontiguousarray(stored[..., :3])).save(folder / f"images/{i:03d}.png", exif=tag_of)
        Image.fromarray(np.ascontiguousarray(mask[..., 3])).save(folder / f"masks/{i:03d}.png")
        height, width = levels.shape[:2]
        frames.append({"file_path": f"images/{i:03d}.png", "transform_matrix": c2w.tolist(), "w": width, "h": height,
                       "cx": width / 2, "cy": height / 2, "fl_x": forms.FOCAL})
    (folder / "transforms.json").write_text(json.dumps({"frames": frames}))
    return folder


def check(splits, pictures=LANDSCAPES) -> None:
    """Check that every pixel shows what its ray sees, with rays and `pictures` turned alike."""
    for name, views in {"train": [*range(7), *range(9, 16)], "val": [7], "test": [8]}.items():
        split, (height, width) = splits[name], pictures.shape[1:3]
        for k, i in enumerate(views):
            h, w = split.images.shape[1:3]
            rays = schema.pixel_rays(split.c2w[k], split.focal[k], w, h, split.principal[k])[1]
            directions = schema.pixel_rays(forms.C2W[i], forms.FOCAL, width, height)[1]
            turns = [t for t in range(4) if (again := np.rot90(directions, t)).shape == rays.shape
                     and np.abs(again - rays).max() < 1e-6]
            assert len(turns) == 1
            # the file's 8 bits, and those over black: `test_readers.check_8_bit_pixels`
            np.testing.assert_allclose(images.linear(split.images[k]), np.rot90(pictures[i], turns[0]),
                                       atol=(2 * 2.3 + 1) * 0.5 / 255)


@pytest.mark.parametrize("tag", range(1, 9))
def test_pixels_are_turned_as_pillow_turns_them(tmp_path, tag):
    pixels = np.random.default_rng(0).integers(0, 256, (3, 5, 3)).astype(np.uint8)
    tag_of = Image.Exif()
    tag_of[exif.ORIENTATION] = tag
    for name in ("a.png", "a.tif"):
        Image.fromarray(pixels).save(tmp_path / name, exif=tag_of)
        assert exif.read_header(tmp_path / name) == (tag, (5, 3), False) and images.size_of(tmp_path / name) == (5, 3)
    with Image.open(tmp_path / "a.png") as image:
        expected = np.asarray(ImageOps.exif_transpose(image))
    np.testing.assert_array_equal(exif.turned(pixels, tag), expected)
    np.testing.assert_array_equal(exif.turned(expected, exif.INVERSE[tag]), pixels)
    np.testing.assert_array_equal(images.decode(tmp_path / "a.png").rgb, pixels)
    for read in (images.decode, masks.read) if tag > 1 else ():
        with pytest.raises(MiNtfError, match=rf"a.tif: TIFF with Exif orientation {tag} is not read; take"):
            read(tmp_path / "a.tif")


@pytest.mark.parametrize("masks", ["stored", "upright"])
@pytest.mark.parametrize("poses", ["stored", "upright"])
@pytest.mark.parametrize("tags", [(6,), (8,), (5, 7), (6, 3), (8, 1, 2, 4)])
def test_sizes_tell_what_is_turned(tmp_path, tags, poses, masks):
    """Half turns, which no size tells, are as the quarter turns among them."""
    messages = []
    splits = load_dataset(write(tmp_path, tags, poses, masks), messages.append)
    check(splits)
    count = sum(tags[i % len(tags)] > 1 for i in range(forms.VIEWS))
    phrases = {"stored": "as stored, not turned as", "upright": "turned as"}
    for text in (f"poses belong to the photographs {phrases[poses]} their Exif orientation says ({count} photographs, ",
                 f"masks are {phrases[masks]} the Exif orientation of their photographs says ({count} photographs, "):
        assert sum(line.startswith(f"assumed: {text}") for line in messages) == 1


@pytest.mark.parametrize(("tag", "pictures"), [(3, LANDSCAPES), (6, forms.PICTURES)], ids=["half turn", "square"])
def test_masks_of_which_nothing_tells_are_refused(tmp_path, tag, pictures):
    write(tmp_path, (tag,), pictures=pictures)
    with pytest.raises(MiNtfError, match=rf"000.png: its photograph .*000.png has Exif orientation {tag}, and nothing "
                                         "tells whether the mask .* take the tag out with `exiftool -Orientation= "):
        load_dataset(tmp_path, lambda _: None)
    for path in (tmp_path / "masks").iterdir():  # a mask with the same tag lies as its photograph
        tag_of = Image.Exif()
        tag_of[exif.ORIENTATION] = tag
        Image.open(path).copy().save(path, exif=tag_of)
    check(load_dataset(tmp_path, lambda _: None), pictures)


def test_masks_are_not_asked_for_beside_alpha(tmp_path):
    write(tmp_path, (3,))
    for path in sorted((tmp_path / "images").iterdir()):
        with Image.open(path) as image, Image.open(tmp_path / "masks" / path.name) as mask:
            tag_of = image.getexif()
            image.putalpha(mask)
        image.save(path, exif=tag_of)
    check(load_dataset(tmp_path, lambda _: None))


def test_scaled_copies_of_turned_photographs(tmp_path):
    write(tmp_path, (6,), "upright")
    data = json.loads((tmp_path / "transforms.json").read_text())
    for frame in data["frames"]:
        frame.update({key: 4 * frame[key] for key in ("w", "h", "cx", "cy", "fl_x")})
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    messages = []
    check(load_dataset(tmp_path, messages.append))
    assert any(line.startswith("assumed: photographs are copies scaled by 0.25, ") for line in messages)


@pytest.mark.parametrize("sized", [True, False])
@pytest.mark.parametrize("portraits", [(3, 9, 15), tuple(range(7)) + tuple(range(9, 13))])
def test_portraits_among_landscapes(tmp_path, portraits, sized):
    """Turned to lie as the first photograph of the split does. Without sizes the field of view is that of the width."""
    data = json.loads((write(tmp_path, portraits=portraits) / "transforms.json").read_text())
    for frame in data["frames"] if not sized else []:
        frame.pop("h"), frame.pop("cx"), frame.pop("cy")
        frame["camera_angle_x"] = 2 * np.arctan(frame.pop("w") / 2 / frame.pop("fl_x"))
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    messages = []
    check(load_dataset(tmp_path, messages.append))
    kind = "landscapes" if 0 in portraits else "portraits"
    assert any(line.startswith(f"assumed: {kind} are turned to the left with their cameras, to lie as the first "
                               "photograph does (3 photographs, first") for line in messages)


@pytest.mark.parametrize("more", [{"tags": (6,), "poses": "upright"}, {"portraits": (3, 9)}])
def test_inspect_shows_the_photographs_as_they_were_turned(tmp_path, monkeypatch, more):
    monkeypatch.chdir(tmp_path)
    shown_pictures = []
    monkeypatch.setattr("mi_ntf.data.page.Page.pictures", lambda self, pairs, width: shown_pictures.extend(pairs))
    result = inspect(write(tmp_path / "set", **more))
    assert len(result["assumed"]) > 0 and set(result["assumed"]) < set(result["said"])
    for caption, picture in shown_pictures:
        name = caption.split()[1]
        i = int(Path(name).stem)
        inside = LANDSCAPES[i, ..., 3] > 0.99
        shown = images.LINEAR[picture[5::10, 5::10]]  # in the middle of a pixel that was made 10 times as large
        inner = inside[1:-1, 1:-1] & inside[2:, 1:-1] & inside[:-2, 1:-1] & inside[1:-1, 2:] & inside[1:-1, :-2]
        np.testing.assert_allclose(shown[1:-1, 1:-1][inner], LANDSCAPES[i, 1:-1, 1:-1, :3][inner], atol=2 * 2.3 / 255)

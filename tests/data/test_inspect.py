"""`mi-ntf inspect`: its numbers on a set where they are known, its warnings, and the page of every form."""

import dataclasses
import json

import numpy as np
import pytest
from data import forms
from data.test_page import pictures
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import inspect_figures, measures, silhouettes
from mi_ntf.data.capture import camera_to_world
from mi_ntf.data.images import LINEAR
from mi_ntf.data.inspect import inspect, print_table, summary
from mi_ntf.data.page import prose
from mi_ntf.data.schema import Camera, Split, View

AXES = np.concatenate([np.eye(3), -np.eye(3)])
DISTANCE, FOCAL, SIDE, LEVEL, INTENSITY = 5.0, 50.0, 40, 100, 30.0
SEEN = LINEAR[LEVEL]


def six(**changes) -> dict[str, Split]:
    """Return six photographs of a grey square of 20 x 20 pixels in 40 x 40, from the six ends of the axes.

    The first is also the only one of the split for tests. The sphere has radius 2.
    """
    images = np.zeros((6, SIDE, SIDE, 4), np.uint8)
    images[:, 10:30, 10:30] = (LEVEL, LEVEL, LEVEL, 255)
    c2w = np.stack([camera_to_world(DISTANCE * axis, np.zeros(3)) for axis in AXES])
    train = Split(images, c2w, np.full((6, 2), FOCAL), np.full((6, 2), SIDE / 2), c2w[:, :3, 3].astype(np.float32),
                  np.full((6, 3), INTENSITY, np.float32), np.zeros(3), 2.0, tuple(f"{i}.png" for i in range(6)),
                  calibrated=False)
    train = dataclasses.replace(train, **changes)
    return {"train": train, "test": dataclasses.replace(
        train, images=train.images[:1], c2w=train.c2w[:1], focal=train.focal[:1], principal=train.principal[:1],
        light_pos=train.light_pos[:1], light_intensity=train.light_intensity[:1], names=("test.png",))}


def of(splits: dict[str, Split]) -> tuple[dict, list[measures.Photograph], str]:
    rows = measures.measure(splits)
    numbers = measures.numbers(splits, rows)
    return numbers, rows, "\n".join(measures.warnings(numbers, rows))


def changed(**changes) -> tuple[dict, list[measures.Photograph], str]:
    return of(six(**changes))


def test_numbers_of_an_even_set():
    numbers, rows, warned = changed()
    assert [row.name for row in rows] == [*(f"{i}.png" for i in range(6)), "test.png"]
    assert numbers["photographs"] == {"train": 6, "test": 1} and (numbers["width"], numbers["height"]) == (SIDE, SIDE)
    assert numbers["coverage"] == {"least": 0.25, "median": 0.25, "most": 0.25} and numbers["unknown"] == 0
    assert numbers["brightness"]["mean"] == pytest.approx(3 * [np.pi * SEEN * DISTANCE**2 / INTENSITY], rel=1e-6)
    assert numbers["brightness"]["ratio"] == pytest.approx([1, 1, 1])
    assert numbers["saturated"] == numbers["black"] == 0
    assert numbers["distance"]["median"] == pytest.approx(DISTANCE / 2)
    assert numbers["pixel"]["median"] == pytest.approx(DISTANCE / FOCAL / 2)
    assert numbers["flash_degrees"]["most"] == pytest.approx(0, abs=1e-3)
    assert numbers["gap"]["degrees"] == pytest.approx(np.degrees(np.arccos(1 / np.sqrt(3))), abs=0.05)  # corner
    assert numbers["uncovered"]["most"] == 0
    assert warned.splitlines() == [
        "6 photographs for training are few: 60 or more from all sides make a field without holes.",
        "The object's sphere is 40 pixels wide, which shows little detail; use larger photographs."]
    json.dumps(numbers)


def test_one_photograph_brighter_and_bluer():
    images = six()["train"].images.copy()
    images[2, 10:30, 10:30, :3] = (150, 150, 200)
    numbers, _, warned = changed(images=images)
    assert numbers["brightness"]["ratio"] == pytest.approx(
        [LINEAR[150] / SEEN, LINEAR[150] / SEEN, LINEAR[200] / SEEN], rel=1e-5)
    assert numbers["white_balance"]["red_over_green"] == pytest.approx(1)
    assert numbers["white_balance"]["blue_over_green"] == pytest.approx(LINEAR[200] / LINEAR[150], rel=1e-5)
    assert "brightness in blue differs 4.53-fold between 0.png and 2.png" in warned
    assert "red or blue over green, differs 1.89-fold" in warned
    assert "differs" not in changed(images=images, calibrated=True)[2]  # the set says how bright each flash was


def test_brightness_allows_for_distance_and_intensity():
    """Twice as far is a quarter as bright, and no fault."""
    train = six()["train"]
    images, c2w, intensity = train.images.copy(), train.c2w.copy(), train.light_intensity.copy()
    images = np.where(np.arange(4) < 3, LINEAR[images], images / 255).astype(np.float32)
    c2w[1, :3, 3] *= 2
    images[1, ..., :3] /= 4
    intensity[2] *= 3
    images[2, ..., :3] *= 3
    numbers, rows, _ = changed(images=images, c2w=c2w, light_pos=c2w[:, :3, 3], light_intensity=intensity)
    assert numbers["brightness"]["ratio"] == pytest.approx([1, 1, 1], rel=1e-6)
    assert rows[1].mean == pytest.approx(rows[0].mean / 4)
    assert numbers["distance"] == pytest.approx({"least": 2.5, "median": 2.5, "most": 5})
    assert numbers["saturated"] is None  # a linear file's white is not known


def test_saturated_and_black_pixels():
    images = six()["train"].images.copy()
    images[3, 10:15, 10:30, 1] = 250  # a quarter of one of seven
    images[4, 10:30, 10:20, :3] = 4
    images[:, 0, 0, :3] = 255  # outside of the mask
    numbers, rows, warned = changed(images=images)
    assert rows[3].saturated == 0.25 and numbers["saturated"] == pytest.approx(0.25 / 7)
    assert rows[4].black == 0.5 and numbers["black"] == pytest.approx(0.5 / 7)
    assert "3.57 % of the object's pixels are saturated" in warned and "nearly black" not in warned
    images[:, 10:30, 10:20, :3] = 4
    assert "50 % of the object's pixels are nearly black" in changed(images=images)[2]
    linear = np.where(np.arange(4) < 3, LINEAR[images], images / 255).astype(np.float16)
    linear[3, 10, 29, 0] = 1  # clipped at 1, as a linear TIFF
    assert changed(images=linear)[1][3].saturated == pytest.approx(0.125)  # of levels 250 those that are not black


def test_the_direction_nobody_photographed():
    train = six()["train"]
    five = slice(0, 5)
    few = dataclasses.replace(train, images=train.images[five], c2w=train.c2w[five], focal=train.focal[five],
                              principal=train.principal[five], light_pos=train.light_pos[five],
                              light_intensity=train.light_intensity[five], names=train.names[five])
    numbers, _, warned = of({"train": few, "test": six()["test"]})
    assert numbers["gap"]["degrees"] == pytest.approx(90, abs=0.1)
    np.testing.assert_allclose(numbers["gap"]["direction"], [0, 0, -1], atol=0.002)
    assert "No camera for training is within 90° of the direction" in warned


def test_flash_beside_the_lens():
    train = six()["train"]
    angle = np.radians(18)
    beside = train.light_pos * np.cos(angle) + DISTANCE * np.sin(angle) * np.roll(AXES, 1, axis=1)
    numbers, _, _ = changed(light_pos=beside.astype(np.float32))
    assert numbers["flash_degrees"]["least"] == pytest.approx(18, abs=1e-3)
    assert numbers["flash_degrees"]["most"] == pytest.approx(18, abs=1e-3)


def test_a_flash_whose_place_is_not_known():
    """The data set's light is the lens then, and its angle there tells nothing."""
    numbers, _, _ = changed(located=False)
    assert numbers["flash_degrees"] is None
    assert dict(summary(numbers))["flash beside the lens"] == "not known; taken to be at the lens"


def test_small_objects_and_inverted_masks():
    images = six()["train"].images.copy()
    images[:, :, :18, 3] = 0
    images[:, :, 22:, 3] = 0
    assert "covers 5 % of a photograph" in changed(images=images)[2]
    images[..., 3] = 255
    assert "masks cover 100 % of a photograph" in changed(images=images)[2]


def test_a_black_background_knows_less():
    images = six()["train"].images.copy()
    images[:, 5:35, 5:35, 3] = 128
    images[:, 10:30, 10:30, 3] = 255
    numbers, _, _ = changed(images=images, masked=False)
    assert numbers["coverage"]["most"] == 0.25 and numbers["unknown"] == pytest.approx((900 - 400) / 1600)
    assert numbers["brightness"]["mean"] == pytest.approx(3 * [np.pi * SEEN * DISTANCE**2 / INTENSITY], rel=1e-6)


def test_masks_that_disagree():
    """Make one mask twice as wide as the others, whose hull is 1 to 1.2 half a side wide at depths of 4 to 6."""
    images = six()["train"].images.copy()
    images[4, :, :, 3] = 255
    _, rows, warned = changed(images=images)
    assert 1 - (32 / 40) ** 2 < rows[4].uncovered < 1 - (20 / 40) ** 2
    assert max(row.uncovered for i, row in enumerate(rows) if i != 4) == 0
    assert "% of the silhouette in 4.png lies outside the hull of the other photographs" in warned


def test_poses_that_disagree():
    c2w = six()["train"].c2w.copy()
    c2w[:, :3, 3] += np.roll(AXES, 1, axis=1)  # each half a square aside
    numbers, _, warned = changed(c2w=c2w)
    assert numbers["uncovered"]["median"] > 0.1 and "the poses are inexact, or the masks unlike" in warned


def test_photographs_to_compare_are_evenly_chosen():
    assert silhouettes.chosen(3).tolist() == [0, 1, 2]
    many = silhouettes.chosen(500)
    assert len(many) == silhouettes.VIEWS and many[0] == 0 and many[-1] == 499 and np.ptp(np.diff(many)) <= 1


def test_a_thumbnail_shows_mask_and_background(tmp_path):
    split, path = six()["train"], tmp_path / "whole.png"
    whole = np.full((SIDE, SIDE, 3), 200, np.uint8)
    whole[10:30, 10:30] = LEVEL
    Image.fromarray(whole).save(path)
    view = View("", path, "whole.png", [], split.c2w[0], Camera(FOCAL, FOCAL, SIDE / 2, SIDE / 2))
    shown = inspect_figures.thumbnail(split, 0, view, 1.0)
    assert shown.shape == (240, 240, 3)  # each pixel six times
    np.testing.assert_array_equal(shown[60, 60:180], np.broadcast_to(inspect_figures.OUTLINE, (120, 3)))
    np.testing.assert_array_equal(shown[61, 61], 3 * [LEVEL])
    assert (shown[30, 30] > 90).all() and (shown[30, 30] < 140).all()  # 0.3 of it in linear light
    linear = dataclasses.replace(view, image=tmp_path / "whole.exr")  # not 8-bit: what is stored, black without
    shown = inspect_figures.thumbnail(split, 0, linear, 1.0)
    assert (shown[30, 30] < 60).all() and (shown[90, 90] == LEVEL).all()


def test_a_thumbnail_of_a_bent_lens(tmp_path):
    """The pinhole's pixel at x shows what the lens put at 8.5 (1 + k r²), r = 8.5 / 50, from the middle."""
    split, path = six()["train"], tmp_path / "bent.png"
    Image.fromarray(np.broadcast_to(5 * np.arange(SIDE)[:, None], (SIDE, SIDE, 3)).astype(np.uint8)).save(path)
    bent = Camera(FOCAL, FOCAL, SIDE / 2, SIDE / 2, (4.0, 0.0, 0.0, 0.0))
    shown = inspect_figures.thumbnail(split, 0, View("", path, "bent.png", [], split.c2w[0], bent), 1.0)
    there = SIDE / 2 + 8.5 * (1 + 4 * (8.5 / FOCAL) ** 2)
    assert shown[120, 168] == pytest.approx(5 * (there - 0.5), abs=2)  # 8-bit, resampled: a level or two


def test_a_thumbnail_before_a_black_background():
    images = six()["train"].images.copy()
    images[..., :3] = 40
    images[:, 5:35, 5:35, 3], images[:, 10:30, 10:30, 3] = 128, 255
    shown = inspect_figures.thumbnail(six(images=images, masked=False)["train"], 0, None, 1.0)[::6, ::6].astype(int)
    assert shown[20, 20].tolist() == [40, 40, 40] and shown[10, 15].tolist() == list(inspect_figures.OUTLINE)
    assert shown[7, 20][0] > shown[7, 20][2] + 30  # not known: orange
    assert shown[2, 20][2] > shown[2, 20][0] + 10  # empty: bluish


FORMS = (forms.capture, forms.blender, forms.nrhints, forms.colmap, forms.nerfstudio, forms.llff)


@pytest.mark.parametrize("form", FORMS)
def test_every_form(tmp_path, monkeypatch, form, capsys):
    monkeypatch.chdir(tmp_path)
    numbers = inspect(form(tmp_path / "set"))
    page = (tmp_path / "set-inspect.html").read_text(encoding="utf-8")
    assert numbers["page"] == "set-inspect.html" and capsys.readouterr().out == ""  # --json prints JSON alone
    assert sum(numbers["photographs"].values()) == forms.VIEWS == len(numbers["views"])
    assert numbers["distance"]["median"] == pytest.approx(3.2 / numbers["sphere"]["radius"], rel=0.1)
    assert numbers["uncovered"]["most"] < 0.02
    assert len(pictures(page)) == 2 + 12 + 1
    for text in [*numbers["said"], *numbers["warnings"]]:
        assert prose(text) in page
    print_table(json.loads(json.dumps(numbers)))
    printed = capsys.readouterr().out
    assert "warning: 13 photographs" in printed or "warning: 14 photographs" in printed
    assert printed.splitlines()[-3:] == [
        "page: set-inspect.html", f"verdict: {len(numbers['warnings'])} warnings: mend what is named there, or the "
        "field will show it", f"next: {numbers['next']}"]


@pytest.mark.parametrize(("form", "options", "more"), [
    (forms.capture, {}, ""),
    (forms.blender, {}, "--flash-offset estimate "),
    (forms.colmap, {"flash_offset": (-1, 1.5, 0), "size": 16}, "--size 16 --flash-offset=-1,1.5,0 "),
    (forms.colmap, {"flash_offset": "estimate"}, "--flash-offset estimate "),
    (forms.colmap, {"masks": "masks"}, "--masks '{folder}/masks' --flash-offset estimate "),
], ids=["capture", "place of the flash not known", "options", "estimate", "masks"])
def test_the_next_command_has_the_same_options(tmp_path, form, options, more):
    folder = form(tmp_path / "a set")
    if "masks" in options:
        options = {"masks": folder / "masks"}
    numbers = inspect(folder, tmp_path / "page.html", **options)
    assert numbers["next"] == (f"mi-ntf train '{folder}' -o 'a set.safetensors' " + more.format(folder=folder)
                               + "--minutes 10")


def test_the_next_command_scales_large_photographs_down(tmp_path, monkeypatch):
    monkeypatch.setattr("mi_ntf.data.inspect.LONGEST", forms.SIZE - 1)
    numbers = inspect(forms.capture(tmp_path / "set"), tmp_path / "page.html")
    assert f" --size {forms.SIZE - 1} " in numbers["next"]


def test_the_place_of_the_flash_is_estimated_by_training_and_only_if_it_is_not_known(tmp_path):
    numbers = inspect(forms.colmap(tmp_path / "set"), tmp_path / "page.html", flash_offset="estimate")
    assert dict(summary(numbers))["flash beside the lens"] == (
        "not known; training will estimate it, since that takes the object's shape")
    with pytest.raises(MiNtfError, match=r"--flash-offset estimate: .*known says where its lights are; leave the"):
        inspect(forms.capture(tmp_path / "known"), tmp_path / "page.html", flash_offset="estimate")


def test_a_page_that_cannot_be_written_is_told_before_the_work(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(MiNtfError, match=r"cannot make the folder .*file "):
        inspect(tmp_path / "no set", tmp_path / "file" / "page.html")
    with pytest.raises(MiNtfError, match=r"no set does not exist"):
        inspect(tmp_path / "no set", tmp_path / "page.html")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]

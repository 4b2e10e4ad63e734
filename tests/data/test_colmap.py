"""COLMAP models as other programs and other machines leave them."""

import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from data import forms
from PIL import Image

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import images
from mi_ntf.data.readers import load_dataset


def load(folder: Path):
    messages = []
    return load_dataset(folder, messages.append), "\n".join(messages)


def change(name: str, function):
    """Return an edit of one of the model's text files, as bytes."""
    def edit(folder: Path) -> None:
        path = folder / "sparse/0" / name
        path.write_bytes(function(path.read_bytes()))
    return edit


def lines(after_image: str):
    """Every image's line followed by `after_image`."""
    return change("images.txt", lambda raw: b"# comment\n" + raw.replace(b"\n\n", b"\n" + after_image.encode()))


def renamed(name: str, encoding: str = "utf-8"):
    def edit(folder: Path) -> None:
        change("images.txt", lambda raw: raw.replace(b"003.png", name.encode(encoding)))(folder)
        for kind in ("images", "masks"):
            (folder / kind / "003.png").rename(folder / kind / name)
    return edit


def encoded(folder: Path, encoding: str) -> None:
    for path in (folder / "sparse/0").iterdir():
        path.write_bytes(path.read_text().encode(encoding))


def in_a_folder(folder: Path) -> None:
    """Move a photograph into a folder, and name it as on Windows."""
    for kind in ("images", "masks"):
        (folder / kind / "ring").mkdir()
        (folder / kind / "003.png").rename(folder / kind / "ring" / "003.png")
    change("images.txt", lambda raw: raw.replace(b"003.png", b"ring\\003.png"))(folder)


def with_absolute_names(folder: Path) -> None:
    """Name the photographs by their places on another machine."""
    change("images.txt", lambda raw: re.sub(rb"(\d+.png)", rb"/home/somebody/set/images/\1", raw))(folder)


def with_the_folder(folder: Path) -> None:
    """Name the photographs from the folder above `images`."""
    change("images.txt", lambda raw: re.sub(rb"(\d+.png)", rb"images/\1", raw))(folder)


def with_other_extensions(folder: Path) -> None:
    """Rename files: the model says .JPG, masks are called after that, and photographs are .PNG."""
    for path in (folder / "masks").iterdir():
        path.rename(path.with_suffix(".JPG.png"))
    for path in (folder / "images").iterdir():
        path.rename(path.with_suffix(".PNG"))
    change("images.txt", lambda raw: raw.replace(b".png", b".JPG"))(folder)


@pytest.mark.parametrize("edit", [
    lines(""), lines("\n\n"), lines("1 2 -1 3.5 4e2 7\n"), lines("1 2 -1 " * 40 + "\n"),
    lambda f: change("images.txt", lambda raw: raw.replace(b"\n\n", b"\n1 2 3\n", 5))(f),
    renamed("a  photo.png"), renamed("a photo.png"), renamed("Größe.png"), renamed("Größe.png", "latin-1"),
    lambda f: encoded(f, "utf-8-sig"), lambda f: encoded(f, "utf-16"), lambda f: encoded(f, "utf-16-le"),
    change("images.txt", lambda raw: raw.replace(b"\n", b"\r\n")),
    lambda f: (f / "sparse/0/points3D.txt").unlink(),
    with_other_extensions, in_a_folder, with_absolute_names, with_the_folder,
], ids=["no lines of points", "empty lines", "points", "many points", "both", "two spaces", "a space", "UTF-8",
        "Latin-1", "byte-order mark", "UTF-16", "UTF-16 without a mark", "Windows line ends", "no points3D",
        "another extension", "Windows separators", "absolute names", "names with images/"])
def test_every_photograph_is_read(tmp_path, edit):
    edit(forms.colmap(tmp_path))
    splits, messages = load(tmp_path)
    poses, pictures = (np.concatenate([getattr(split, key) for split in splits.values()]) for key in ("c2w", "images"))
    apart = np.abs(poses[:, None] - forms.C2W).max((2, 3))
    order = apart.argmin(1)
    assert sorted(order) == list(range(forms.VIEWS)) and apart.min(1).max() < 1e-6 and "have no pose" not in messages
    # the file's 8 bits, and those over black: `test_readers.check_8_bit_pixels`
    np.testing.assert_allclose(images.linear(pictures), forms.PICTURES[order], atol=(2 * 2.3 + 1) * 0.5 / 255)


@pytest.mark.parametrize(("edit", "text"), [
    (with_absolute_names, "assumed: 16 photographs are not at the places that .*sparse/0 names .first /home/somebody/"),
    (lambda f: (f / "sparse/0/points3D.txt").unlink(), "assumed: .*sparse/0 has no points3D, so the object's place"),
    (renamed("Größe.png", "latin-1"), "assumed: .*images.txt: is no UTF-8 and is read as Latin-1"),
    (lambda f: [Image.open(p).save(p.with_suffix(".tif")) or p.unlink() for p in (f / "images").iterdir()],
     r"assumed: a photograph that the data set calls .png is the .tif of the same name \(16 photographs, first"),
])
def test_what_is_assumed_is_said(tmp_path, edit, text):
    edit(forms.colmap(tmp_path))
    assert len([line for line in load(tmp_path)[1].split("\n") if re.match(text, line)]) == 1


def test_two_files_that_may_be_meant(tmp_path):
    forms.colmap(tmp_path)
    for suffix in (".jpg", ".tif"):
        Image.open(tmp_path / "images/003.png").save(tmp_path / f"images/003{suffix}")
    (tmp_path / "images/003.png").unlink()
    with pytest.raises(MiNtfError, match=r"003.png does not exist, and 003.jpg and 003.tif lie there; leave the one"):
        load(tmp_path)


def test_latin_1_in_binary_models(tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="COLMAP itself writes the binary files")
    renamed("Größe.png")(forms.colmap(tmp_path))
    model = tmp_path / "sparse/0"
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    (model / "images.bin").write_bytes((model / "images.bin").read_bytes().replace(
        "Größe.png".encode(), "Größe.png".encode("latin-1")))
    assert "images/Größe.png" in load(tmp_path)[0]["train"].names


# --- several models ---------------------------------------------------------------------------------------------------


def small(folder: Path, place: str, count: int) -> Path:
    """Copy the model to `place` with the first `count` images."""
    shutil.copytree(folder / "sparse/0", folder / place)
    path = folder / place / "images.txt"
    path.write_text("".join(path.read_text().splitlines(keepends=True)[:2 * count]))
    return folder


@pytest.mark.parametrize(("places", "chosen"), [
    ({"sparse/1": 5}, "sparse/0"), ({"sparse/0": 5, "sparse/1": 16}, "sparse/1"),
    ({"sparse/0": 5, "colmap/sparse/0": 16}, "colmap/sparse/0"), ({"sparse/0": 3, "sparse/2": 4, "sparse/10": 16},
                                                                 "sparse/10")])
def test_the_model_with_most_photographs(tmp_path, places, chosen):
    forms.colmap(tmp_path)
    whole = shutil.copytree(tmp_path / "sparse", tmp_path / "whole" / "sparse")
    for place, count in places.items():
        shutil.rmtree(tmp_path / place, ignore_errors=True)
        small(tmp_path / "whole", "part", count)
        shutil.copytree(tmp_path / "whole/part", tmp_path / place)
        shutil.rmtree(tmp_path / "whole/part")
    assert whole.is_dir()
    splits, messages = load(tmp_path)
    assert sum(len(split.images) for split in splits.values()) == 16
    sizes = ", ".join(f"{place} with {n}" for place, n in ({"sparse/0": 16} | places).items())
    assert (f"assumed: of {len({'sparse/0': 16} | places)} COLMAP models the one with most photographs is read, "
            f"{tmp_path / chosen} ({sizes}); name a model's own folder to read another") in messages.split("\n")


def test_a_model_is_read_by_its_own_folder(tmp_path):
    """Two and three folders below the one that holds `images`."""
    small(forms.colmap(tmp_path), "sparse/1", 15)
    shutil.copytree(tmp_path / "sparse/1", tmp_path / "colmap/sparse/0")
    for place in ("sparse/1", "colmap/sparse/0"):
        splits, messages = load(tmp_path / place)
        assert sum(len(split.images) for split in splits.values()) == 15
        assert "1 of 16 photographs in" in messages and "COLMAP models" not in messages

"""Files that `mi-ntf render` writes: EXR as the program `mitsuba`, and PNG."""

import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

from mi_ntf import cli, launcher

ROOT = Path(__file__).parents[1]
SCENE = """<scene version="3.0.0">
    <default name="format" value="openexr"/>
    <integrator type="direct"/>
    <emitter type="constant"><rgb name="radiance" value="0.4, 0.1, 0.9"/></emitter>
    <sensor type="perspective">
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
        <film type="hdrfilm">
            <integer name="width" value="6"/><integer name="height" value="4"/>
            <string name="file_format" value="$format"/><string name="pixel_format" value="rgba"/>
            <rfilter type="box"/>
        </film>
    </sensor>
</scene>"""


@pytest.fixture
def scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A scene of one colour in the current folder."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


def render(*words: str) -> int:
    return cli.main(["render", "-m", "llvm_ad_rgb", *words, "scene.xml"])


@pytest.mark.parametrize(("exposure", "levels"), [((), (170, 89, 243)), (("--exposure", "-1"), (124, 63, 179))])
def test_a_png_has_srgb_and_the_exposure(scene, exposure, levels):
    """The levels are the sRGB curve of 0.4, 0.1 and 0.9, and of half of them."""
    assert render("-o", "new/folder/picture.png", *exposure) == 0
    pixels = np.array(mi.Bitmap(str(scene.parent / "new/folder/picture.png")))
    assert pixels.shape == (4, 6, 3) and pixels.dtype == np.uint8
    assert (pixels == levels).all()


def test_other_files_have_the_suffix_of_the_film(scene, capsys):
    assert render() == 0 and (scene.parent / "scene.exr").is_file()
    assert render("-o", "named") == 0 and (scene.parent / "named.exr").is_file()
    assert render("-D", "format=pfm", "-o", "a.pfm") == 0 and (scene.parent / "a.pfm").stat().st_size > 100
    files = set(scene.parent.iterdir())
    capsys.readouterr()
    assert render("-o", "a.jpg") == 1
    assert "a.jpg: the name ends in '.jpg', expected .exr or .png" in capsys.readouterr().err
    assert render("-o", "scene.xml/a.exr") == 1
    assert "cannot make the folder scene.xml" in capsys.readouterr().err
    assert render("--exposure", "1") == 2
    assert "--exposure is for PNG images" in capsys.readouterr().err
    assert set(scene.parent.iterdir()) == files


@pytest.mark.skipif(not (ROOT / ".git").exists(), reason="this is no checkout")
def test_git_ignores_pictures_beside_the_shipped_scenes():
    scenes = [*ROOT.glob("scenes/*/scene.xml"), *ROOT.glob("scenes/*/mesh.xml"), *ROOT.glob("docs/gallery/*.xml")]
    pictures = [str(path.with_suffix(".exr").relative_to(ROOT)) for path in scenes]
    done = subprocess.run(["git", "check-ignore", *pictures], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.stdout.splitlines() == pictures and pictures


def test_a_picture_that_cannot_be_written_leaves_the_old_one(scene, monkeypatch, capsys):
    assert render() == 0
    image = scene.with_suffix(".exr")
    before = image.read_bytes()

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(launcher, "_annotate", fail)
    assert render() == 1
    assert image.read_bytes() == before and "No space left" in capsys.readouterr().err
    assert {path.name for path in image.parent.glob(f"{image.name}*")} == {image.name}


def test_one_image_of_several_scenes_is_refused(scene, capsys):
    assert render("-o", "both.exr", "scene.xml") == 1
    assert "is one image, but 2 scenes are given" in capsys.readouterr().err

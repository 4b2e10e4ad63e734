"""`make demo`: process handling, table and picture by themselves, and the whole of it."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from skimage import io

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import demo

FAKE = """
import sys, numpy as np, OpenEXR
words = sys.argv[1:]
assert words[:2] == ["-m", "llvm_ad_rgb"] and words[-1].endswith("scene.xml"), words
defined = dict(words[i + 1].split("=") for i, w in enumerate(words) if w == "-D")
assert defined["res"] == "64"
if defined["visibility"] == "none":
    sys.exit("no such visibility")
pixels = np.full((4, 6), float(defined["spp"]), np.float32)
with OpenEXR.File({"type": OpenEXR.scanlineimage}, {c: pixels for c in "RGBA"}) as file:
    file.write(words[words.index("-o") + 1])
"""


@pytest.fixture
def fake(tmp_path):
    (tmp_path / "fake.py").write_text(FAKE)
    return [sys.executable, str(tmp_path / "fake.py")]


def test_render_passes_parameters_and_times_the_process(fake, tmp_path):
    shot = demo.render(fake, tmp_path / "scene.xml", "env", "raymarch", 3, 64, tmp_path / "o.exr")
    assert (shot.light, shot.visibility, shot.image.shape) == ("env", "raymarch", (4, 6, 4))
    assert (shot.image == 3).all() and shot.seconds > 0


def test_a_failed_render_shows_its_output(fake, tmp_path):
    with pytest.raises(MiNtfError, match=r"(?s)visibility=none.*exit code 1.*no such visibility.*mi-ntf doctor"):
        demo.render(fake, tmp_path / "scene.xml", "env", "none", 3, 64, tmp_path / "o.exr")


def _shots():
    x = np.linspace(0, 1, 64)
    reference = np.ones((64, 64, 4)) * np.stack([x, x**2, 1 - x, 0 * x + 1], -1)
    references = {"point": reference, "env": reference[:, ::-1]}
    return [demo.Shot(light, v, 2.5, references[light] * [f, f, f, 1]) for light in references
            for v, f in zip(demo.VISIBILITIES, (1.02, 1.1, 0.9), strict=True)], references


def test_report_measures_against_reference_and_raymarch(tmp_path):
    shots, references = _shots()
    text = demo.report(tmp_path, shots, references, "a note")
    measured = json.loads((tmp_path / "metrics.json").read_text())
    assert [m["relative_rmse"] for m in measured[:3]] == pytest.approx([0.02, 0.1, 0.1])
    assert [m["relative_rmse_to_raymarch"] for m in measured[3:]] == pytest.approx([0, 0.08 / 1.02, 0.12 / 1.02])
    assert text == (tmp_path / "table.md").read_text() and text.count("\n| ") == 7
    assert "| environment map | `transmittance_map` | 2.5 |" in text and "a note" in text
    image = io.imread(tmp_path / "comparison.png")
    assert image.shape[0] > 1000 and image[..., :3].std() > 20
    assert sorted(p.name for p in tmp_path.iterdir()) == ["comparison.png", "metrics.json", "table.md"]


def test_report_refuses_a_reference_of_another_size(tmp_path):
    shots, references = _shots()
    references["env"] = references["env"][:32]
    with pytest.raises(MiNtfError, match=r"env/raymarch has shape \(64, 64, 4\), its reference \(32, 64, 4\)"):
        demo.report(tmp_path, shots, references, "")


def test_program_falls_back_where_the_bridge_is_missing(monkeypatch):
    from mi_ntf import doctor

    monkeypatch.setattr(doctor, "check_bridge", lambda: doctor.Check("bridge", False, False, "not built here"))
    command, note = demo.program()
    assert command == [sys.executable, "-m", "mi_ntf", "render"] and "not built here" in note
    monkeypatch.setattr(doctor, "check_bridge", lambda: doctor.Check("bridge", True, False, "built"))
    command, note = demo.program()
    assert command[0].endswith("mitsuba") and "stock" in note


def test_command_line_names_a_missing_scene():
    done = subprocess.run([sys.executable, "-m", "mi_ntf.evaluate.demo", "--scene", "nowhere"], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 1 and "nowhere/scene.xml does not exist" in done.stderr.replace("\n", "")


def test_measuring_never_imports_torch():
    code = ("import sys, numpy as np; import mi_ntf.evaluate.demo; from mi_ntf.evaluate.compare import compare_arrays;"
            "a = np.random.default_rng(0).uniform(size=(16, 16, 3)); compare_arrays(a, a);"
            "print('torch' in sys.modules)")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


ROOT = Path(__file__).parents[2]


def check_demo(folder: Path, ssim: float, rmse: float, to_march: float) -> None:
    """Six renders, each near the path-traced meshes and nearer to `raymarch`; table and picture beside them."""
    measured = json.loads((folder / "metrics.json").read_text())
    assert [(m["light"], m["visibility"]) for m in measured] == [(a, b) for a in demo.LIGHTS for b in demo.VISIBILITIES]
    for m in measured:
        assert m["ssim"] > ssim and m["relative_rmse"] < rmse, m
        assert (m["relative_rmse_to_raymarch"] == 0) == (m["visibility"] == "raymarch")
        assert m["relative_rmse_to_raymarch"] < to_march
    assert (folder / "table.md").read_text().count("\n| ") == 7
    assert io.imread(folder / "comparison.png")[..., :3].std() > 20
    assert len(list(folder.glob("*.exr"))) == 6 and not list(folder.glob("*.part*"))


def test_the_demo_on_few_pixels(tmp_path):
    """The command of `make demo` itself, by the stock program, on 32² pixels."""
    command = [sys.executable, "-m", "mi_ntf.evaluate.demo", "--size", "32", "--spp", "16", "--environment-spp", "4",
               "--out", str(tmp_path)]  # fmt: skip
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    check_demo(tmp_path, 0.8, 0.3, 0.15)


@pytest.mark.slow
def test_make_demo():
    """All of it, as a user types it: the figures that README gives."""
    done = subprocess.run(["make", "demo"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=3600)
    assert done.returncode == 0, done.stdout + done.stderr
    check_demo(ROOT / "out" / "demo", 0.9, 0.25, 0.07)


@pytest.mark.parametrize("size", [8, 100, 512])
def test_a_size_that_divides_nothing_is_refused(size, tmp_path):
    with pytest.raises(MiNtfError, match=f"size is {size}, expected a divisor of the reference's 256 pixels"):
        demo.demo(out=tmp_path, size=size)

"""The parts of `make demo` that need no renderer: process handling, table, picture."""

import json
import subprocess
import sys

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
    shot = demo.render(fake, tmp_path / "scene.xml", "env", "raymarch", 3, tmp_path / "o.exr")
    assert (shot.light, shot.visibility, shot.image.shape) == ("env", "raymarch", (4, 6, 4))
    assert (shot.image == 3).all() and shot.seconds > 0


def test_a_failed_render_shows_its_output(fake, tmp_path):
    with pytest.raises(MiNtfError, match=r"(?s)visibility=none.*exit code 1.*no such visibility.*mi-ntf doctor"):
        demo.render(fake, tmp_path / "scene.xml", "env", "none", 3, tmp_path / "o.exr")


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

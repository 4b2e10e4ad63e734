"""`make demo`: process handling, table and picture by themselves, and the whole of it."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from skimage import io

from benchmarks import demo
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate.curves import COLOURS

FAKE = """
import os, sys, numpy as np, OpenEXR
words = sys.argv[1:]
assert os.environ["MI_NTF_CACHE"] == "off"
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


def test_render_passes_parameters_and_times_the_process(fake, tmp_path, monkeypatch):
    monkeypatch.setenv("MI_NTF_CACHE", "on")  # of the user: renders have theirs off
    shot = demo.render(fake, tmp_path / "scene.xml", "env", "raymarch", 3, 64, tmp_path / "o.exr")
    assert (shot.light, shot.visibility, shot.image.shape) == ("env", "raymarch", (4, 6, 4))
    assert (shot.image == 3).all() and [s > 0 for s in shot.seconds] == [True]


def test_a_failed_render_shows_its_output(fake, tmp_path):
    with pytest.raises(MiNtfError, match=r"(?s)visibility=none.*exit code 1.*no such visibility.*mi-ntf doctor"):
        demo.render(fake, tmp_path / "scene.xml", "env", "none", 3, 64, tmp_path / "o.exr")


CACHED = """
import sys, numpy as np, OpenEXR
from types import SimpleNamespace
from mi_ntf.render.maps import map_cache

found = []
def make(values=None):
    found.append("made" if values is None else "read")
    return SimpleNamespace(values=np.arange(6, dtype=np.float32))

map_cache.cached("0" * 64, make, 6, 0)
pixels = np.full((1, 1), found == ["made"], np.float32)
with OpenEXR.File({"type": OpenEXR.scanlineimage}, {c: pixels for c in "RGBA"}) as file:
    file.write(sys.argv[sys.argv.index("-o") + 1])
print(found[0])
"""


def test_a_full_cache_of_maps_makes_no_difference(tmp_path, monkeypatch):
    """The demo's renders make anew what they could read from the user's cache."""
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    program = [sys.executable, "-c", CACHED]
    alone = [subprocess.run([*program, "-o", str(tmp_path / "o.exr")], capture_output=True, text=True, check=True)
             for _ in range(2)]
    assert [done.stdout for done in alone] == ["made\n", "read\n"]
    shot = demo.render(program, tmp_path / "scene.xml", "env", "transmittance_map", 1, 64, tmp_path / "o.exr")
    assert (shot.image == 1).all()


def _shots():
    x = np.linspace(0, 1, 64)
    reference = np.ones((64, 64, 4)) * np.stack([x, x**2, 1 - x, 0 * x + 1], -1)
    references = {"point": reference, "env": reference[:, ::-1]}
    return [demo.Shot(light, v, [2.0, 2.5, 3.0], references[light] * [f, f, f, 1]) for light in references
            for v, f in zip(demo.VISIBILITIES, (1.02, 1.1, 0.9), strict=True)], references


def test_report_measures_against_reference_and_raymarch(tmp_path):
    shots, references = _shots()
    text, figures = demo.report(tmp_path, shots, references, "a note")
    measured = json.loads((tmp_path / "metrics.json").read_text())
    assert measured == figures
    assert [m["relative_rmse"] for m in measured[:3]] == pytest.approx([0.02, 0.1, 0.1])
    assert [m["relative_rmse_to_raymarch"] for m in measured[3:]] == pytest.approx([0, 0.08 / 1.02, 0.12 / 1.02])
    assert text == (tmp_path / "table.md").read_text() and text.count("\n| ") == 7
    assert "| environment map | `transmittance_map` | 2.50 (2.00 to 3.00) |" in text and "a note" in text
    image = io.imread(tmp_path / "comparison.png")
    assert image.shape[0] > 1000 and image[..., :3].std() > 20
    assert sorted(p.name for p in tmp_path.iterdir()) == ["comparison.png", "metrics.json", "table.md"]


def test_report_refuses_a_reference_of_another_size(tmp_path):
    shots, references = _shots()
    references["env"] = references["env"][:32]
    with pytest.raises(MiNtfError, match=r"env/raymarch has shape \(64, 64, 4\), its reference \(32, 64, 4\)"):
        demo.report(tmp_path, shots, references, "")


def _found(**curves):
    """A study's result: the methods and their points (seconds, error)."""
    rows = [{"method": method, "title": method.replace("_", " "), "finer": False, "reason": "",
             "points": [{"seconds": x, "error": y, "error_uncertainty": y / 20, "front": method != "volpath"}
                        for x, y in points]} for method, points in curves.items()]
    return {"ways": rows, "size": [64, 64], "machine": {"spread": 0.2, "probe_seconds": [1, 2]}}


def test_the_picture_gains_the_curves(tmp_path):
    """Below what it showed before: one curve a method, in the method's colour, and its name beside."""
    from matplotlib.colors import to_hex
    from matplotlib.figure import Figure

    shots, references = _shots()
    _, measured = demo.report(tmp_path, shots, references, "")
    before = io.imread(tmp_path / "comparison.png")
    study = _found(transmittance_atlas=[(2.0, 0.1), (4.0, 0.05)], raymarch=[(4.0, 0.3)], none=[(0.1, 0.3), (1.0, 0.2)],
                   volpath=[(1.0, 0.9), (9.0, 0.4)])
    demo.picture(tmp_path / "comparison.png", shots, references, measured, study)
    after = io.imread(tmp_path / "comparison.png")
    added = after.shape[0] - before.shape[0]
    assert added == pytest.approx(110 * demo.CURVE_HEIGHT, abs=2) and after.shape[1] == before.shape[1]
    assert after[-added:, :, :3].std() > 20 and np.abs(after[:-added] - before.astype(float)).mean() < 12
    part = Figure(figsize=(12.4, 4.8), layout="constrained")
    demo.curves(part, study)
    axes = part.axes[0]
    assert axes.get_title() == ("environment map: what accuracy costs, 4 ways to render 64×64 pixels, held against the "
                                "converged field. The machine was noisy")
    lines = {line.get_label(): line for line in axes.lines}
    assert set(lines) == {"Pareto front", "transmittance atlas", "raymarch", "none (a bound)", "volpath"}
    for name in ("transmittance_atlas", "raymarch", "volpath"):
        assert to_hex(lines[name.replace("_", " ")].get_color()) == COLOURS[name]
    assert lines["none (a bound)"].get_linestyle() == "--" and lines["raymarch"].get_linestyle() == "-"
    part.draw_without_rendering()
    box, legend = axes.get_window_extent(), axes.get_legend().get_window_extent()
    assert legend.x0 >= box.x1 and legend.x1 <= part.bbox.x1 and legend.y0 >= part.bbox.y0  # beside, within the figure


def test_a_study_without_a_way_says_so_in_the_picture():
    from matplotlib.figure import Figure

    part = Figure()
    demo.curves(part, _found())
    assert part.axes[0].texts[0].get_text() == "no way was measured: a larger --budget measures some"


def test_a_failing_study_leaves_table_and_picture(tmp_path, monkeypatch, capsys):
    def rendered(command, scene, light, visibility, spp, size, out, repeats):
        return demo.Shot(light, visibility, [1.0], demo._reference(scene.parent, light, size))

    def failing(*arguments):
        raise MiNtfError("no light")

    monkeypatch.setattr(demo, "render", rendered)
    monkeypatch.setattr(demo, "study", failing)
    monkeypatch.setattr(sys, "argv", ["demo", "--size", "32", "--out", str(tmp_path)])
    assert demo.main() == 1
    printed = capsys.readouterr()
    assert "demo: the study failed; table and picture of the renders are in" in printed.err
    assert printed.err.endswith("without its curves\nno light\n")
    assert "| point light | `raymarch` | 1.00 |" in printed.out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["comparison.png", "metrics.json", "table.md"]


def test_a_budget_that_is_none_is_refused_before_the_renders(tmp_path):
    with pytest.raises(MiNtfError, match="--budget is 'soon', expected a time of a second or more such as 90s"):
        demo.demo(out=tmp_path / "out", size=32, budget="soon")
    assert not (tmp_path / "out").exists()


def test_program_falls_back_where_the_bridge_is_missing(monkeypatch):
    from mi_ntf import doctor

    monkeypatch.setattr(doctor, "check_bridge", lambda: doctor.Check("bridge", False, False, "not built here"))
    command, note = demo.program()
    assert command == [sys.executable, "-m", "mi_ntf", "render"] and "not built here" in note
    monkeypatch.setattr(doctor, "check_bridge", lambda: doctor.Check("bridge", True, False, "built"))
    command, note = demo.program()
    assert command[0].endswith("mitsuba") and "stock" in note


def test_command_line_names_a_missing_scene():
    done = subprocess.run([sys.executable, "-m", "benchmarks.demo", "--scene", "nowhere"], capture_output=True,
                          text=True, check=False)
    assert done.returncode == 1 and "nowhere/scene.xml does not exist" in done.stderr.replace("\n", "")


def test_measuring_never_imports_torch():
    code = ("import sys, numpy as np; import benchmarks.demo; from mi_ntf.evaluate.compare import compare_arrays;"
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
    for name in demo.REPORT:
        assert (folder / "tradeoff" / name).stat().st_size > 0


COARSE = (('name="interior">', 'name="interior"><integer name="resolution" value="96"/>'),
          ('<default name="map" value="0"/>', '<default name="map" value="64"/>'))
"""What makes the statue's scene quick to load: most of a render on few pixels is the field's grid and the maps."""


def test_the_demo_on_few_pixels(tmp_path):
    """The command of `make demo` itself, by the stock program, on 32² pixels of a coarser statue. The user's cache of
    maps is on and empty: so it stays, though maps are made."""
    out, cache, scene = tmp_path / "out", tmp_path / "cache", tmp_path / "scenes" / "statue"
    for name in ("statue", "common"):
        shutil.copytree(ROOT / "scenes" / name, tmp_path / "scenes" / name)
    text = (scene / "scene.xml").read_text()
    for old, new in COARSE:
        assert old in text
        text = text.replace(old, new)
    (scene / "scene.xml").write_text(text)
    command = [sys.executable, "-m", "benchmarks.demo", "--size", "32", "--spp", "16", "--environment-spp", "4",
               "--budget", "5s", "--scene", str(scene), "--out", str(out)]  # fmt: skip
    environment = {**os.environ, "MI_NTF_CACHE": "on", "XDG_CACHE_HOME": str(cache)}
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    check_demo(out, 0.8, 0.3, 0.15)
    assert not list(cache.rglob("*.safetensors"))
    assert "reference:" in done.stderr and str(out / "tradeoff" / "index.html") in done.stdout
    result = json.loads((out / "tradeoff" / "tradeoff.json").read_text())
    assert result["parameters"] == {"light": "env", "res": "32", "spp": "4"} and result["budget_seconds"] == 5
    assert result["scene_size"] == [32, 32] and "reference_env.exr" in result["mesh"]
    shown = {row["method"] for row in result["ways"] if row["points"]}
    assert {*demo.VISIBILITIES, "transmittance_atlas", "volpath", "mesh"} <= shown


@pytest.mark.slow
def test_make_demo():
    """The whole demo, as a user runs it, gives README's figures."""
    done = subprocess.run(["make", "demo"], cwd=ROOT, capture_output=True, text=True, check=False, timeout=3600)
    assert done.returncode == 0, done.stdout + done.stderr
    check_demo(ROOT / "out" / "demo", 0.9, 0.25, 0.07)
    result = json.loads((ROOT / "out" / "demo" / "tradeoff" / "tradeoff.json").read_text())
    curves = {row["method"] for row in result["ways"] if len(row["points"]) > 1}
    assert result["finished"] and len(curves) >= 6 and {*demo.VISIBILITIES, "transmittance_atlas"} <= curves


@pytest.mark.parametrize("size", [8, 100, 512])
def test_a_size_that_divides_nothing_is_refused(size, tmp_path):
    with pytest.raises(MiNtfError, match=f"size is {size}, expected a divisor of the reference's 256 pixels"):
        demo.demo(out=tmp_path, size=size)

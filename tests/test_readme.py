"""Every command and snippet of the pages runs, with smaller settings where its own would take minutes."""

import re
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import trimesh
from data import forms
from helpers import splats
from helpers.command_process import CommandProcess
from helpers.programs import run_program

from mi_ntf import cli
from mi_ntf.data import grids

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted((ROOT / "docs").rglob("*.md"))]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES if page.name != "plugins.md")
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", TEXT, re.S)
COMMANDS = [line.split("#")[0] for line in TEXT.splitlines() if re.match(r"    (mi-ntf|mitsuba|make|python) ", line)]
COMMANDS = [line.split() for line in dict.fromkeys(map(str.rstrip, COMMANDS))]
SMALLER = {"--minutes": "0.03", "--steps": "10", "--size": "24", "--budget": "5s"}
FEWER = '<integer name="environment_lights" value="8"/><integer name="samples" value="96"/>'
COARSE = '<integer name="resolution" value="64"/>'
CAPTURE = {"--views": "12", "--size": "24", "--test-views": "1", "--spp": "2"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Make a folder with the files that the pages' commands expect: the shipped scenes, a scene of meshes, photographs
    with a COLMAP model, a grid, two images."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "scenes", folder / "scenes")
    shutil.copytree(ROOT / "docs/gallery", folder / "docs/gallery", ignore=shutil.ignore_patterns("assets"))
    script = folder / "docs/gallery/assets.py"
    text = script.read_text()
    for number, fewer in (("= 96", "= 12"), ("= 40_000", "= 400"), ("= 192", "= 24")):
        text = text.replace(number, fewer)
    script.write_text(text)
    for scene in folder.rglob("*.xml"):
        _make_coarse(scene)
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        from own_mesh import BOXES
    finally:
        sys.path.pop(0)
    (folder / "scene.xml").write_text(BOXES.replace('value="96"', 'value="24"'))
    for name in ("skull_flash", "mine"):
        forms.colmap(folder / name)
    grids.write_vol(folder / "smoke.vol", np.random.default_rng(0).uniform(0, 1, (6, 7, 8)), grids.UNIT)
    splats.write_ply(folder / "splats.ply", splats.on_mesh(trimesh.creation.icosphere(2), 300))
    timeline = folder / "scenes/statue/circle.toml"
    timeline.write_text(timeline.read_text().replace("frames = 120", "frames = 4"))
    shutil.copy(ROOT / "scenes/statue/reference_point.exr", folder / "reference.exr")
    with OpenEXR.File(str(folder / "reference.exr"), separate_channels=True) as file:  # a render that differs a little
        channels = {name: channel.pixels * (1 if name == "A" else 1.02) for name, channel in file.channels().items()}
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(folder / "a.exr"))
    return folder


def _make_coarse(scene):
    """Give a scene fewer lights, steps and voxels."""
    text = re.sub('(<integrator type="nrf">)', rf"\1{FEWER}", scene.read_text())
    scene.write_text(re.sub(r'(field\.safetensors" ?/>)', rf"\1{COARSE}", text))


@pytest.fixture(scope="module")
def process(folder):
    """Start the process of all commands but `mitsuba`."""
    process = CommandProcess(folder, **cache(folder))
    yield process
    process.close()


def cache(folder):
    """Return the environment variables of a cache that all commands share, and that is not the user's."""
    return {"MI_NTF_CACHE": "on", "XDG_CACHE_HOME": str(folder / "cache")}


def check(process, folder, *words):
    """Run a command and return what it printed."""
    if words[0] == "mitsuba":
        done = run_program(*words, cwd=folder, **cache(folder))
        code, text = done.returncode, done.stdout + done.stderr
    else:
        code, text = process.run(*words)
    assert code == 0, f"{' '.join(words)}\n{text}"
    return text


@pytest.mark.parametrize(("language", "code"), BLOCKS, ids=[language for language, _ in BLOCKS])
def test_snippet(folder, process, language, code):
    if language == "xml":
        (folder / "snippet.xml").write_text(code.replace('"256"', '"24"').replace('value="16"', 'value="2"'))
        check(process, folder, "mitsuba", "-m", "llvm_ad_rgb", "-o", "snippet.exr", "snippet.xml")
        assert (folder / "snippet.exr").stat().st_size > 0
    else:
        assert language == "python" and "assert" in code
        (folder / "snippet.py").write_text(code)
        check(process, folder, "python", "snippet.py")


def opened(words, folder):
    """Start a view, read its page, and end it."""
    command = [sys.executable, "-m", "mi_ntf", *words[1:], "--size", "16", "--samples", "1", "--port", "8190"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        try:
            address = next(m[1] for m in (re.match(r"Open (http:\S+) ", line) for line in program.stdout) if m)
            assert b"<html" in urllib.request.urlopen(address).read()
        finally:
            program.terminate()


def smaller(words):
    """Return the words of a command with settings that take seconds."""
    words = list(words)
    for option, value in SMALLER.items():
        if option in words:
            words[words.index(option) + 1] = value
    if words[0] == "mitsuba":
        words = [re.sub("^res=.*", "res=16", word) for word in words]
        if "scenes/" in words[-1]:  # a swapped one is small by itself
            words[1:1] = ["-D", "res=16"]
    elif words[:2] == ["python", "docs/gallery/make.py"]:
        words += ["--size", "12", "--spp", "1", "--out", "pictures"]
    elif words[1] == "capture":
        words += [word for k, v in CAPTURE.items() if k not in words for word in (k, v)]
    elif words[1] == "render":
        words[2:2] = ["-D", "res=16", "-D", "spp=1"]
    elif "--baked" in words:  # a field of few steps is fog, whose voxels take long
        words = ["mi-ntf", "bake", "scenes/knot/field.safetensors", "--baked"]
    elif words[1] == "export":
        words += ["--resolution", "48"]
    elif words[1] in ("explain", "bake", "tradeoff", "sequence") and "scenes" in " ".join(words):
        words += ["-D", "res=16", "-D", "spp=1"]
    if words[1] == "tradeoff" and "--budget" not in words:
        words += ["--budget", SMALLER["--budget"]]
    return words


NEEDS_MORE = {
    "mi-ntf bridge": "tests/test_bridge.py builds it",
    "mi-ntf refine": "tests/refine runs it",
    "python -m benchmarks.": "tests/benchmarks runs the scripts",
    "python scenes/skull/make_picture.py": "the photographs are not part of this project",
}
"""Beginnings of commands that are not run → the reason."""


def _marks(words):
    """Mark trainings that differ from another one by their options alone: `make hard-cases` runs them."""
    return [pytest.mark.slow] if {"mine.safetensors", "skull.safetensors", "knot.safetensors"} & set(words) else []


@pytest.mark.parametrize(
    "words", [pytest.param(words, id=" ".join(words), marks=_marks(words)) for words in COMMANDS])
def test_command(folder, process, words):
    """In their order: later commands use the files of earlier ones."""
    line = " ".join(words)
    if words[0] == "make":  # they install, or run this suite
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M)
    elif any(line.startswith(start) for start in NEEDS_MORE):
        script = words[2].replace(".", "/") + ".py" if words[1] == "-m" else words[1]
        assert words[0] == "mi-ntf" or (ROOT / script).is_file()
    elif words[1] == "view":
        opened(words, folder)
    else:
        if words[0] == "mitsuba" and words[-1] == "nrf.xml":
            _make_coarse(folder / "nrf.xml")
        printed = check(process, folder, *smaller(words))
        assert words[1] != "info" or '<point name="center"' in printed


@pytest.mark.parametrize("name", ["README.md", "docs/start.md"])
def test_programs_of_the_environment_come_after_its_activation(name):
    """Commands of a page are on the path once `. .venv/bin/activate` was run, and those before say how long they take.
    """
    lines = [line.strip() for line in (ROOT / name).read_text(encoding="utf-8").splitlines() if line.startswith("    ")]
    shown = [line for line in lines if re.match(r"(mi-ntf|mitsuba|python|make|pip|\. \.venv)", line)]
    activation = [line.startswith(". .venv/bin/activate") for line in shown].index(True)
    before = shown[:activation]
    assert before and all(re.match(r"make \w+.* # \d+ (s|min).*download", line) for line in before)


def test_long_commands_of_the_readme_say_how_long_they_take():
    lines = re.findall(r"^    ((?:mi-ntf|mitsuba|make) .*)$", (ROOT / "README.md").read_text(encoding="utf-8"), re.M)
    assert len(lines) > 6
    assert all(re.search(r"# .*\d+ (s|min)|--minutes \d+", line) for line in lines)


def test_every_command_is_shown():
    shown = {words[1] for words in COMMANDS if words[0] == "mi-ntf"}
    assert shown == set(cli.COMMANDS)


def test_readme_is_short():
    """README has a screen and a half of text."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 90 and max(map(len, lines)) <= 120


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    """To files that are there, and to headings in them."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if target.startswith("https:"):
            continue
        name, _, heading = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.is_file(), target
        headings = re.findall(r"^#+ (.*)", file.read_text(encoding="utf-8"), re.M) if heading else []
        assert not heading or heading in [re.sub(r"[^\w -]", "", h).lower().replace(" ", "-") for h in headings], target


def test_the_site_has_no_warnings(tmp_path):
    """Sphinx reads all pages and resolves all links; notebooks are not executed here."""
    pytest.importorskip("myst_nb")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "dummy", "-D", "nb_execution_mode=off",
               "-d", str(tmp_path / "trees"), str(ROOT / "docs"), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr

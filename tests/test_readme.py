"""Every command and snippet of the pages runs, with smaller settings where its own would take minutes."""

import re
import shutil
import subprocess
import sys
import urllib.request
from pathlib import Path

import OpenEXR
import pytest
from data import forms
from helpers.programs import run_program

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in PAGES)
BLOCKS = re.findall(r"```(\w+)\n(.*?)```", TEXT, re.S)
COMMANDS = [line.split("#")[0] for line in TEXT.splitlines() if re.match(r"    (mi-ntf|mitsuba|make) ", line)]
COMMANDS = [line.split() for line in dict.fromkeys(map(str.rstrip, COMMANDS))]
SMALLER = {"--minutes": "0.1", "--steps": "20", "--size": "24", "--budget": "5s"}
CAPTURE = {"--views": "12", "--size": "24", "--test-views": "1", "--spp": "2"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The shipped scenes, a mesh scene of one's own, photographs with a COLMAP model, and two images, as the pages'
    commands expect them."""
    folder = tmp_path_factory.mktemp("readme")
    shutil.copytree(ROOT / "scenes", folder / "scenes")
    sys.path.insert(0, str(ROOT / "examples"))
    try:
        from own_mesh import BOXES
    finally:
        sys.path.pop(0)
    (folder / "scene.xml").write_text(BOXES.replace('value="96"', 'value="24"'))
    for name in ("skull_flash", "mine"):
        forms.colmap(folder / name)
    shutil.copy(ROOT / "scenes/statue/reference_point.exr", folder / "reference.exr")
    with OpenEXR.File(str(folder / "reference.exr"), separate_channels=True) as file:  # a render that differs a little
        channels = {name: channel.pixels * (1 if name == "A" else 1.02) for name, channel in file.channels().items()}
    with OpenEXR.File({"type": OpenEXR.scanlineimage}, channels) as file:
        file.write(str(folder / "a.exr"))
    return folder


def check(*words, folder):
    own = {"XDG_CACHE_HOME": str(folder / "cache")} if words[1] == "cache" else {}  # not the user's
    done = run_program(*words, cwd=folder, **own)
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.mark.parametrize(("language", "code"), BLOCKS, ids=[language for language, _ in BLOCKS])
def test_snippet(folder, language, code):
    if language == "xml":
        (folder / "snippet.xml").write_text(code.replace('"256"', '"24"').replace('value="16"', 'value="2"'))
        check("mitsuba", "-m", "llvm_ad_rgb", "-o", "snippet.exr", "snippet.xml", folder=folder)
        assert (folder / "snippet.exr").stat().st_size > 0
    else:
        assert language == "python"
        (folder / "snippet.py").write_text(code + "assert image.shape == (64, 64, 4)\n")
        check("python", "snippet.py", folder=folder)


def opened(words, folder):
    """A view of `words` is served, and ended."""
    command = [sys.executable, "-m", "mi_ntf", *words[1:], "--size", "16", "--samples", "1", "--port", "8190"]
    with subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as program:
        try:
            address = next(m[1] for m in (re.match(r"Open (http:\S+) ", line) for line in program.stdout) if m)
            assert b"<html" in urllib.request.urlopen(address).read()
        finally:
            program.terminate()


def _marks(words) -> list:
    """How shipped fields were trained takes minutes here too, some trainings differ by their options alone, and prices
    are measured by other tests: `make hard-cases` runs those."""
    dear = {"--measure", "mine.safetensors", "knot-photographs", "scenes/skull/field.safetensors"}
    slow = dear & set(words) or words[:3] == ["mi-ntf", "train", "skull_flash"]
    return [pytest.mark.slow] if slow else []


@pytest.mark.parametrize(
    "words", [pytest.param(words, marks=_marks(words), id=" ".join(words)) for words in COMMANDS])
def test_command(folder, words):
    """In their order: later ones use the files of earlier ones."""
    if words[0] == "make":  # they install, or run this suite
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(), re.M)
        return
    if words[1] == "view":
        opened(words, folder)
        return
    words = list(words)
    for option, value in SMALLER.items():
        if option in words:
            words[words.index(option) + 1] = value
    if words[1] == "capture":
        words += [word for k, v in CAPTURE.items() if k not in words for word in (k, v)]
    if words[0] == "mitsuba" and "scenes/" in words[-1]:  # a swapped one is small by itself
        words[1:1] = ["-D", "res=16"]
    if words[:2] == ["mi-ntf", "render"]:
        words[2:2] = ["-D", "res=16", "-D", "spp=1"]
    if words[1] == "export":
        words += ["--resolution", "48"]
    if words[1] == "sequence":
        (folder / "scenes/statue/circle.toml").write_text(
            (ROOT / "scenes/statue/circle.toml").read_text().replace("frames = 120", "frames = 4"))
        check(*words, "-D", "res=16", "-D", "spp=1", folder=folder)
        return
    if words[1] in ("explain", "bake", "tradeoff"):
        words += ["-D", "res=16", "-D", "spp=1"]
    if words[1] == "tradeoff" and "--budget" not in words:
        words += ["--budget", SMALLER["--budget"]]
    printed = check(*words, folder=folder)
    assert words[1] != "info" or "similarity" in printed


def test_every_command_is_shown():
    shown = {words[1] if words[0] == "mi-ntf" else words[0] for words in COMMANDS}
    assert shown == {"capture", "inspect", "train", "swap", "mitsuba", "info", "compare", "explain", "bake", "make",
                     "tradeoff", "export", "render", "sequence", "view", "cache"}


def test_readme_is_short():
    """Two screens."""
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 110 and max(map(len, lines)) <= 120


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

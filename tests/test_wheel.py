"""The wheel: what is in it, and that it renders a shipped field in an environment of its own, without the checkout."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
OFFLINE = "Failed to establish a new connection|[Nn]ame resolution|NameResolutionError|Name or service not known"


def run(*words: str | Path, cwd: Path, **environment: str) -> str:
    """What a program prints; it sees nothing of this environment's packages. A machine without a network is a reason to
    skip, since pip fetches what builds and what is needed."""
    kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(list(map(str, words)), cwd=cwd, env={**kept, **environment}, capture_output=True, text=True)
    if done.returncode and re.search(OFFLINE, done.stderr):
        pytest.skip("pip reaches no package index from here")
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Path:
    """Return the result of `pip wheel .`."""
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "-w", folder, ROOT, cwd=folder)
    [path] = folder.glob("*.whl")
    return path


def test_it_holds_the_package_and_the_entry_points_alone(wheel: Path):
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        points = archive.read(next(n for n in names if n.endswith("entry_points.txt"))).decode()
        [metadata] = (archive.read(n).decode() for n in names if n.endswith("METADATA"))
    meta = {n for n in names if ".dist-info/" in n}
    package = {str(p.relative_to(ROOT)) for p in (ROOT / "mi_ntf").rglob("*")
               if p.suffix in (".py", ".cpp", ".h", ".typed")}
    assert names - meta == package and wheel.name.endswith("-py3-none-any.whl")
    assert {"LICENSE", "NOTICE"} <= {Path(n).name for n in meta}
    assert "[mitsuba]\nmi_ntf = mi_ntf.mitsuba_plugin" in points and "mi-ntf = mi_ntf.cli:main" in points
    assert "Requires-Dist: mitsuba<4,>=3.9\n" in metadata and "Requires-Python: >=3.10\n" in metadata


@pytest.mark.slow  # 20 s of processor time
def test_in_an_empty_environment_it_renders_a_shipped_field_as_here(wheel: Path, tmp_path: Path):
    run(sys.executable, "-m", "venv", "--without-pip", tmp_path / "env", cwd=tmp_path)
    programs = tmp_path / "env" / "bin"
    run(sys.executable, "-m", "pip", "--python", programs / "python", "install", "--quiet", wheel, cwd=tmp_path)
    shutil.copytree(ROOT / "scenes" / "statue", tmp_path / "statue")
    llvm = Path(mi.__path__[0]).parent / "drjit" / "libLLVM.so"
    library = {"DRJIT_LIBLLVM_PATH": str(llvm.resolve())} if llvm.exists() else {}
    flags = ("-m", "llvm_ad_rgb", "-D", "res=24", "-D", "spp=2", "-D", "visibility=raymarch", "-D", "depth=2")
    scene = ("statue/scene.xml",)
    where = run(programs / "python", "-c", "import mi_ntf; print(mi_ntf.__file__)", cwd=tmp_path)
    assert where.startswith(str(tmp_path))
    run(programs / "mi-ntf", "bridge", cwd=tmp_path)
    run(programs / "mitsuba", *flags, "-o", "stock.exr", *scene, cwd=tmp_path, **library)
    run(programs / "mi-ntf", "render", *flags, "-o", "own.exr", *scene, cwd=tmp_path, **library)
    here = Path(sys.executable).with_name("mitsuba")
    run(here, *flags, "-o", "here.exr", *scene, cwd=tmp_path)
    pictures = {name: np.array(mi.Bitmap(str(tmp_path / f"{name}.exr"))) for name in ("stock", "own", "here")}
    assert pictures["here"][..., :3].max() > 0.1
    np.testing.assert_array_equal(pictures["stock"], pictures["here"])
    np.testing.assert_array_equal(pictures["own"], pictures["here"])

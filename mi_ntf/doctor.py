"""`mi-ntf doctor`: what this machine has, what it lacks, and the command that mends it.

Everything that may abort the process (a bad LLVM does) is tried in a child process.
"""

import ctypes
import importlib.metadata
import importlib.util
import os
import platform
import subprocess
import sys
import sysconfig
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from mi_ntf import __version__
from mi_ntf.jobs.options import cores

PYTHON_MINIMUM = (3, 10)
MITSUBA_MINIMUM = (3, 9)
LLVM_MINIMUM = 17
EXTRAS = {
    "train": ("torch", "tensorboard", "matplotlib", "PIL", "cv2"),
    "video": ("imageio_ffmpeg",),
    "view": ("viser", "websockets"),
    "eval": ("skimage", "flip_evaluator", "matplotlib", "PIL"),
    "mesh": ("skimage", "scipy", "trimesh"),
    "watch": ("tevclient",),
    "cluster": ("submitit", "distributed", "bokeh"),
}
"""Extras of this package and the modules that they bring."""

# With LLVM 15 or 16 exactly this kind of kernel ends the process.
_LLVM_PROBE = """
import drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
assert dr.minimum(mi.Float(1, 3), 2)[1] == 2
print(".".join(map(str, dr.detail.llvm_version())))
for line in open("/proc/self/maps"):
    if "libLLVM" in line:
        print(line.split()[-1])
        break
"""
_CUDA_PROBE = """
import drjit as dr, mitsuba as mi
mi.set_variant("cuda_ad_rgb")
assert dr.minimum(mi.Float(1, 3), 2)[1] == 2
print(".".join(map(str, dr.detail.cuda_version())))
"""


@dataclass(frozen=True)
class Check:
    """Result of one check. `needed`: rendering is impossible without it. `remedy`: empty if nothing is to be done."""

    name: str
    ok: bool
    needed: bool
    found: str
    remedy: str = ""


def examine() -> dict[str, Any]:
    """Run all checks and return the results as plain data.

    Keys: `ok` (every needed check passed), `version`, `checks` (list of the fields of :class:`Check`)."""
    checks = [check_python(), check_cores(), *check_mitsuba(), check_llvm(), check_cuda()]
    checks += [check_bridge(), check_libpython()]
    checks += [check_extra(name) for name in EXTRAS]
    return {
        "ok": all(check.ok for check in checks if check.needed),
        "version": __version__,
        "checks": [asdict(check) for check in checks],
    }


def print_table(report: dict[str, Any]) -> None:
    """Print the findings, faults with their remedy below."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"mi-ntf {report['version']}", title_justify="left", show_header=False, box=None)
    table.add_column()
    table.add_column()
    table.add_column(overflow="fold")
    for check in report["checks"]:
        mark = "[green]✔" if check["ok"] else "[red]✘" if check["needed"] else "[yellow]–"
        table.add_row(mark, check["name"], check["found"])
    console.print(table)
    for check in report["checks"]:
        if check["remedy"]:  # never wrapped, so that commands can be copied
            console.print(f"{check['name']}: {check['remedy']}", soft_wrap=True, markup=False, highlight=False)


def check_python() -> Check:
    """The interpreter that runs this."""
    minimum = ".".join(map(str, PYTHON_MINIMUM))
    ok = sys.version_info >= PYTHON_MINIMUM
    return Check(
        "Python",
        ok,
        True,
        f"{platform.python_version()} ({sys.executable})",
        "" if ok else f"make the environment with Python {minimum} or newer",
    )


def check_cores() -> Check:
    """Cores of this process. With one, Mitsuba alone waits for ever when it reads or writes an EXR file."""
    count = cores()
    remedy = (
        "mi-ntf and scenes with its plugins use two threads by themselves; render other scenes with `mitsuba -t 3` "
        "and call drjit.set_thread_count(2) in Python programs without mi_ntf.render.register()"
    )
    return Check("cores", count > 1, False, str(count), "" if count > 1 else remedy)


def check_mitsuba() -> list[Check]:
    """Check that Mitsuba is recent enough, and that Dr.Jit is there."""
    checks = []
    for package in ("mitsuba", "drjit"):
        version = _version(package)
        ok = bool(version) and (package == "drjit" or tuple(map(int, version.split(".")[:2])) >= MITSUBA_MINIMUM)
        minimum = ".".join(map(str, MITSUBA_MINIMUM))
        remedy = "" if ok else f"{sys.executable} -m pip install 'mitsuba>={minimum},<4'"
        checks.append(Check(package, ok, True, version or "not installed", remedy))
    return checks


def check_llvm() -> Check:
    """Dr.Jit's LLVM back end runs a kernel with a minimum."""
    code, lines, error = _probe(_LLVM_PROBE)
    version = lines[0] if lines else ""
    path = lines[1] if len(lines) > 1 else "path unknown"
    ok = code == 0 and int(version.split(".")[0]) >= LLVM_MINIMUM
    if ok:
        return Check("LLVM", True, True, f"{version} ({path})")
    found = f"{version} ({path})" if version else f"not usable: {error}"
    return Check(
        "LLVM",
        False,
        True,
        found,
        f"install LLVM {LLVM_MINIMUM} or newer (Debian: sudo apt-get install libllvm19) and run "
        "`export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*-linux-gnu/libLLVM.so.19.1)`",
    )


def check_cuda() -> Check:
    """A GPU is welcome and not needed."""
    code, lines, _ = _probe(_CUDA_PROBE)
    return Check("CUDA", code == 0, False, lines[0] if code == 0 and lines else "not available; LLVM is used")


def check_bridge() -> Check:
    """Check that the bridge is where the stock program looks, and belongs to the installed Mitsuba."""
    if not _version("mitsuba"):
        return Check("bridge", False, False, "no Mitsuba to extend")
    from mi_ntf import build_bridge

    library = build_bridge.plugin_folder() / "nrf.so"
    missing, built_for = build_bridge.missing_names(), build_bridge.built_for(library)
    if not missing:
        return Check("bridge", True, False, f"built for mitsuba {built_for} ({library.parent})")
    state = (f"built for mitsuba {built_for}, installed is {_version('mitsuba')}" if built_for else
             f"not installed ({', '.join(missing)}); `mi-ntf render` works without it")
    return Check("bridge", False, False, state, "run `mi-ntf bridge` (needs a C++ compiler; Debian: sudo apt-get "
                 "install g++)")


def check_libpython() -> Check:
    """With a shared libpython the stock program runs Python inside; without it, it hands over to `mi-ntf render`."""
    name = f"libpython{sys.version_info.major}.{sys.version_info.minor}.so.1.0"
    library = Path(sysconfig.get_config_var("LIBDIR") or "") / name
    shared = library.is_file()
    if not shared and Path(sys.base_prefix) == Path("/usr"):
        try:
            ctypes.CDLL(name)
            shared = True
        except OSError:
            pass
    remedy = f"sudo apt-get install {name.removesuffix('.so.1.0')}" if sys.base_prefix == "/usr" else ""
    return Check(
        "libpython",
        shared,
        False,
        name if shared else f"no {name}; `mitsuba` hands over to `mi-ntf render`",
        "" if shared else remedy,
    )


def check_extra(extra: str) -> Check:
    """Modules of one optional extra, by presence alone: nothing is imported."""
    missing = [module for module in EXTRAS[extra] if importlib.util.find_spec(module) is None]
    remedy = pip_install(f"[{extra}]") if missing else ""
    return Check(
        f"extra {extra}", not missing, False, "missing: " + ", ".join(missing) if missing else "installed", remedy
    )


def pip_install(extras: str, *options: str) -> str:
    """The command that installs this package again, from the checkout if it lies in one."""
    checkout = Path(__file__).resolve().parents[1]
    source = f"-e '{checkout}{extras}'" if (checkout / "pyproject.toml").is_file() else f"'mi-ntf{extras}'"
    return " ".join([sys.executable, "-m pip install", *options, source])


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _probe(code: str) -> tuple[int, list[str], str]:
    """Run Python code in a child: exit status, words of its output, the line that names the fault."""
    child = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONWARNINGS": "ignore"},
    )
    errors = child.stderr.strip().splitlines()
    named = [line for line in errors if "error" in line.lower()]
    reason = (named or errors or [f"the process ended with status {child.returncode}"])[-1]
    return child.returncode, child.stdout.split(), reason

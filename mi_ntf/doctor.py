"""`mi-ntf doctor`: checks of this machine, and the command that repairs each fault.

Checks that may abort the process, as an unfit LLVM does, run in a child process.
"""

import ctypes
import importlib.metadata
import os
import platform
import subprocess
import sys
import sysconfig
from dataclasses import dataclass
from pathlib import Path

from mi_ntf import __version__
from mi_ntf.core import extras
from mi_ntf.jobs.options import cores

PYTHON_MINIMUM = (3, 10)
MITSUBA_MINIMUM = (3, 9)
LLVM_MINIMUM = 17

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
    """Result of one check."""

    name: str
    ok: bool
    needed: bool  # rendering is impossible without it
    found: str  # state of the machine
    remedy: str = ""  # empty if there is nothing to do


@dataclass(frozen=True)
class Report:
    """Results of the checks of this machine. `ok` is True if every needed check passed."""

    ok: bool
    version: str
    checks: list[Check]


def examine() -> Report:
    """Run all checks."""
    checks = [check_python(), check_cores(), *check_mitsuba(), check_llvm(), check_cuda()]
    checks += [check_bridge(), check_libpython()]
    checks += [check_extra(name) for name in extras.EXTRAS]
    return Report(all(check.ok for check in checks if check.needed), __version__, checks)


def print_table(report: Report) -> None:
    """Print all checks, and the remedies of faults below."""
    from rich.console import Console
    from rich.table import Table

    console = Console()
    table = Table(title=f"mi-ntf {report.version}", title_justify="left", show_header=False, box=None)
    table.add_column()
    table.add_column()
    table.add_column(overflow="fold")
    for check in report.checks:
        mark = "[green]✔" if check.ok else "[red]✘" if check.needed else "[yellow]–"
        table.add_row(mark, check.name, check.found)
    console.print(table)
    for check in report.checks:
        if check.remedy:  # never wrapped, so that commands can be copied
            console.print(f"{check.name}: {check.remedy}", soft_wrap=True, markup=False, highlight=False)
    console.print("verdict: scenes can be rendered" if report.ok else
                  "verdict: no scene can be rendered; mend what is marked ✘", soft_wrap=True, highlight=False)


def check_python() -> Check:
    """Check the version of the running interpreter."""
    minimum = ".".join(map(str, PYTHON_MINIMUM))
    ok = sys.version_info >= PYTHON_MINIMUM
    return Check("Python", ok, True, f"{platform.python_version()} ({sys.executable})",
                 "" if ok else f"make the environment with Python {minimum} or newer")


def check_cores() -> Check:
    """Check that this process has two cores. With one, Mitsuba hangs when it reads or writes an EXR file."""
    count = cores()
    remedy = ("mi-ntf and scenes with its plugins use two threads by themselves; render other scenes with "
              "`mitsuba -t 3` and call drjit.set_thread_count(2) in Python programs without mi_ntf.render.register()")
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
    """Check that Dr.Jit's LLVM back end runs a kernel."""
    code, lines, error = _probe(_LLVM_PROBE)
    version = lines[0] if lines else ""
    path = lines[1] if len(lines) > 1 else "path unknown"
    ok = code == 0 and int(version.split(".")[0]) >= LLVM_MINIMUM
    if ok:
        return Check("LLVM", True, True, f"{version} ({path})")
    return Check("LLVM", False, True, f"{version} ({path})" if version else f"not usable: {error}",
                 f"install LLVM {LLVM_MINIMUM} or newer (Debian: sudo apt-get install libllvm19) and run "
                 "`export DRJIT_LIBLLVM_PATH=$(ls /usr/lib/*-linux-gnu/libLLVM.so.19.1)`")


def check_cuda() -> Check:
    """Check that Dr.Jit's CUDA back end runs a kernel. It is optional."""
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
    """Check for a shared libpython, by which the stock program runs Python. Without it, `mi-ntf render` takes over."""
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
    return Check("libpython", shared, False, name if shared else f"no {name}; `mitsuba` hands over to `mi-ntf render`",
                 "" if shared else remedy)


def check_extra(extra: str) -> Check:
    """Check that the modules of an optional extra are there, without importing them."""
    missing = extras.missing(extra)
    remedy = pip_install(f"[{extra}]") if missing else ""
    state = "missing: " + ", ".join(missing) if missing else "installed"
    return Check(f"extra {extra}", not missing, False, state, remedy)


def pip_install(extras: str, *options: str) -> str:
    """Return the command that installs this package again, from the checkout if it lies in one."""
    checkout = Path(__file__).resolve().parents[1]
    source = f"-e '{checkout}{extras}'" if (checkout / "pyproject.toml").is_file() else f"'mi-ntf{extras}'"
    return " ".join([sys.executable, "-m pip install", *options, source])


def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return ""


def _probe(code: str) -> tuple[int, list[str], str]:
    """Run Python code in a child process. Returns its exit status, the words of its output, and its error message."""
    child = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120,
                           env={**os.environ, "PYTHONWARNINGS": "ignore"})
    errors = child.stderr.strip().splitlines()
    messages = [line for line in errors if "error" in line.lower()]
    reason = (messages or errors or [f"the process ended with status {child.returncode}"])[-1]
    return child.returncode, child.stdout.split(), reason

"""Make `.venv` in the checkout: Python packages, an LLVM that Dr.Jit can use, and the bridge.

    python3 tools/setup_env.py [EXTRA ...]        extras of pyproject.toml, e.g. eval, dev

Runs on the standard library alone. Ends at once when all is in place. On Debian and as root it
installs missing system packages; otherwise it stops and prints the command that does.
"""

import ctypes
import hashlib
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
VENV = ROOT / ".venv"
PYTHON = VENV / "bin" / "python"
STAMP = VENV / "mi_ntf_setup.json"
CONSTRAINTS = ROOT / "tools" / "constraints.txt"  # versions that the tests are run with

LLVM_MINIMUM = 17  # Dr.Jit aborts on older ones at the first kernel with a minimum
LLVM_PACKAGES = ("libllvm19", "libllvm20", "libllvm21", "libllvm18", "libllvm17")
LLVM_FOLDERS = (
    "/usr/lib/*-linux-gnu",
    "/usr/lib/llvm-*/lib",
    "/usr/lib64",
    "/usr/lib",
    "/usr/local/lib",
    "/usr/local/lib/*-linux-gnu",
)


def main(extras: list[str]) -> None:
    """Bring the environment up to date with `extras`, doing nothing that is done already."""
    if sys.version_info < (3, 10):  # noqa: UP036 (an older python3 may well be the one that make finds)
        stop(f"Python 3.10 or newer is needed, this is {sys.version.split()[0]}", "make PYTHON=python3.11 …")
    stamp = read_stamp()
    key = fingerprint()
    wanted = sorted(set(extras) | set(stamp.get("extras", [])))
    if stamp == {"key": key, "extras": wanted} and llvm_link().exists():
        return

    system_packages()
    if "dev" in wanted:
        browser()
    if not PYTHON.exists():
        say(f"making {VENV}")
        run(sys.executable, "-m", "venv", str(VENV))
    STAMP.unlink(missing_ok=True)
    say(f"installing mi-ntf[{','.join(wanted)}] (downloads on the first run)")
    run(
        str(PYTHON),
        "-m",
        "pip",
        "install",
        "--quiet",
        "--disable-pip-version-check",
        "--constraint",
        str(CONSTRAINTS),
        "-e",
        f"{ROOT}[{','.join(wanted)}]" if wanted else str(ROOT),
    )
    link_llvm()
    run(str(PYTHON), "-m", "mi_ntf", "bridge")
    run(str(PYTHON), "-m", "mi_ntf", "doctor")
    STAMP.write_text(json.dumps({"key": key, "extras": wanted}))
    say("done; `. .venv/bin/activate` puts mitsuba and mi-ntf on the path")


def fingerprint() -> str:
    """Changes with everything that asks for a new installation."""
    digest = hashlib.sha256(str(ROOT).encode())
    sources = ROOT / "mi_ntf" / "bridge_source"
    files = [ROOT / "pyproject.toml", CONSTRAINTS, Path(__file__), *sorted(sources.iterdir())]
    for file in files:
        digest.update(file.read_bytes())
    return digest.hexdigest()


def read_stamp() -> dict:
    """Return the record of the last complete run, empty if there was none or the environment is gone."""
    try:
        return json.loads(STAMP.read_text()) if PYTHON.exists() else {}
    except (OSError, ValueError):
        return {}


def system_packages() -> None:
    """Install, or name, the system packages that are missing."""
    missing = []
    if shutil.which("c++") is None and shutil.which("g++") is None and shutil.which("clang++") is None:
        missing.append("g++")
    version = f"{sys.version_info.major}.{sys.version_info.minor}"
    if not PYTHON.exists() and not has_module("ensurepip"):
        missing.append(f"python{version}-venv")
    if sys.base_prefix == "/usr" and not loads(f"libpython{version}.so.1.0"):
        missing.append(f"libpython{version}")
    if find_llvm() is None:
        missing.append(LLVM_PACKAGES[0])
    if not missing:
        return

    apt = shutil.which("apt-get")
    if apt and os.geteuid() == 0:
        say("installing " + " ".join(missing))
        environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
        subprocess.run([apt, "update", "-qq"], check=False, env=environment)
        if LLVM_PACKAGES[0] in missing:
            missing[-1] = next((name for name in LLVM_PACKAGES if in_archive(name)), LLVM_PACKAGES[0])
        done = subprocess.run([apt, "install", "-y", "-qq", "--no-install-recommends", *missing], env=environment)
        if done.returncode == 0 and find_llvm() is not None:
            return
    command = "apt-get install " + " ".join(missing)
    if apt:
        stop("system packages are missing", command if os.geteuid() == 0 else f"sudo {command}")
    stop(
        f"missing: {' '.join(missing)} (names of Debian)",
        f"install them with the package manager of this system (LLVM {LLVM_MINIMUM} or newer)",
    )


def browser() -> None:
    """Install the browser that a test looks at the viewer with, where that can be done; else the test is skipped."""
    names = ("chromium", "chromium-browser", "google-chrome")
    if any(map(shutil.which, names)) or not shutil.which("apt-get") or os.geteuid() != 0:
        return
    say("installing chromium")
    environment = {**os.environ, "DEBIAN_FRONTEND": "noninteractive"}
    for command in (["update", "-qq"], ["install", "-y", "-qq", "--no-install-recommends", "chromium"]):
        subprocess.run(["apt-get", *command], check=False, env=environment)


def in_archive(package: str) -> bool:
    """Return True if apt can install `package`."""
    return subprocess.run(["apt-cache", "show", package], capture_output=True).returncode == 0


def find_llvm() -> Path | None:
    """The newest shared LLVM library of this machine from LLVM_MINIMUM on."""
    explicit = os.environ.get("DRJIT_LIBLLVM_PATH")
    if explicit:
        return Path(explicit) if Path(explicit).is_file() else None
    found = []
    for pattern in LLVM_FOLDERS:
        for file in Path("/").glob(pattern.lstrip("/") + "/libLLVM*.so*"):
            # libLLVM-17.so.1, libLLVM.so.19.1, libLLVM.so.21.1-rc
            match = re.fullmatch(r"libLLVM(?:-(\d+)\.so(?:\.\d+)*|\.so\.(\d+).*)", file.name)
            version = int(match[1] or match[2]) if match else 0
            if version >= LLVM_MINIMUM and file.is_file():
                found.append((version, str(file)))
    return Path(max(found)[1]) if found else None


def link_llvm() -> None:
    """Pin the LLVM of this environment: Dr.Jit looks beside its own library before the system's folders."""
    link, library = llvm_link(), find_llvm()
    assert library is not None  # system_packages() has seen to it
    temporary = link.with_suffix(".new")
    temporary.unlink(missing_ok=True)
    temporary.symlink_to(library)
    temporary.replace(link)
    say(f"Dr.Jit uses {library}")


def llvm_link() -> Path:
    """Return the path at which Dr.Jit looks for LLVM first."""
    return site_packages() / "drjit" / "libLLVM.so"


def site_packages() -> Path:
    """The environment's folder of packages."""
    return next(VENV.glob("lib/python3*/site-packages"))


def has_module(name: str) -> bool:
    """Return True if this interpreter can import `name` (Debian packages ensurepip separately)."""
    return subprocess.run([sys.executable, "-c", f"import {name}"], capture_output=True).returncode == 0


def loads(library: str) -> bool:
    """Return True if the dynamic loader finds `library`."""
    try:
        ctypes.CDLL(library)
        return True
    except OSError:
        return False


def run(*command: str) -> None:
    """Run a command; its failure is ours."""
    done = subprocess.run(command, stdin=subprocess.DEVNULL)
    if done.returncode:
        stop("this command failed", " ".join(command))


def say(text: str) -> None:
    """Print a line of progress."""
    print(f"set-up: {text}", flush=True)


def stop(reason: str, command: str) -> None:
    """End with the reason and the command that helps."""
    sys.exit(f"set-up: {reason}. Run:\n    {command}")


if __name__ == "__main__":
    main(sys.argv[1:])

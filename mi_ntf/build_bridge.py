"""``mi-ntf bridge``: compile the bridge for the installed Mitsuba, so that its stock program finds the plugins.

The C++ sources are part of this package. The library is compiled against the headers of the installed Mitsuba, since
its C++ interface belongs to one version, and lies in the folder of Mitsuba's own plugins afterwards.
"""

import importlib.util
import os
import shutil
import subprocess
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from .bridge import PLUGIN_NAMES
from .core import progress
from .core.errors import MiNtfError

SOURCES = Path(__file__).parent / "bridge_source"
COMPILERS = "c++", "g++", "clang++"
FLAGS = ("-std=c++17", "-O3", "-DNDEBUG", "-fPIC", "-shared", "-fvisibility=hidden", "-fvisibility-inlines-hidden",
         "-DMI_ENABLE_LLVM=1", "-DMI_ENABLE_CUDA=1", "-DMI_ENABLE_EMBREE=1", "-DMI_ENABLE_AUTODIFF=1",
         "-Wl,-rpath,$ORIGIN/..:$ORIGIN/../../drjit")
"""Options of the compiler. Mitsuba's headers read the ``MI_ENABLE`` macros, which have the values of its wheels."""


def build() -> list[Path]:
    """Compile the bridge and install it under the name of every plugin.

    Returns
    -------
    list of Path
        The installed files, in the plugin folder of the installed Mitsuba.

    Raises
    ------
    MiNtfError
        If there is no C++ compiler, or compilation fails.
    """
    compiler = os.environ.get("CXX") or next(filter(shutil.which, COMPILERS), None)
    if compiler is None:
        raise MiNtfError("no C++ compiler (c++, g++ or clang++) is on the PATH: install one (Debian: sudo apt-get "
                         "install g++) and run `mi-ntf bridge` again; `mi-ntf render` works without the bridge")
    folder = plugin_folder()
    mitsuba, drjit, nanobind = map(_package_folder, ("mitsuba", "drjit", "nanobind"))
    headers = (mitsuba / "include", drjit / "include", nanobind / "include", nanobind / "ext/robin_map/include")
    with tempfile.TemporaryDirectory(dir=folder) as temporary:
        library = Path(temporary) / "bridge.so"
        command = [*compiler.split(), *FLAGS, f'-DMI_NTF_MITSUBA_VERSION="{version("mitsuba")}"',
                   *(f"-isystem{path}" for path in headers), *map(str, sorted(SOURCES.glob("*.cpp"))),
                   str(mitsuba / "libmitsuba.so"), str(drjit / "libdrjit-core.so"), "-ldl", "-o", str(library)]
        with progress.Stage("compiling the bridge", then="nothing was installed"):
            compilation = subprocess.run(command, capture_output=True, text=True)
        if compilation.returncode:
            raise MiNtfError(f"the bridge did not compile:\n{compilation.stderr.strip()}\nThe command was: "
                             + " ".join(command))
        installed = [folder / f"{name}.so" for name in PLUGIN_NAMES]
        for file in installed:
            copy = Path(shutil.copy(library, Path(temporary) / file.name))
            copy.replace(file)  # a running program keeps the file that it has loaded
    return installed


def remove() -> list[Path]:
    """Delete the installed bridge and return the paths of the deleted files."""
    files = [file for name in PLUGIN_NAMES if (file := plugin_folder() / f"{name}.so").exists()]
    for file in files:
        file.unlink()
    return files


def plugin_folder() -> Path:
    """Return the folder in which Mitsuba's program looks for plugins of every scene."""
    return _package_folder("mitsuba") / "plugins"


def built_for(library: Path) -> str:
    """Return the Mitsuba version that a bridge was built for, '' where `library` is missing or no bridge."""
    mark = b"mi_ntf bridge for mitsuba "
    _, is_bridge, rest = (library.read_bytes() if library.is_file() else b"").partition(mark)
    return rest.partition(b"\0")[0].decode() if is_bridge else ""


def missing_names() -> list[str]:
    """Return the names of plugins that have no bridge for the installed Mitsuba."""
    try:
        installed = version("mitsuba")
    except PackageNotFoundError:
        return list(PLUGIN_NAMES)
    return [name for name in PLUGIN_NAMES if built_for(plugin_folder() / f"{name}.so") != installed]


def _package_folder(package: str) -> Path:
    """Return the folder of an installed package without importing it."""
    spec = importlib.util.find_spec(f"{package}.config" if package == "mitsuba" else package)
    if spec is None or spec.origin is None:
        raise MiNtfError(f"the package {package} is not installed: run `pip install {package}`")
    return Path(spec.origin).parent

"""Description of the machine that renders."""

import ctypes
import platform
from pathlib import Path

import drjit as dr
import mitsuba as mi

from .. import __version__


def machine() -> str:
    """Return the version of this package, the variant, and the processor with its threads or the graphics card."""
    variant = str(mi.variant())
    hardware = graphics_card() if variant.startswith("cuda") else f"{processor()} · {dr.thread_count()} threads"
    return f"{__version__} · {hardware} · {variant}"


def graphics_card() -> str:
    """Return the name of Dr.Jit's CUDA device, or ``CUDA device`` if there is none."""
    name = ctypes.create_string_buffer(256)
    device = ctypes.c_int()
    try:
        driver = ctypes.CDLL("libcuda.so.1")
        known = (driver.cuInit(0) or driver.cuDeviceGet(ctypes.byref(device), 0)
                 or driver.cuDeviceGetName(name, len(name), device)) == 0
    except (OSError, AttributeError):  # no driver, or no such function in it
        known = False
    return name.value.decode(errors="replace").strip() if known and name.value else "CUDA device"


def processor() -> str:
    """Return the name of the processor."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()

"""Joint training of a reflectance field and its transmittance network. PyTorch only; never Mitsuba or Dr.Jit."""

import os

# Threads that wait for work sleep instead of spinning: on a machine that does other work too, spinning costs most of
# the time. OpenMP reads this once, when PyTorch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

from .config import PRESETS, FastConfig
from .trainer import train

__all__ = ["PRESETS", "FastConfig", "train"]

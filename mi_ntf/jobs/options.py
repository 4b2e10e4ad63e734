"""Options of commands that choose the workers."""

import os
import subprocess
from dataclasses import dataclass
from typing import Literal

from ..core import extras
from ..core.errors import MiNtfError

MODULES = {"dask": "distributed", "submitit": "submitit"}  # package that an engine needs


@dataclass(frozen=True)
class Workers:
    """Workers for the tasks. Without options this process does one task after the other."""

    engine: Literal["local", "submitit", "dask"] = "local"
    """local: processes of this machine. submitit: a Slurm array, or subprocesses where there is no Slurm. dask: the
    workers of --scheduler, or of this machine."""
    workers: int | None = None
    """Number of processes that work at the same time."""
    threads: int | None = None
    """Threads of each worker. Default: the cores of this machine divided by the number of workers."""
    scheduler: str | None = None
    """Address of a running Dask scheduler, as tcp://HOST:8786."""

    @property
    def here(self) -> bool:
        """True if this process does the tasks."""
        return self == Workers() or self == Workers(workers=1)

    def check(self) -> None:
        """Raise MiNtfError if options do not fit together."""
        if self.engine not in ("local", "submitit", "dask"):
            raise MiNtfError(f"engine is '{self.engine}', must be local, submitit or dask")
        for name in ("workers", "threads"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise MiNtfError(f"{name} is {value}, must be 1 or more")
        if self.scheduler is not None and self.engine != "dask":
            raise MiNtfError(f"scheduler is '{self.scheduler}' with the engine {self.engine}; it is one of Dask: add "
                             "--engine dask")
        if self.scheduler is not None and self.workers is not None:
            raise MiNtfError(f"workers is {self.workers}, but a scheduler has the workers that were started for it; "
                             "leave --workers out")
        if self.engine != "local" and self.workers is None and self.scheduler is None:
            more = ", or --scheduler ADDRESS" if self.engine == "dask" else ""
            raise MiNtfError(f"the engine {self.engine} needs a number of workers; give --workers N{more}")

    def check_installed(self) -> None:
        """Raise MiNtfError if the package of the engine is not installed."""
        if self.engine in MODULES:
            extras.need("cluster", f"the engine {self.engine}", MODULES[self.engine])

    def threads_each(self) -> int:
        """Return the number of threads of a worker of this machine."""
        return self.threads or max(1, cores() // (self.workers or 1))


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def gpus() -> list[str]:
    """Return the GPUs of this machine, or those in CUDA_VISIBLE_DEVICES, as this variable names them."""
    if (visible := os.environ.get("CUDA_VISIBLE_DEVICES")) is not None:
        return [word for word in visible.split(",") if word]
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60, check=True).stdout
    except (OSError, subprocess.SubprocessError):
        return []
    return [str(i) for i, _ in enumerate(line for line in listed.splitlines() if line.startswith("GPU "))]

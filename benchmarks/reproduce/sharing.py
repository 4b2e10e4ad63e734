"""A run as it was asked for, which any process can make the same plan of; and its jobs done by several workers."""

import contextlib
import os
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import mitsuba as mi

from mi_ntf import jobs as engines
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render import register, user_cache

from . import compared, lights
from .compared import METHODS, TABLES, Scene, Sizes
from .images import Studio
from .jobs import Job, Plan


@dataclass(frozen=True)
class Request:
    """Arguments of :func:`benchmarks.reproduce.reproduce`. `variant`: Mitsuba's."""

    out: Path
    sizes: Sizes
    quick: bool = False
    scenes: tuple[str, ...] = ()
    environments: Path | None = None
    tables: tuple[str, ...] = ()
    methods: tuple[str, ...] = ()
    variant: str = ""

    def plan(self) -> Plan:
        """Return the plan of all jobs. Raises MiNtfError for bad names and files that are missing."""
        names = compared.chosen("table", self.tables, TABLES), compared.chosen("method", self.methods, METHODS)
        found = compared.scenes(self.scenes)
        if self.variant or mi.variant() is None:
            mi.set_variant(self.variant or "llvm_ad_rgb")
        register()
        fewer = self.sizes.skies if self.quick or self.environments is None else 0
        skies = lights.environments(fewer, self.environments)
        return Plan(self.out, self.sizes, found, {s.name: _points(s, self.sizes) + skies for s in found}, *names)

    def elsewhere(self) -> "Request":
        """The same for processes with another working folder."""
        folders = tuple(str(scene.folder.resolve()) for scene in compared.scenes(self.scenes))
        environments = self.environments and self.environments.absolute()
        return replace(self, out=self.out.absolute(), scenes=folders, environments=environments,
                       variant=str(mi.variant()))


def _points(scene: Scene, sizes: Sizes) -> list[lights.Light]:
    studio = Studio(scene, sizes)
    return lights.point_lights(sizes.points, studio.centre, studio.radius, studio.eye)


@dataclass(frozen=True)
class Task:
    """A job by its name; `about`: what its result is decided by."""

    request: Request
    name: str
    about: str


_plans: list[tuple[Request, dict[str, Job]]] = []
"""The plan of this process, kept from job to job, with meshes, fields and kernels."""


def perform(task: Task) -> dict[str, Any]:
    """The row of a job, in any process. Raises what the job raises."""
    if not _plans or _plans[0][0] != task.request:
        _plans[:] = [(task.request, {job.name: job for job in task.request.plan().jobs})]
    job = _plans[0][1].get(task.name)
    if job is None or job.about != task.about:
        _plans.clear()
        raise MiNtfError(f"{platform.node()} has other scenes, fields or another version of mi_ntf than the machine "
                         "that began this run; give all the same")
    with user_cache.switched("off"):
        return timed(job) | {"shared": True}


def timed(job: Job) -> dict[str, Any]:
    """The row of a job that does not fail. Raises what it raises."""
    start = time.perf_counter()
    row = {"job": job.name, "about": job.about, **job.tags, **job.run()}
    return row | {"wall_seconds": round(time.perf_counter() - start, 3), "load": round(os.getloadavg()[0], 2)}


def work(jobs: list[Job], request: Request, workers: engines.Workers, keep: Callable[[dict], None]) -> set[str]:
    """Do `jobs`, none of which is done and each after those that it needs, and `keep` their rows; names of those that
    failed or need one that did."""
    number = {job.name: k for k, job in enumerate(jobs)}
    there = request.elsewhere()
    tasks = [Task(there, job.name, job.about) for job in jobs]
    needs = [{number[name] for name in job.needs if name in number} for job in jobs]
    failed: set[str] = set()
    ends = engines.each(perform, tasks, workers, title="jobs", names=list(number), needs=needs, folder=request.out)
    with contextlib.closing(ends):  # at Ctrl-C, too
        for done in ends:
            job = jobs[done.index]
            if done.error:
                if not failed & set(job.needs):
                    keep({"job": job.name, "about": job.about, **job.tags, "error": done.error})
                failed.add(job.name)
            else:
                keep(done.value)
    return failed

"""``mi-ntf reproduce``: the paper's tables and figures on our scenes, every number beside the paper's.

    OUT/jobs.jsonl      what is finished, a line a job: run the same command again and it goes on there
    OUT/references      path-traced meshes
    OUT/networks        photographs, and the fields with networks of AG, No AG and NeRV
    OUT/report.html, OUT/tables.tex

A job that fails is a line that says why; those that need it wait, and the next run tries it again.
"""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from mi_ntf.core import errors
from mi_ntf.jobs import Workers
from mi_ntf.render import user_cache

from .. import bench
from . import sharing
from .compared import FULL, QUICK, Sizes
from .jobs import Job
from .report import Report
from .sharing import Request, timed
from .state import State


def reproduce(out: Path, quick: bool = False, scenes: Sequence[str] = (), environments: Path | None = None,
              tables: Sequence[str] = (), methods: Sequence[str] = (), sizes: Sizes | None = None,
              workers: Workers = Workers()) -> dict:  # noqa: B008
    """Do what is not done yet, and write the report of all that is; its figures, JSON.

    Args:
        out: folder of the run; made if need be.
        quick: small sizes, see :data:`.compared.QUICK`.
        scenes: names of folders of scenes/, or folders with mesh.xml and field.safetensors; none: the shipped three.
        environments: folder of latitude-longitude maps in place of the 18 made from the shipped one.
        tables: names of :data:`.compared.TABLES`; none: all.
        methods: names of :data:`.compared.METHODS`; none: all.
        sizes: in place of those of full size or `quick`.
        workers: who does the jobs; what measures times is done here, after the rest.

    Ends at Ctrl-C with a report of what is there. Raises MiNtfError for bad names, files that are missing, and a folder
    that another run is at work in.
    """
    out = Path(out)
    workers.check()
    request = Request(out, sizes or (QUICK if quick else FULL), quick, tuple(scenes), environments, tuple(tables),
                      tuple(methods))
    plan = request.plan()
    with State(out) as state, user_cache.switched("off"):
        interrupted, failed = None, set()
        try:
            failed = _work(plan.jobs, state) if workers.here else _shared(plan.jobs, state, request, workers)
        except KeyboardInterrupt as error:
            interrupted = error
        done = {j.name: state.rows[j.name] for j in plan.jobs if _done(j, state)}
        bad = {j.name: row["error"] for j in plan.jobs if "error" in (row := state.rows.get(j.name, {}))}
        report = Report(plan, done, quick)
        paths = report.write(bad, bench.machine())
        if interrupted is not None:
            raise interrupted
    shown = {name: [vars(t) for t in found] for name, found in report.tables().items()}
    return {"report": str(paths[0]), "latex": str(paths[1]), "jobs": len(plan.jobs), "done": len(done),
            "failed": bad, "waiting": sorted(failed - bad.keys()), "drops": report.accuracy.summary(report.methods),
            "tables": shown}


def _done(job: Job, state: State) -> bool:
    return state.done(job.name, job.about) and (job.makes is None or job.makes.exists())


def _work(jobs: list[Job], state: State, before: Collection[str] = ()) -> set[str]:
    """Do the jobs that are not done; names of those that are not, since they or what they need failed. `before`: names
    of others that failed."""
    failed = set(before)
    console = Console(stderr=True)
    with Progress(TextColumn("{task.description:40}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
                  TextColumn("left"), TimeRemainingColumn(), console=console) as progress:
        task = progress.add_task("", total=len(jobs))
        for job in jobs:
            progress.update(task, description=job.name)
            if failed & set(job.needs):
                failed.add(job.name)
            elif not _done(job, state):
                row = do(job)
                state.add(row)
                if "error" in row:
                    failed.add(job.name)
                    progress.console.print(f"{job.name}: {row['error']}", markup=False, soft_wrap=True)
            progress.advance(task)
    return failed


def do(job: Job) -> dict[str, Any]:
    """The row of a job, whatever becomes of it."""
    try:
        return timed(job)
    except Exception as error:
        if errors.debug():
            raise
        return {"job": job.name, "about": job.about, **job.tags, "error": errors.sentence(error)}


def _shared(jobs: list[Job], state: State, request: Request, workers: Workers) -> set[str]:
    """The same by `workers`; jobs that measure times are done here when the others are over."""
    left = [job for job in jobs if not _done(job, state)]
    failed = sharing.work([job for job in left if not job.alone], request, workers, state.add)
    alone = [job for job in left if job.alone]
    return failed | _work(alone, state, failed) if alone else failed


def print_table(found: dict) -> None:
    """The result of :func:`reproduce` for a reader."""
    for kind, methods in found["drops"].items():
        for method, drops in methods.items():
            ssim, rmse = drops["ssim"], drops["rmse"]
            theirs = "" if ssim["paper"] is None else f" [{ssim['paper']:+.3f}, {rmse['paper']:+.1%}]"
            if ssim["ours"] is not None:
                print(f"{kind:<12} {method:<9} drop of SSIM {ssim['ours']:+.4f}, of rMSE {rmse['ours']:+.1%}{theirs}")
    print(f"{found['done']} of {found['jobs']} jobs done"
          + (f", {len(found['failed'])} failed, {len(found['waiting'])} wait for them" if found["failed"] else ""))
    print(found["report"])
    print(found["latex"])

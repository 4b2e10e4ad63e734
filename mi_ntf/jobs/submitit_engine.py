"""Slurm by way of submitit: an array of as many jobs as there are workers, each with its share of the tasks. Where
there is no Slurm the jobs are subprocesses."""

import contextlib
import os
import shutil
import sys
import time
import uuid
from collections import deque
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import submitit

from ..core import files
from .options import Workers, gpus
from .worker import Answer, Setup, do_share, read_answers

MINUTES = 24 * 60
"""Of a job; SBATCH_TIMELIMIT overrides it, as other variables of sbatch do the rest."""
WAIT = {"local": 0.05, "slurm": 2.0}
"""Seconds between looks at what the jobs have written; `LOOKS` files a second at most."""
LOOKS = 100
CHECK = 60.0
"""Seconds between questions to Slurm whether jobs are lost."""


class Submitit:
    """Tasks are handed out when :meth:`answer` is called: all that wait, to as many jobs as may be begun. A job that is
    lost costs the task that it was at; the rest of its share goes to another job."""

    def __init__(self, workers: Workers, work: bytes, folder: Path):
        self._work, self._count = work, workers.workers or 1
        self._folder = Path(folder).absolute() / f"submitit-{uuid.uuid4().hex[:8]}"
        files.make_folder(self._folder)
        # Tasks, results and answers lie there as pickles: whoever writes them runs programs as this user.
        self._folder.chmod(0o700)
        self._executor = submitit.AutoExecutor(self._folder)
        self._kind = self._executor.cluster
        slurm = self._kind == "slurm"
        self._executor.update_parameters(
            timeout_min=MINUTES, name="mi-ntf",
            **({"slurm_array_parallelism": self._count, "slurm_cpus_per_task": workers.threads or 1} if slurm else {}))
        self._gpus = [] if slurm else gpus()
        self._threads = workers.threads or 1 if slurm else workers.share()
        self._waiting: deque[tuple[int, Any]] = deque()
        self._answers: deque[Answer] = deque()
        self._jobs: list[_Job] = []
        self._begun, self._checked, self._failed = 0, time.monotonic(), False
        self.about = f"jobs of {self._kind}, files in {self._folder}"

    def submit(self, index: int, task: Any, avoid: str = "") -> None:
        """Keep it for the next job."""
        self._waiting.append((index, task))

    def answer(self) -> Answer:
        """The next one."""
        while not self._answers:
            self._begin()
            self._look()
            if not self._answers:
                time.sleep(max(WAIT.get(self._kind, 2.0), len(self._jobs) / LOOKS if self._kind == "slurm" else 0.0))
        found = self._answers.popleft()
        self._failed |= bool(found.error)
        return found

    def close(self) -> None:
        """Cancel the jobs; their files stay where something failed or was not waited for."""
        whole = not (any(job.share for job in self._jobs) or self._waiting or self._answers or self._failed)
        for job in self._jobs:
            with contextlib.suppress(Exception):
                if job.share:
                    job.job.cancel(check=False)
                job.job.wait()
        if whole:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _begin(self) -> None:
        """New jobs, in one array, for what waits."""
        tasks = list(self._waiting)
        count = min(self._count - len(self._jobs), len(tasks))
        if count < 1:
            return
        self._waiting.clear()
        shares = [tasks[k::count] for k in range(count)]
        setups, paths = [], []
        for _ in shares:
            gpu = self._gpus[self._begun % len(self._gpus)] if self._gpus else None
            setups.append(Setup(self._threads, gpu))
            paths.append(str(self._folder / f"answers-{self._begun}"))
            self._begun += 1
        with _quiet() if self._kind == "local" else contextlib.nullcontext():
            jobs = self._executor.map_array(do_share, setups, [self._work] * count, shares, paths)
        self._jobs += [_Job(job, dict(share), path) for job, share, path in zip(jobs, shares, paths, strict=True)]

    def _look(self) -> None:
        """Take in what the jobs have written, and find those that ended."""
        force = time.monotonic() - self._checked > CHECK
        if force:
            self._checked = time.monotonic()
        for number, job in enumerate(list(self._jobs)):
            over = job.job.done(force_check=force and number == 0)  # one question to Slurm is about all jobs
            self._answers += job.read()
            if over:
                self._jobs.remove(job)
                if job.share:
                    self._answers.append(job.lost())
                    self._waiting += job.share.items()


class _Job:
    """A job with the tasks of its `share` that are not answered, by index."""

    def __init__(self, job: Any, share: dict[int, Any], path: str):
        self.job, self.share, self._path, self._offset = job, share, path, 0

    def read(self) -> list[Answer]:
        """New answers."""
        found, self._offset = read_answers(self._path, self._offset)
        for answer in found:
            self.share.pop(answer.index, None)
        return found

    def lost(self) -> Answer:
        """Return the error of the task that the job was working on when it ended."""
        index = next(iter(self.share))
        del self.share[index]
        said = ""
        with contextlib.suppress(Exception):
            said = [line for line in (self.job.stderr() or "").splitlines() if line.strip()][-1]
        how = f"({said})" if said else "without a word; had it enough memory and time?"
        return Answer(index, error=f"job {self.job.job_id} ended while it worked on it {how}", lost=True)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Within, processes are started without an stderr: submitit's own beside each job would write Python's frames there
    when it is interrupted. The jobs write into their files."""
    sys.stderr.flush()
    before, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nothing)

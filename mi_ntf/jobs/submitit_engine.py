"""Slurm by way of submitit: an array with one job for each worker. Without Slurm the jobs are subprocesses."""

import contextlib
import os
import shutil
import sys
import time
import uuid
from collections import deque
from collections.abc import Iterator
from pathlib import Path

import submitit

from ..core import files
from .options import Workers, gpus
from .worker import Answer, Setup, do_tasks, read_answers

MINUTES = 24 * 60  # limit of a job; the variables of sbatch, such as SBATCH_TIMELIMIT, override the settings below
WAIT = 0.05, 2.0  # seconds between looks at the files of subprocesses and of Slurm's jobs
LOOKS = 100  # files of Slurm's jobs that are read in a second, at most
CHECK = 60.0  # seconds between questions to Slurm whether jobs are lost


class Submitit:
    """Array of jobs, among which all waiting tasks are divided when :meth:`answer` is called.

    A job that is lost costs the task on which it worked; its other tasks go to another job.
    """

    def __init__(self, workers: Workers, work: bytes, folder: Path):
        self._work, self._count = work, workers.workers or 1
        self._folder = Path(folder).absolute() / f"submitit-{uuid.uuid4().hex[:8]}"
        files.make_folder(self._folder)
        # Tasks, results and answers lie there as pickles: whoever writes them runs programs as this user.
        self._folder.chmod(0o700)
        self._executor = submitit.AutoExecutor(self._folder)
        self._slurm = self._executor.cluster == "slurm"
        self._executor.update_parameters(timeout_min=MINUTES, name="mi-ntf")
        if self._slurm:
            self._executor.update_parameters(slurm_array_parallelism=self._count,
                                             slurm_cpus_per_task=workers.threads or 1)
        self._gpus = [] if self._slurm else gpus()
        self._threads = workers.threads or 1 if self._slurm else workers.threads_each()
        self._waiting: deque[tuple[int, object]] = deque()
        self._answers: deque[Answer] = deque()
        self._jobs: list[_Job] = []
        self._started, self._checked, self._failed = 0, time.monotonic(), False
        self.about = f"jobs of {self._executor.cluster}, files in {self._folder}"

    def submit(self, index: int, task: object, avoid: str = "") -> None:
        """Queue a task for the next job."""
        self._waiting.append((index, task))

    def answer(self) -> Answer:
        """Start jobs for the queued tasks and return the next answer."""
        while not self._answers:
            self._start()
            self._look()
            if not self._answers:
                time.sleep(max(WAIT[self._slurm], len(self._jobs) / LOOKS if self._slurm else 0.0))
        answer = self._answers.popleft()
        self._failed |= bool(answer.error)
        return answer

    def close(self) -> None:
        """Cancel the jobs; their files stay if something failed or is unfinished."""
        whole = not (any(job.tasks for job in self._jobs) or self._waiting or self._answers or self._failed)
        for job in self._jobs:
            with contextlib.suppress(Exception):
                if job.tasks:
                    job.job.cancel(check=False)
                job.job.wait()
        if whole:
            shutil.rmtree(self._folder, ignore_errors=True)

    def _start(self) -> None:
        """Start new jobs, in one array, for the queued tasks."""
        tasks = list(self._waiting)
        count = min(self._count - len(self._jobs), len(tasks))
        if count < 1:
            return
        self._waiting.clear()
        numbers = range(self._started, self._started + count)
        self._started += count
        parts = [tasks[k::count] for k in range(count)]
        setups = [Setup(self._threads, self._gpus[n % len(self._gpus)] if self._gpus else None) for n in numbers]
        paths = [str(self._folder / f"answers-{n}") for n in numbers]
        with contextlib.nullcontext() if self._slurm else _quiet():
            jobs = self._executor.map_array(do_tasks, setups, [self._work] * count, parts, paths)
        self._jobs += [_Job(job, dict(part), path) for job, part, path in zip(jobs, parts, paths, strict=True)]

    def _look(self) -> None:
        """Read the answers of the jobs, and find the jobs that ended."""
        force = time.monotonic() - self._checked > CHECK
        if force:
            self._checked = time.monotonic()
        for number, job in enumerate(list(self._jobs)):
            over = job.job.done(force_check=force and number == 0)  # one question to Slurm is about all jobs
            self._answers += job.read()
            if over:
                self._jobs.remove(job)
                if job.tasks:
                    self._answers.append(job.lost())
                    self._waiting += job.tasks.items()


class _Job:
    """Job with its unanswered `tasks` by index."""

    def __init__(self, job: "submitit.Job[None]", tasks: dict[int, object], path: str):
        self.job, self.tasks, self._path, self._offset = job, tasks, path, 0

    def read(self) -> list[Answer]:
        """Return new answers."""
        answers, self._offset = read_answers(self._path, self._offset)
        for answer in answers:
            self.tasks.pop(answer.index, None)
        return answers

    def lost(self) -> Answer:
        """Return the error of the task on which the job worked when it ended."""
        index = next(iter(self.tasks))
        del self.tasks[index]
        line = ""
        with contextlib.suppress(Exception):
            line = [line for line in (self.job.stderr() or "").splitlines() if line.strip()][-1]
        reason = f"({line})" if line else "without a word; had it enough memory and time?"
        return Answer(index, error=f"job {self.job.job_id} ended while it worked on it {reason}", lost=True)


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Close stderr for the processes that are started in the block.

    A process of submitit beside each job would print tracebacks when it is interrupted. The jobs write into files.
    """
    sys.stderr.flush()
    before, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 2)
    try:
        yield
    finally:
        os.dup2(before, 2)
        os.close(before)
        os.close(nothing)

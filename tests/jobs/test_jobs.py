"""Engines: results equal those of a serial run, whatever fails or is killed; what cannot work is said in a sentence."""

import os
import sys
from pathlib import Path

import mitsuba as mi
import pytest
from helpers import chores
from helpers.variants import VARIANT

from mi_ntf import cli, jobs
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture
from mi_ntf.jobs import options, running, worker

SCENE = """<scene version="3.9.0">
    <integrator type="path"/>
    <shape type="sphere"><bsdf type="diffuse"><rgb name="reflectance" value="0.8, 0.4, 0.2"/></bsdf></shape>
    <shape type="cube"><transform name="to_world"><scale value="0.4"/><translate x="1.2"/></transform></shape>
    <shape type="cube"><transform name="to_world"><scale value="0.3"/><translate y="1.2"/></transform></shape>
</scene>"""


@pytest.fixture(autouse=True)
def found_by_jobs(monkeypatch):
    """Subprocesses of submitit look for modules as Python does, not as pytest does."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))


def pictures(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*.*")) if p.name != "capture.json"}


def test_a_capture_on_dask_with_a_killed_worker_is_the_serial_one_bit_for_bit(tmp_path, monkeypatch, capfd):
    mi.set_variant(VARIANT)
    (tmp_path / "scene.xml").write_text(SCENE)
    settings = {"views": 8, "size": 32, "test_views": 2, "spp": 16}
    capture.capture(tmp_path / "scene.xml", tmp_path / "serial", **settings)
    monkeypatch.setattr(capture, "photograph", chores.photograph)
    done = capture.capture(tmp_path / "scene.xml", tmp_path / "dask", **settings, workers=jobs.Workers("dask", 2))
    assert (tmp_path / "killed").exists()  # a worker was
    assert (done["rendered"], done["kept"]) == (14, 0)
    serial = pictures(tmp_path / "serial")
    assert len(serial) == 14 + 3 and pictures(tmp_path / "dask") == serial
    assert "Dask's dashboard: http://127.0.0.1:" in capfd.readouterr().err


@pytest.mark.parametrize("engine", ["local", "submitit"])
def test_failing_tasks_are_tried_again_and_told_after_the_others(engine, tmp_path):
    (tmp_path / "out").mkdir()
    tasks = [(tmp_path / "out", number) for number in range(12)]
    results, failed = {}, {}
    for done in jobs.each(chores.write, tasks, jobs.Workers(engine, 2), folder=tmp_path / "jobs"):
        (failed if done.error else results)[done.index] = done.error or done.value
    assert results == {number: number**2 for number in range(12) if number not in (3, 9)}
    assert failed[3] == "this is none of mine; give another"
    assert "ended" in failed[9] and "memory" in failed[9]
    attempts = {n: len(list((tmp_path / "out").glob(f"{n}-*"))) for n in range(12)}
    assert attempts == dict.fromkeys(range(12), 1) | {3: 3, 5: 2, 7: 2, 9: 3}  # the lost workers' other tasks: once
    assert engine == "local" or list((tmp_path / "jobs").glob("submitit-*/*.err"))  # kept, for something failed


def test_one_error_names_what_failed(tmp_path):
    with pytest.raises(MiNtfError, match=r"^1 of 4 views failed, the others are done: c: this is none of mine; give "
                                         r"another\. Run the same command again once that is mended$"):
        jobs.run(chores.write, [(tmp_path, n) for n in (1, 2, 3, 4)], title="views", names="abcd")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["1-0", "2-0", "3-0", "4-0"]  # in this process: tried once


def test_files_of_submitit_are_open_to_this_user_alone(tmp_path):
    """They are pickles, which run what they say."""
    list(jobs.each(chores.write, [(tmp_path, 3)], jobs.Workers("submitit", 1), folder=tmp_path / "jobs"))
    (folder_left,) = (tmp_path / "jobs").iterdir()  # since the task fails
    assert folder_left.stat().st_mode & 0o777 == 0o700


def test_submitit_leaves_nothing_where_all_went_well(tmp_path):
    assert jobs.run(chores.square, range(9), jobs.Workers("submitit", 2), folder=tmp_path) == \
        [n * n for n in range(9)]
    assert list(tmp_path.iterdir()) == []


def test_workers_are_processes_with_their_threads_and_a_gpu_each(monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "3,5")
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    results = jobs.run(chores.place, range(8), jobs.Workers("local", 2, threads=3))
    gpus = {pid: about.pop("CUDA_VISIBLE_DEVICES") for pid, about in results}
    assert sorted(gpus.values()) == ["3", "5"] and os.getpid() not in gpus
    assert all(about == {"OMP_NUM_THREADS": "3", "drjit": 3} for _, about in results)
    assert os.environ.get("OMP_NUM_THREADS") is None


def test_a_worker_of_one_thread_reads_exr_files():
    environment = Path(__file__).parents[2] / "scenes" / "common" / "env.exr"
    assert jobs.run(chores.read, [environment], jobs.Workers("local", 1, threads=1)) == [(32, 64, 3)]


def test_gpus_are_counted_without_loading_anything(monkeypatch, tmp_path):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert options.gpus() == []
    (tmp_path / "nvidia-smi").write_text("#!/bin/sh\necho 'GPU 0: A (UUID: x)'\necho '  MIG'\necho 'GPU 1: A'\n")
    (tmp_path / "nvidia-smi").chmod(0o755)
    assert options.gpus() == ["0", "1"]


def test_workers_that_all_end_are_not_tried_for_ever(monkeypatch):
    monkeypatch.setattr(running, "BARREN", 1)
    with pytest.raises(MiNtfError, match=r"3 workers ended one after the other without an answer, .*SIGKILL"):
        jobs.run(chores.die, range(1000), jobs.Workers("local", 1, threads=1))


def test_work_that_is_not_waited_for_ends(tmp_path):
    tasks = [tmp_path / "slow"]
    going = jobs.each(chores.sleep, [*tasks, "no path"], jobs.Workers("local", 2))
    assert "write_text" in next(going).error  # three attempts long, in which the other has begun
    pid = int(tasks[0].read_text())
    going.close()
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_what_cannot_be_sent_is_said():
    with pytest.raises(MiNtfError, match=r"test_what_cannot_be_sent_is_said\..*lambda.* cannot be sent to workers"):
        jobs.run(lambda task: task, [1], jobs.Workers("local", 2))
    with pytest.raises(MiNtfError, match=r"0: .*[Cc]an't (get local object|pickle)"):
        jobs.run(chores.unsendable, [1], jobs.Workers("local", 2))


def test_answers_are_read_as_far_as_they_are_whole(tmp_path):
    path = str(tmp_path / "answers")
    assert worker.read_answers(path, 0) == ([], 0)
    worker.do_tasks(worker.Setup(), worker.pickle.dumps(chores.square), [(7, 3), (8, 4)], path)
    whole = Path(path).read_bytes()
    both, end = worker.read_answers(path, 0)
    assert [(a.index, worker.pickle.loads(a.value)) for a in both] == [(7, 9), (8, 16)] and end == len(whole)
    Path(path).write_bytes(whole[:-3])  # the second is being written
    first, middle = worker.read_answers(path, 0)
    assert first == both[:1] and worker.read_answers(path, middle) == ([], middle)
    Path(path).write_bytes(whole)
    assert worker.read_answers(path, middle) == (both[1:], end)


@pytest.mark.parametrize(("chosen", "message"), [
    (jobs.Workers("slurm"), "engine is 'slurm', must be local, submitit or dask"),
    (jobs.Workers(workers=0), "workers is 0, must be 1 or more"),
    (jobs.Workers(threads=-1), "threads is -1, must be 1 or more"),
    (jobs.Workers("submitit"), "needs a number of workers; give --workers N$"),
    (jobs.Workers("dask"), "give --workers N, or --scheduler ADDRESS"),
    (jobs.Workers(scheduler="tcp://a:1"), "scheduler is 'tcp://a:1' with the engine local"),
    (jobs.Workers("dask", 2, scheduler="tcp://a:1"), "leave --workers out"),
])
def test_options_that_do_not_fit(chosen, message):
    with pytest.raises(MiNtfError, match=message):
        jobs.run(chores.square, [1], chosen)


def test_a_bad_engine_is_bad_usage(tmp_path, capsys):
    assert cli.main(["capture", "scene.xml", str(tmp_path / "out"), "--engine", "dask"]) == 2
    assert "the engine dask needs a number of workers" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("engine", "module"), [("dask", "distributed"), ("submitit", "submitit")])
def test_an_engine_that_is_absent_is_named_with_its_remedy(engine, module, monkeypatch):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MiNtfError, match=rf"the engine {engine} needs the extra `cluster` \({module} missing\): run"):
        jobs.run(chores.square, [1], jobs.Workers(engine, 2))


def test_a_scheduler_that_does_not_answer(monkeypatch):
    from mi_ntf.jobs import dask_engine

    monkeypatch.setattr(dask_engine, "PATIENCE", 0.5)
    with pytest.raises(MiNtfError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9"):
        jobs.run(chores.square, [1], jobs.Workers("dask", scheduler="tcp://127.0.0.1:9"))

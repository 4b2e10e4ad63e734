"""Frames by several processes."""

from dataclasses import replace

import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs import Workers, running
from mi_ntf.sequence import command
from mi_ntf.sequence.timeline import Frame


def test_frames_of_two_workers_are_those_of_one(scene, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = scene().relative_to(tmp_path)
    frames = [Frame(i, {}, {}, {"lamp": {"position": [3.0 - i, 3.0, 2.5]}}) for i in range(4)]
    command.run(command.tasks_of(path, tmp_path / "one", frames))
    two = command.tasks_of(path, "two", frames)
    summary = command.run(two, workers=Workers("local", 2))
    assert (summary.rendered, summary.existing, len(summary.each_of)) == (4, 0, 4)
    assert [p.name for p in sorted((tmp_path / "two").iterdir())] == [f"frame_000{i}.exr" for i in range(4)]
    for image in (tmp_path / "one").iterdir():
        assert (tmp_path / "two" / image.name).read_bytes() == image.read_bytes()
    assert command.check(two).done == 4
    assert command.run(two, workers=Workers("local", 2)).existing == 4


def test_a_failing_frame_is_reported_after_the_others(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(running, "ATTEMPTS", 1)
    tasks = command.tasks_of(scene(), tmp_path / "out", [Frame(i, {"visibility": "none"}) for i in range(3)])
    tasks[1] = replace(tasks[1], frame=Frame(1, {"visibility": "wrong"}))
    monkeypatch.setattr(command, "_fault", lambda task: command.image_file.Fault("missing", ""))
    with pytest.raises(MiNtfError, match=r"^1 of 3 images failed, the others are done: frame 1: .*wrong"):
        command.run(tasks, workers=Workers("local", 2))
    assert [p.name for p in sorted((tmp_path / "out").iterdir())] == ["frame_0000.exr", "frame_0002.exr"]

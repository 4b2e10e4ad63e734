"""Atomic writing: on errors, on full disks, after killed writers, with several writers at a time."""

import os
import platform
import resource
import subprocess
import sys
import threading

import pytest

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError


def names(folder):
    return sorted(p.name for p in folder.iterdir())


def test_content_is_written_in_order_and_replaces_the_old_file(tmp_path):
    path = tmp_path / "a[1] b.bin"
    path.write_text("before")
    files.write(path, "τ", b"\x00", memoryview(b"ab"))
    assert path.read_bytes() == "τ".encode() + b"\x00ab"
    assert names(tmp_path) == ["a[1] b.bin"]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("disk. full."), ValueError("x"),
                                   KeyboardInterrupt()], ids=lambda e: type(e).__name__)
def test_a_failed_block_leaves_the_old_file(tmp_path, error):
    """Errors of the system and of libraries become one that names the file; other errors pass."""
    path = tmp_path / "f"
    path.write_text("before")
    expected = MiNtfError if isinstance(error, OSError | RuntimeError) else type(error)
    with pytest.raises(expected) as caught, files.replacing(path) as temporary:
        temporary.write_text("half")
        assert temporary.parent == tmp_path
        raise error
    if expected is MiNtfError:
        reason = error.strerror if isinstance(error, OSError) else "disk. full"
        assert str(caught.value) == f"cannot write {path} ({reason}); free space there or choose another place"
    assert path.read_text() == "before" and names(tmp_path) == ["f"]


@pytest.mark.parametrize("room", [0, 1, 4095, 9999])
def test_a_disk_that_fills_up_midway(tmp_path, room):
    """The system refuses the first byte, one midway or the last."""
    path = tmp_path / "f"
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, hard))
    try:
        with pytest.raises(MiNtfError, match=r"cannot write .*f \(File too large\); free space"):
            files.write(path, bytes(10000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert names(tmp_path) == []


def test_places_that_cannot_be_written_to(tmp_path):
    (tmp_path / "file").write_text("")
    for call in (files.check, lambda path: files.write(path, "x")):
        with pytest.raises(MiNtfError, match=r"cannot make the folder .*/file \(File exists\); choose another"):
            call(tmp_path / "file" / "f")
        with pytest.raises(MiNtfError, match=r"cannot write \S+ \((it is a folder|Is a directory)\); "):
            call(tmp_path)
        with pytest.raises(MiNtfError, match=r"File name too long"):
            call(tmp_path / ("f" * 250))
    with pytest.raises(MiNtfError, match=r"cannot make the folder .*/file/a/b \(Not a directory\); choose another"):
        files.make_folder(tmp_path / "file" / "a" / "b")
    files.check(tmp_path / "good")
    assert names(tmp_path) == ["file"]


def test_missing_folders_are_made(tmp_path):
    files.check(tmp_path / "a" / "b" / "f")
    files.write(tmp_path / "c" / "d" / "f", "x")
    assert names(tmp_path / "a" / "b") == [] and names(tmp_path / "c" / "d") == ["f"]


def test_a_finished_file_is_replaced_only_on_request(tmp_path):
    path = tmp_path / "f.ply"
    path.write_text("finished")
    files.check(path, (".ply",), overwrite=True)
    with pytest.raises(MiNtfError, match=r"f\.ply exists; choose another name, or add --overwrite to replace it"):
        files.check(path, (".ply",), overwrite=False)
    assert path.read_text() == "finished"


def test_an_unknown_suffix_is_refused_before_anything_is_made(tmp_path):
    with pytest.raises(MiNtfError, match=r"f\.png: the name ends in '\.png', expected \.ply, \.obj or \.stl"):
        files.check(tmp_path / "no" / "f.png", (".ply", ".obj", ".stl"))
    with pytest.raises(MiNtfError, match=r"f: the name ends in '', expected \.exr$"):
        files.check(tmp_path / "f", (".exr",))
    assert names(tmp_path) == []


def test_only_files_of_killed_writers_are_removed(tmp_path):
    dead = subprocess.Popen([sys.executable, "-c", ""])
    dead.wait()
    mine, other = f"f.{platform.node()}-", "f.elsewhere-"
    others = {f"{mine}{os.getppid()}.part", f"{other}{dead.pid}.part", f"{mine}x.part", f"g{mine[1:]}{dead.pid}.part"}
    for name in others | {f"{mine}{dead.pid}.part", f"{mine}{'9' * 30}.part"}:
        (tmp_path / name).write_text("half")
    files.write(tmp_path / "f", "whole")
    assert set(names(tmp_path)) == others | {"f"}


def test_two_threads_write_one_file_at_a_time_each_its_own(tmp_path):
    path, both = tmp_path / "f", threading.Barrier(2, timeout=20)
    faults = []

    def write(letter):
        try:
            with files.replacing(path) as temporary:
                temporary.write_text(letter)
                both.wait()  # each has written, none has put its file in place
                assert temporary.read_text() == letter
        except Exception as error:
            faults.append(error)

    threads = [threading.Thread(target=write, args=(letter,)) for letter in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not faults
    assert path.read_text() in "ab" and names(tmp_path) == ["f"]


def test_a_reader_never_sees_half_a_file(tmp_path):
    """Two processes write ten times 1 MB of one letter each, while a third reads."""
    path = tmp_path / "f"
    program = ("import sys; from mi_ntf.core import files\n"
               "for _ in range(10): files.write(sys.argv[1], sys.argv[2] * 10**6)")
    files.write(path, "a" * 10**6)
    writers = [subprocess.Popen([sys.executable, "-c", program, str(path), letter]) for letter in "bc"]
    while any(w.poll() is None for w in writers):
        content = path.read_text()
        assert len(content) == 10**6 and content == content[0] * 10**6
        threading.Event().wait(0.001)
    assert [w.returncode for w in writers] == [0, 0]
    assert names(tmp_path) == ["f"] and path.read_text()[0] in "bc"

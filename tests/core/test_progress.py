"""Progress of long work: lines in a terminal and in a pipe, time that is left, and sentences after Ctrl-C."""

import hashlib
import io
import os
import re
import signal
import threading
import time

import pytest

from mi_ntf.core import interruption, progress
from mi_ntf.core.errors import MiNtfError


class Terminal(io.StringIO):
    """Text that a terminal of the width of pytest's would receive."""

    def isatty(self) -> bool:
        return True

    def fileno(self) -> int:
        return 1


def test_a_pipe_has_a_line_for_each_stage_and_those_that_stay(capsys):
    with progress.Stage("reading scene.xml"):
        pass
    with progress.Stage("photographs", 12, done=3) as stage:
        for _ in range(9):
            stage.advance()
            with progress.Stage("rendering", inner=True) as inner:
                inner.update(0.5)
        progress.say("the third is dark")
    with progress.Stage("rendering", inner=True):
        pass
    assert capsys.readouterr() == ("", "reading scene.xml\nphotographs: 3 of 12\nthe third is dark\n")


def test_a_pipe_has_a_line_every_so_often(capsys):
    with progress.Stage("waiting", interval=0.2):
        time.sleep(0.9)
    assert 2 <= len(capsys.readouterr().err.splitlines()) <= 5


def test_a_terminal_has_one_line_that_is_removed(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    monkeypatch.setattr(progress.os, "get_terminal_size", lambda _: os.terminal_size((40, 24)))
    with progress.Stage("frames", 4) as stage:
        stage.advance("the second, whose name is too long for a line")
        with progress.Stage("baking", inner=True) as inner:
            inner.update(0.25)
            time.sleep(2 * progress.BLINK)
        progress.say("a line that stays")
        time.sleep(2 * progress.BLINK)
    first, *others, last = terminal.getvalue().split("\r\x1b[2K")
    assert first == "frames: 0 of 4" and last == ""
    assert any(text.startswith("a line that stays\n…") for text in others)
    assert max(len(line) for text in others for line in text.split("\n")) == 39
    assert any(re.fullmatch("….*a line · baking: 25%", text) for text in others)


def test_under_json_nothing_is_shown_but_warnings(capsys):
    with progress.silent(), progress.Stage("photographs", 12) as stage:
        stage.advance()
        progress.say("a remark")
        progress.say("a warning", warning=True)
    with progress.silent(False), progress.Stage("pictures"):
        pass
    assert capsys.readouterr().err == "a warning\npictures\n"


def test_the_first_frame_which_compiles_does_not_count_for_the_time_that_is_left():
    """The first frame would make 116 frames of 10 ms seem to take 8 s and more after four of them."""
    with progress.Stage("frames", 120, shown=False) as stage:
        time.sleep(0.3)
        stage.advance()
        assert stage.left() is None
        for _ in range(3):
            time.sleep(0.01)
            stage.advance()
        assert 1.1 < stage.left() < 6


def test_the_first_frame_of_every_worker_compiles():
    with progress.Stage("frames", 100, done=40, warm=2, shown=False) as stage:
        for seconds in (0.3, 0.3, 0.01):
            assert stage.left() is None
            time.sleep(seconds)
            stage.advance()
        assert stage.left() < 4


def test_a_budget_is_the_time_that_is_left():
    with progress.Stage("study", seconds=60, shown=False) as stage:
        assert 59 < stage.left() <= 60
        stage.update(0.9, "the last one")
        assert 59 < stage.left() <= 60


def test_a_fraction_gives_the_time_that_is_left():
    with progress.Stage("baking", shown=False) as stage:
        stage.update(0.1)
        time.sleep(0.2)
        stage.update(0.5)
        assert 0.2 < stage.left() < 1 and stage.line() == "baking: 50%"


@pytest.mark.parametrize(("stage", "sentence"), [
    (progress.Stage("photographs", 120, done=12, then="the same command goes on"),
     "stopped after 12 of 120 photographs; the same command goes on"),
    (progress.Stage("reading scene.xml"), "stopped while reading scene.xml; nothing was written"),
])
@pytest.mark.parametrize("disguise", [KeyboardInterrupt, RuntimeError], ids=["plain", "as Mitsuba's error"])
def test_ctrl_c_says_what_is_there_and_how_to_go_on(stage, sentence, disguise):
    with pytest.raises(KeyboardInterrupt, match=f"^{re.escape(sentence)}$"), interruption.noticed(), stage:
        try:
            signal.raise_signal(signal.SIGINT)
        except KeyboardInterrupt as error:
            if disguise is RuntimeError:
                raise RuntimeError("error while performing a custom operation (see above)") from error
            raise


def test_a_sentence_that_knows_better_stays():
    with pytest.raises(KeyboardInterrupt, match=r"^stopped at step 3$"), progress.Stage("training"):
        with progress.Stage("validating", inner=True):
            raise KeyboardInterrupt("stopped at step 3")


def test_other_errors_stay():
    with pytest.raises(MiNtfError, match="no scene"), interruption.noticed(), progress.Stage("reading scene.xml"):
        raise MiNtfError("no scene")


def test_ctrl_c_is_seen_in_a_thread_for_which_the_main_one_waits():
    """Mitsuba reads the media of a scene in other threads, while the main one is in C++ and cannot call a handler."""
    seen = []

    def bake() -> None:
        try:
            with progress.Stage("baking", shown=False) as stage:
                time.sleep(0.1)
                os.kill(os.getpid(), signal.SIGINT)
                while True:
                    stage.update(0.5)
        except KeyboardInterrupt as error:
            seen.append(str(error))

    with pytest.raises(KeyboardInterrupt), interruption.noticed():
        threading.Thread(target=bake).start()
        hashlib.pbkdf2_hmac("sha256", b"a second in C", b"", 2_000_000)
    assert seen == ["stopped while baking; nothing was written"]


def test_a_stage_that_gives_way_is_shown_until_the_next_one(capsys):
    with progress.Stage("starting", gives_way=True) as start:
        with progress.Stage("baking", inner=True):  # no work that it could be a part of
            assert start.visible
        with progress.Stage("reading") as reading:
            assert reading.line() == "reading" and not start.visible
        with pytest.raises(KeyboardInterrupt, match=r"^stopped while starting; nothing was written$"), \
                progress.Stage("starting", gives_way=True):
            raise KeyboardInterrupt
    assert capsys.readouterr().err == "starting\nreading\nstarting\n"


def test_ctrl_c_has_no_sentence_of_a_stage_that_gave_way():
    with pytest.raises(KeyboardInterrupt, match=r"^$"), progress.Stage("starting", gives_way=True):
        progress.give_way()
        raise KeyboardInterrupt

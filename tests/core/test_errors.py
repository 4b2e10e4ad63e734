"""Text of errors for users: one sentence, whatever wrapped the error."""

import pytest

from mi_ntf.core.errors import MiNtfError, root, sentence

FRAMES = """Traceback (most recent call last):
  File "a.py", line 7, in b
    x = y
        ^
  File "c.py", line 1, in d
"""
HINT = " (MI_NTF_DEBUG=1 shows where)"


def wrapped(first: Exception, text="dr.while_loop(): encountered an exception (see above)."):
    error = RuntimeError(text)
    error.__cause__ = first
    return error


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (MiNtfError("scale is 0"), "scale is 0"),
        (RuntimeError("no such plugin"), "no such plugin"),
        (OSError(28, "No space left"), "[Errno 28] No space left"),
        (RuntimeError(f"At s.xml: failed: {FRAMES}MiNtfError: scale is 0"), "At s.xml: failed: scale is 0"),
        (RuntimeError(f"At s.xml: failed: {FRAMES}KeyError: 'a'"), f"At s.xml: failed: KeyError: 'a'{HINT}"),
        (wrapped(wrapped(MiNtfError("scale is 0"))), "scale is 0"),
        (wrapped(KeyError("a")), f"KeyError: 'a'{HINT}"),
        (wrapped(RuntimeError("not permitted.\n\nForty lines\nof reasons")), f"not permitted.{HINT}"),
        (MemoryError(), f"MemoryError:{HINT}"),
    ],
)  # fmt: skip
def test_one_sentence(error, text):
    assert sentence(error) == text


def test_a_fault_that_names_its_cause_is_shown_itself():
    error = MiNtfError("a.exr: cannot be read")
    error.__cause__ = OSError("bad magic")
    assert root(wrapped(error)) is error

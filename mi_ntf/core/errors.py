"""The exception type for faults of the input, and the text that a user sees of any error."""

import os
import re

_FRAMES = re.compile(r"Traceback \(most recent call last\):\n(?:  .*\n)*(?P<ours>MiNtfError: )?")
"""Begin of the text that nanobind gives to a Python exception that has gone through C++."""


class MiNtfError(ValueError):
    """A fault of the input. The text names the object, its value and the remedy."""


def debug() -> bool:
    """Return True if the user wants to see Python's frames: the environment variable ``MI_NTF_DEBUG`` is 1."""
    return os.environ.get("MI_NTF_DEBUG") == "1"


def root(error: BaseException) -> BaseException:
    """Return the error that was raised first: Dr.Jit and `mi.render` wrap errors in their own."""
    while error.__cause__ is not None and not isinstance(error, MiNtfError):
        error = error.__cause__
    return error


def sentence(error: BaseException) -> str:
    """Return the text of `error` without frames; for a likely defect of the program it names the switch for frames."""
    first = root(error)
    text = str(first)
    frames = _FRAMES.search(text)
    if frames is not None:
        known, text = frames["ours"] is not None, _FRAMES.sub("", text)
    else:  # Mitsuba's own errors are RuntimeErrors
        known = isinstance(first, MiNtfError | OSError | ImportError | RuntimeError)
        text = text if known else f"{type(first).__name__}: {text}"
    text, _, more = text.strip().partition("\n\n")  # Dr.Jit appends a long explanation for programmers
    return text if known and not more else f"{text} (MI_NTF_DEBUG=1 shows where)"


def shown(value: object) -> str:
    """Return `value` for a message, at most 80 characters: values from files may be of any length."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."

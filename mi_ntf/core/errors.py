"""The one exception type for faults that a user can mend, and how any error is told to a user."""

import os
import re

_FRAMES = re.compile(r"Traceback \(most recent call last\):\n(?:  .*\n)*(?P<ours>MiNtfError: )?")
"""How nanobind begins the text of a Python exception that has gone through C++."""


class MiNtfError(ValueError):
    """A fault of the input. The text names the thing, the value that was seen and the remedy."""


def debug() -> bool:
    """Whether the user wants to see Python's frames: the environment variable ``MI_NTF_DEBUG`` is 1."""
    return os.environ.get("MI_NTF_DEBUG") == "1"


def root(error: BaseException) -> BaseException:
    """What was raised first: Dr.Jit wraps an error inside of a loop, and `mi.render` any, in errors of their own."""
    while error.__cause__ is not None and not isinstance(error, MiNtfError):
        error = error.__cause__
    return error


def sentence(error: BaseException) -> str:
    """What `error` says, without frames. What looks like a defect of the program ends in a hint at the switch."""
    first = root(error)
    text = str(first)
    frames = _FRAMES.search(text)
    if frames is not None:
        known, text = frames["ours"] is not None, _FRAMES.sub("", text)
    else:  # Mitsuba's own errors are RuntimeErrors
        known = isinstance(first, MiNtfError | OSError | ImportError | RuntimeError)
        text = text if known else f"{type(first).__name__}: {text}"
    text, _, more = text.strip().partition("\n\n")  # Dr.Jit explains at length what only its callers can mend
    return text if known and not more else f"{text} (MI_NTF_DEBUG=1 shows where)"


def shown(value: object) -> str:
    """`value` for a message: what comes from a file may be of any length."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."

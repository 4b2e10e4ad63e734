"""Errors of the plugins as users of ``mitsuba.render`` see them."""

import functools
from typing import Any

import mitsuba as mi

from ...core.errors import MiNtfError, root


def show() -> None:
    """Let ``mitsuba.render`` raise the plugins' errors, and interrupts by the user, themselves.

    It renders within ``drjit.custom``, which answers anything that Python raises with a RuntimeError of one fixed text
    and leaves the error as its cause. No integrator gets a word past that, so the function is wrapped, once; all else
    that it returns or raises stays.
    """
    render: Any = mi.render
    if not hasattr(render, "__wrapped__"):
        vars(mi)["render"] = _showing(render)


def _showing(render):
    @functools.wraps(render)
    def shown(*args, **kwargs):
        try:
            return render(*args, **kwargs)
        except RuntimeError as error:
            first = root(error)
            if isinstance(first, MiNtfError | KeyboardInterrupt):
                raise first from None
            raise

    return shown

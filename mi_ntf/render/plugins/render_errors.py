"""Errors of the plugins as users of ``mitsuba.render`` see them."""

import functools
from collections.abc import Callable
from typing import ParamSpec, TypeVar

import mitsuba as mi

from ...core.errors import MiNtfError, root

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")


def show() -> None:
    """Let ``mitsuba.render`` raise the plugins' own errors, and the user's interrupts.

    It renders within ``drjit.custom``, which replaces each error by a RuntimeError of a fixed text, whose cause is the
    error. The function is therefore wrapped, once. Other results and errors stay.
    """
    if not hasattr(mi.render, "__wrapped__"):
        vars(mi)["render"] = _showing(mi.render)


def _showing(render: Callable[Parameters, Result]) -> Callable[Parameters, Result]:
    @functools.wraps(render)
    def shown(*args: Parameters.args, **kwargs: Parameters.kwargs) -> Result:
        try:
            return render(*args, **kwargs)
        except RuntimeError as error:
            first = root(error)
            if isinstance(first, MiNtfError | KeyboardInterrupt):
                raise first from None
            raise

    return shown

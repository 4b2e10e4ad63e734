"""Traversal of scenes by this package, which need not see the parameters of fields that nobody has asked for."""

from __future__ import annotations

from contextvars import ContextVar

import mitsuba as mi

_quiet: ContextVar[bool] = ContextVar("quiet", default=False)


def traverse(node: mi.Object) -> mi.SceneParameters:
    """Return ``mi.traverse(node)``, without parameters of fields unless an earlier ``mi.traverse`` has shown them."""
    token = _quiet.set(True)
    try:
        return mi.traverse(node)
    finally:
        _quiet.reset(token)


def is_quiet() -> bool:
    """Return True within :func:`traverse`."""
    return _quiet.get()

"""Voxels that tests share: a field is baked once in a process, whatever file of whatever test it lies in."""

import sys
from collections.abc import Callable

import numpy as np

LARGEST = 512 << 20
"""Bytes of the voxels in memory; beyond them the ones that were made first are freed."""
_kept: dict[str, dict[str, np.ndarray]] = {}


def share() -> None:
    """Let loads of fields find the voxels that an earlier test baked, once the renderer is imported.

    A test that sets ``MI_NTF_CACHE`` to ``on`` or ``memory``, or replaces ``loaded.bake``, has the package's own cache.
    """
    loaded = sys.modules.get("mi_ntf.render.scene.loaded")
    if loaded is None or hasattr(loaded.user_cache.cached, "shared"):
        return
    user_cache, bake = loaded.user_cache, loaded.bake
    plain = user_cache.cached

    def cached(kind: str, name: str, make: Callable[[], dict[str, np.ndarray]], placed: bool = False
               ) -> dict[str, np.ndarray]:
        if kind != "fields" or user_cache.mode() != "off" or loaded.bake is not bake:
            return plain(kind, name, make, placed)
        if name not in _kept:
            arrays = make()
            for values in arrays.values():
                values.flags.writeable = False
            _kept[name] = arrays
            while len(_kept) > 1 and sum(v.nbytes for each in _kept.values() for v in each.values()) > LARGEST:
                del _kept[next(iter(_kept))]
        return dict(_kept[name])

    cached.shared = True
    user_cache.cached = cached

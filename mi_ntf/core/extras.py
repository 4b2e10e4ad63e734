"""Optional packages, which the extras of ``pip install 'mi-ntf[EXTRA]'`` bring."""

import importlib.util

from .errors import MiNtfError

EXTRAS = {
    "train": ("torch", "tensorboard", "matplotlib", "PIL", "cv2"),
    "video": ("imageio_ffmpeg",),
    "view": ("viser", "websockets", "PIL"),
    "eval": ("skimage", "flip_evaluator", "matplotlib", "PIL"),
    "mesh": ("skimage", "scipy", "trimesh"),
    "watch": ("tevclient",),
    "cluster": ("submitit", "distributed", "bokeh"),
}
"""Extras of this package and the modules that they bring."""


def missing(extra: str, *modules: str) -> list[str]:
    """Return those of `modules`, by default all of the extra, that are not installed; none of them is imported."""
    return [name for name in modules or EXTRAS[extra] if importlib.util.find_spec(name) is None]


def need(extra: str, purpose: str, *modules: str) -> None:
    """Raise MiNtfError if :func:`missing` finds any; to be called before the work, whose `purpose` begins the text."""
    if names := missing(extra, *modules):
        raise MiNtfError(f"{purpose} needs the extra `{extra}` ({', '.join(names)} missing): run pip install "
                         f"'mi-ntf[{extra}]'")

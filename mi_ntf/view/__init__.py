"""`mi-ntf view`: a scene in a browser, with lights that can be moved. It needs the extra ``view``."""

import importlib.util
import os
from pathlib import Path

from mi_ntf.core.errors import MiNtfError


def view(scene: Path, define: dict[str, str], size: int = 256, samples: int = 64, host: str = "127.0.0.1",
         port: int = 8080) -> None:
    """Serve `scene`, with values `define` of its $names, to browsers at `host`:`port` until Ctrl-C.

    Pictures have about `size`² pixels, and `samples` samples per pixel when nothing moves. Raises MiNtfError if the
    extra is missing, a number is out of range, or the scene cannot be rendered.
    """
    if importlib.util.find_spec("viser") is None:
        raise MiNtfError("a view needs the package viser; run pip install 'mi-ntf[view]'")
    for name, value, limit in (("size", size, 4096), ("samples", samples, 65536), ("port", port, 65535)):
        if not 1 <= value <= limit:
            raise MiNtfError(f"--{name} is {value}, expected 1 to {limit}")
    # A dragged light makes dozens of maps, which are not worth a file each.
    os.environ.setdefault("MI_NTF_CACHE", "memory")
    from .controls import Controls
    from .session import Session

    controls = Controls(Session(scene, define, size), host, port, samples)
    print(f"Open {controls.url} in a browser; Ctrl+C ends the view.", flush=True)
    controls.run()

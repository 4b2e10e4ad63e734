"""`mi-ntf view`: a scene in a browser, whose lights are moved by hand. Needs the extra ``view``."""

import importlib.util
import os
from pathlib import Path

from mi_ntf.core.errors import MiNtfError


def view(scene: Path, define: dict[str, str], size: int = 256, samples: int = 64, host: str = "127.0.0.1",
         port: int = 8080) -> None:
    """Serve `scene`, with `define` for its $names, to browsers at `host`:`port` until the user ends it.

    Pictures have about `size`² pixels, and `samples` a pixel at rest. Raises MiNtfError where the extra is missing or a
    number is out of range, and where rendering would.
    """
    if importlib.util.find_spec("viser") is None:
        raise MiNtfError("a view needs the package viser; run pip install 'mi-ntf[view]'")
    for name, value, most in (("size", size, 4096), ("samples", samples, 65536), ("port", port, 65535)):
        if not 1 <= value <= most:
            raise MiNtfError(f"--{name} is {value}, expected 1 to {most}")
    # A dragged light makes maps by the dozen: none is worth a file.
    os.environ.setdefault("MI_NTF_CACHE", "memory")
    from .controls import Controls
    from .session import Session

    controls = Controls(Session(scene, define, size), host, port, samples)
    print(f"Open {controls.url} in a browser; Ctrl+C ends the view.", flush=True)
    controls.run()

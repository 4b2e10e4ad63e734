"""`mi-ntf view`: a scene in a browser, with lights that can be moved. It needs the extra ``view``."""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from mi_ntf.core import extras, progress
from mi_ntf.core.errors import MiNtfError

if TYPE_CHECKING:
    from mi_ntf.render.scene.environment_option import Environment


def view(scene: Path, define: dict[str, str], size: int = 512, samples: int = 64, host: str = "127.0.0.1",
         port: int = 8080, environment: "Environment | None" = None) -> None:
    """Serve `scene`, with values `define` of its $names, to browsers at `host`:`port` until Ctrl-C.

    Pictures have the size of the window, but at most about `size`² pixels, and `samples` samples per pixel when nothing
    moves. `environment` has changes of the scene's environment. Raises MiNtfError if the extra is missing, a number is
    out of range, or the scene cannot be rendered.
    """
    extras.need("view", "a view")
    for name, value, limit in (("size", size, 4096), ("samples", samples, 65536), ("port", port, 65535)):
        if not 1 <= value <= limit:
            raise MiNtfError(f"--{name} is {value}, expected 1 to {limit}")
    # A dragged light makes dozens of maps, which are not worth a file each.
    os.environ.setdefault("MI_NTF_CACHE", "memory")
    from .controls import Controls
    from .session import Session

    with progress.Stage(f"reading {scene}"):
        session = Session(scene, define, size, environment)
    controls = Controls(session, host, port, samples)
    print(f"Open {controls.url} in a browser; Ctrl+C ends the view.", flush=True)
    controls.run()

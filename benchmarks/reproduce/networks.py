"""Networks of AG, No AG and NeRV: trained on each scene's field by the commands that users have, each in a process.

    networks/SCENE/photographs-VIEWS-PIXELS          `mi-ntf capture`
    networks/SCENE/NETWORK-NTF-STEPS.safetensors     `mi-ntf train --field … --ntf …`

Both go on where they were interrupted.
"""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError

from .compared import Scene, Sizes

OPTIONS = {"ag": ["--visibility-mlp"], "no_ag": ["--no-augmentation"]}
"""Network → options of its training. NeRV's is trained beside that of AG, on the same rays."""


@dataclass(frozen=True)
class Training:
    """One run. `steps`: those of the whole run, or of a stage of it, trained by itself with the schedule shortened."""

    scene: Scene
    network: str
    ntf: str
    steps: int
    whole: bool = True

    @property
    def job(self) -> str:
        return f"train/{self.scene.name}/{self.name}"

    @property
    def name(self) -> str:
        return f"{self.network}-{self.ntf}-{self.steps}"

    def file(self, out: Path) -> Path:
        """The field with this network."""
        return folder(self.scene, out) / f"{self.name}.safetensors"


def folder(scene: Scene, out: Path) -> Path:
    """Where all networks of a scene lie."""
    return out / "networks" / scene.name


def photographs(scene: Scene, out: Path, sizes: Sizes) -> Path:
    """The data set that its networks are trained on."""
    return folder(scene, out) / f"photographs-{sizes.views}-{sizes.photograph}"


def capture(scene: Scene, out: Path, sizes: Sizes) -> dict:
    """Photograph the meshes; the row of the job."""
    data = photographs(scene, out, sizes)
    files.make_folder(data.parent)
    _run("capture", scene.mesh, data, "--views", sizes.views, "--size", sizes.photograph, "--test-views", 4)
    return {"folder": str(data.relative_to(out))}


def train(training: Training, out: Path, sizes: Sizes) -> dict:
    """Train a network; the row of the job."""
    path = training.file(out)
    options = OPTIONS[training.network] if training.whole else []
    _run("train", photographs(training.scene, out, sizes), "-o", path, "--field", training.scene.field,
         "--ntf", training.ntf, "--steps", training.steps, *options)
    return {"file": str(path.relative_to(out))}


def _run(*words) -> None:
    """`mi-ntf WORDS` in a process of its own: PyTorch and Mitsuba stay apart. Raises MiNtfError."""
    command = [sys.executable, "-m", "mi_ntf", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
        raise MiNtfError(f"`mi-ntf {' '.join(map(str, words))}` failed with exit code {done.returncode}: "
                         f"{' '.join(last).removeprefix('mi-ntf: error: ')}")

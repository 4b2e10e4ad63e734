"""The first line of every long command: it comes before anything heavy is imported."""

import subprocess
import sys
from pathlib import Path

import pytest

PROGRAM = """
import sys
from mi_ntf import cli

class Heavy:
    NAMES = {"mitsuba", "drjit", "torch", "matplotlib", "scipy", "skimage", "cv2", "PIL", "viser", "OpenEXR"}

    def find_spec(self, name, path=None, target=None):
        if name in self.NAMES:
            raise SystemExit(f"{name} is imported")

sys.meta_path.insert(0, Heavy())
sys.exit(cli.main(sys.argv[1:]))
"""
"""The command line, which ends at the first import of a package that takes long to import."""
LINES = {
    "capture": "scene.xml photographs", "inspect": "photographs", "train": "photographs -o field.safetensors",
    "import": "grid.vol -o field.safetensors", "export": "field.safetensors -o mesh.ply",
    "render": "scene.xml", "view": "scene.xml", "sequence": "scene.xml -o frames", "bake": "scene.xml -o map.exr",
    "explain": "scene.xml", "compare": "a.exr b.exr", "tradeoff": "scene.xml", "bridge": ""}


@pytest.mark.parametrize("command", LINES)
def test_a_long_command_shows_a_line_before_anything_heavy_is_imported(command: str, tmp_path: Path):
    done = subprocess.run([sys.executable, "-c", PROGRAM, command, *LINES[command].split()], cwd=tmp_path,
                          stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    assert done.stdout.splitlines()[0] == f"starting {command}"

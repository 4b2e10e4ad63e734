"""Turn a scene of meshes into a field and render it: four commands with small settings.

    python examples/own_mesh.py [--out out/own_mesh] [--views 40] [--size 96] [--minutes 3 | --steps N]

`--scene` names a Mitsuba scene of meshes. By default a scene of two boxes is written. Takes 5 minutes on two cores.
"""

import subprocess
import sys
from pathlib import Path

import tyro

BOXES = """<scene version="3.9.0">
    <integrator type="path"/>
    <sensor type="perspective">
        <float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="3, 3, 6" target="0, 0.3, 0" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="96"/> <integer name="height" value="96"/>
            <string name="pixel_format" value="rgba"/>
        </film>
    </sensor>
    <emitter type="point"> <point name="position" x="2" y="5" z="3"/> <rgb name="intensity" value="60"/> </emitter>
    <shape type="cube"><bsdf type="diffuse"> <rgb name="reflectance" value="0.7, 0.3, 0.2"/> </bsdf></shape>
    <shape type="cube">
        <transform name="to_world"><scale value="0.4"/><translate y="1.4"/></transform>
        <bsdf type="diffuse"> <rgb name="reflectance" value="0.2, 0.4, 0.7"/> </bsdf>
    </shape>
</scene>
"""


def run(*words: object) -> None:
    """Run a `mi-ntf` command. If it fails, end this script with its exit code."""
    print("$ mi-ntf", *words, flush=True)
    code = subprocess.run([sys.executable, "-m", "mi_ntf", *map(str, words)], check=False).returncode
    if code:
        sys.exit(code)


def main(out: Path = Path("out/own_mesh"), scene: Path | None = None, views: int = 40, size: int = 96, spp: int = 32,
         minutes: float = 3.0, steps: int | None = None) -> None:
    """Capture photographs, train a field, put it into the scene, render."""
    out.mkdir(parents=True, exist_ok=True)
    if scene is None:
        scene = out / "mesh.xml"
        scene.write_text(BOXES)
    run("capture", scene, out / "photographs", "--views", views, "--size", size, "--test-views", 2, "--spp", spp)
    run("train", out / "photographs", "-o", out / "field.safetensors",
        *(("--minutes", minutes) if steps is None else ("--steps", steps)))
    run("swap", scene, out / "field.safetensors", "-o", out / "scene.xml")
    run("render", "-m", "llvm_ad_rgb", "-o", out / "relit.exr", out / "scene.xml")


if __name__ == "__main__":
    tyro.cli(main)

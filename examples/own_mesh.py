"""Turn an object on a floor into a field, and render it beside the meshes: six commands with small settings.

    python examples/own_mesh.py [--out out/own_mesh] [--views 40] [--size 96] [--minutes 3 | --steps N]

By default a scene of two boxes on a floor is written. `--scene` names another one, and `--shapes` what of it becomes
the field. It takes 5 minutes on two cores, and needs the extras `train` and `eval`.
"""

import subprocess
import sys
from pathlib import Path

import tyro

from mi_ntf.core import extras

BOXES = """<scene version="3.9.0">
    <integrator type="path"> <integer name="max_depth" value="3"/> </integrator>
    <sensor type="perspective" id="camera"><float name="fov" value="35"/>
        <transform name="to_world"><lookat origin="2, 4, 7" target="-0.4, 0.1, 0" up="0, 1, 0"/></transform>
        <sampler type="independent"> <integer name="sample_count" value="16"/> </sampler>
        <film type="hdrfilm"> <integer name="width" value="96"/> <integer name="height" value="96"/> </film></sensor>
    <emitter type="point" id="lamp">
        <point name="position" x="4" y="5" z="3"/> <rgb name="intensity" value="150"/> </emitter>
    <shape type="cube" id="box"><bsdf type="diffuse"> <rgb name="reflectance" value="0.7, 0.3, 0.2"/> </bsdf></shape>
    <shape type="cube" id="small_box"><transform name="to_world"><scale value="0.4"/><translate y="1.4"/></transform>
        <bsdf type="diffuse"> <rgb name="reflectance" value="0.2, 0.4, 0.7"/> </bsdf></shape>
    <shape type="rectangle" id="floor">
        <transform name="to_world"><rotate x="1" angle="-90"/><scale value="5"/><translate y="-1"/></transform></shape>
</scene>"""


def run(*words: object) -> None:
    """Run a `mi-ntf` command. If it fails, end this script with its exit code."""
    print("$ mi-ntf", *words, flush=True)
    if code := subprocess.run([sys.executable, "-m", "mi_ntf", *map(str, words)], check=False).returncode:
        sys.exit(code)


def main(out: Path = Path("out/own_mesh"), scene: Path | None = None, shapes: str = "not:floor", views: int = 40,
         size: int = 96, spp: int = 32, minutes: float = 3.0, steps: int | None = None) -> None:
    """Capture photographs, train a field, put it into the scene, render field and meshes, compare."""
    extras.need("train", "this example", "torch")
    out.mkdir(parents=True, exist_ok=True)
    if scene is None:
        scene = out / "mesh.xml"
        scene.write_text(BOXES)
    photos, field, relit = out / "photographs", out / "field.safetensors", out / "scene.xml"
    length = ("--minutes", minutes) if steps is None else ("--steps", steps)
    run("capture", scene, photos, "--shapes", shapes, "--views", views, "--size", size, "--test-views", 2, "--spp", spp)
    run("train", photos, "-o", field, *length, "--overwrite")
    run("swap", scene, field, "-o", relit, "--shapes", shapes, "--overwrite")
    for file, picture in ((relit, "relit.exr"), (scene, "mesh.exr")):
        run("render", "-m", "llvm_ad_rgb", "-o", out / picture, file)
    run("compare", out / "relit.exr", out / "mesh.exr", "-o", out / "compared.png")


if __name__ == "__main__":
    tyro.cli(main)

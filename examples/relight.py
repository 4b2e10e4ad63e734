"""Relight a field from Python: move a point light around it and save a PNG for each step.

    python examples/relight.py [--out out/relight] [--frames 8] [--size 256] [--spp 16]
"""

import math
from pathlib import Path

import mitsuba as mi
import tyro

mi.set_variant("llvm_ad_rgb")

import mi_ntf  # noqa: E402  (Mitsuba's types exist only after the variant is set)

mi_ntf.register()

SCENE = Path(__file__).parents[1] / "scenes" / "statue" / "scene.xml"


def main(out: Path = Path("out/relight"), frames: int = 8, size: int = 256, spp: int = 16,
         visibility: str = "transmittance_map", scene: Path = SCENE) -> None:
    """Render `frames` images while the light goes once around the vertical axis through the field's centre."""
    out.mkdir(parents=True, exist_ok=True)
    loaded = mi.load_file(str(scene), light="point", visibility=visibility, res=str(size), spp=str(spp))
    parameters = mi.traverse(loaded)
    key = next(k for k in parameters.keys() if k.endswith(".position"))
    start = mi.ScalarPoint3f(*(float(c[0]) for c in parameters[key]))
    centre = loaded.bbox().center()
    radius = math.hypot(start.x - centre.x, start.z - centre.z)
    first = math.atan2(start.z - centre.z, start.x - centre.x)
    for frame in range(frames):
        angle = first + 2 * math.pi * frame / frames
        parameters[key] = [centre.x + radius * math.cos(angle), start.y, centre.z + radius * math.sin(angle)]
        parameters.update()
        path = out / f"relight_{frame:03d}.png"
        mi.util.write_bitmap(str(path), mi.render(loaded), write_async=False)
        print(path, flush=True)


if __name__ == "__main__":
    tyro.cli(main)

"""Render three fields with a floor, a metal ball, a lamp and a sky, which shade and light each other.

    python examples/three_fields.py [--out out/three_fields.png] [--size 320] [--spp 64] [--max-depth 4]
"""

from pathlib import Path

import mitsuba as mi
import tyro

mi.set_variant("llvm_ad_rgb")

import mi_ntf  # noqa: E402  (Mitsuba's types exist only after the variant is set)
from mi_ntf.core import field_file  # noqa: E402

mi_ntf.register()

SCENES = Path(__file__).parents[1] / "scenes"
PLACE = mi.ScalarTransform4f


def field(name: str, to_world, scale: float = 1.0) -> dict:
    """Return a shipped field inside its bounding sphere. Shape and medium have the same transform."""
    path = SCENES / name / "field.safetensors"
    captured = field_file.load_header(path).similarity
    ball = to_world @ PLACE().scale(scale).translate(list(captured.center)).scale(captured.radius)
    return {"type": "sphere", "to_world": ball, "bsdf": {"type": "null"}, "interior": {
        "type": "nrf", "filename": str(path), "to_world": to_world, "scale": scale}}


def load(size: int, spp: int, max_depth: int, visibility: str = "raymarch") -> mi.Scene:
    """Return the scene. A `max_depth` of 4 allows three bounces."""
    tiles = {"type": "checkerboard", "color0": 0.25, "color1": 0.6, "to_uv": PLACE().scale([8, 8, 1])}
    view = PLACE().look_at([-1.2, 1.9, 5.4], [0.15, 0.72, 0], [0, 1, 0])
    above = PLACE().look_at([-2.2, 3.2, 1.5], [0, 0.5, 0], [0, 1, 0]).scale(0.5)
    warm, sampler = {"type": "rgb", "value": [18, 16, 13]}, {"type": "multijitter", "sample_count": spp}
    metal, film = {"type": "roughconductor", "alpha": 0.05}, {"type": "hdrfilm", "width": size * 3 // 2, "height": size}
    return mi.load_dict({
        "type": "scene",
        "integrator": {"type": "nrf", "visibility": visibility, "light_samples": 4, "max_depth": max_depth},
        "sensor": {"type": "perspective", "fov": 40, "to_world": view, "film": film, "sampler": sampler},
        "statue": field("statue", PLACE()),
        "globe": field("globe", PLACE().translate([1.35, 0, 0.35]).rotate([0, 1, 0], 40), 0.7),
        "knot": field("knot", PLACE().translate([-1.15, 0, 0.6]), 0.55),
        "floor": {"type": "rectangle", "to_world": PLACE().rotate([1, 0, 0], -90).scale(4),
                  "bsdf": {"type": "diffuse", "reflectance": tiles}},
        "metal": {"type": "sphere", "center": [0.55, 0.22, 1.25], "radius": 0.22, "bsdf": metal},
        "lamp": {"type": "rectangle", "to_world": above, "emitter": {"type": "area", "radiance": warm}},
        "sky": {"type": "envmap", "filename": str(SCENES / "common" / "env.exr"), "scale": 0.5}})  # fmt: skip


def main(out: Path = Path("out/three_fields.png"), size: int = 320, spp: int = 64, max_depth: int = 4) -> None:
    """Render and save the picture."""
    out.parent.mkdir(parents=True, exist_ok=True)
    mi.util.write_bitmap(str(out), mi.render(load(size, spp, max_depth))[..., :3], write_async=False)


if __name__ == "__main__":
    tyro.cli(main)

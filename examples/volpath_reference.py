"""Compare the `nrf` integrator with stock `volpath` on the same field.

    python examples/volpath_reference.py [--size 64] [--spp 64]

At `max_depth` 2 both compute single scattering: `volpath` by unbiased tracking, `nrf` by marching.
Means of 8×8 blocks are compared, since single pixels of `volpath` are noisy.
"""

import time
from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro

from mi_ntf.evaluate.metrics import relative_rmse

mi.set_variant("llvm_ad_rgb")

import mi_ntf  # noqa: E402  (Mitsuba's types exist only after the variant is set)

mi_ntf.register()

SCENE = Path(__file__).parents[1] / "scenes" / "statue" / "scene.xml"


def main(size: int = 64, spp: int = 64, light: str = "point", visibility: str = "raymarch",
         scene: Path = SCENE) -> None:
    """Render with both integrators, and print seconds and the relative RMSE of the block means."""
    loaded = mi.load_file(str(scene), light=light, visibility=visibility, res=str(size), spp=str(spp))
    stock = mi.load_dict({"type": "volpath", "max_depth": 2, "hide_emitters": True})
    images = []
    for name, integrator in (("nrf", loaded.integrator()), ("volpath", stock)):
        start = time.perf_counter()
        pixels = np.array(mi.render(loaded, integrator=integrator, seed=1))[..., :3]
        print(f"{name:8} {time.perf_counter() - start:7.2f} s   mean {pixels.mean():.5f}", flush=True)
        side = size // 8 * 8
        images.append(pixels[:side, :side].reshape(side // 8, 8, side // 8, 8, 3).mean(axis=(1, 3)))
    print(f"relative RMSE of 8x8 block means: {relative_rmse(*images):.4f}")


if __name__ == "__main__":
    tyro.cli(main)

"""Path-traced references of the meshes: `scenes/<name>/reference_{point,env}.exr`, 256 x 256, linear RGBA, half float.

Run: `python scenes/make_references.py [NAME ...]` (all scenes by default; minutes). Rendered in passes, so that the
memory stays small; the noise that is left is printed as the relative standard error of the image's mean pixel.
"""

import sys
from pathlib import Path

import mitsuba as mi
import numpy as np

from mi_ntf.data.schema import write_exr

NAMES = ("statue", "globe", "knot", "cloud")
PASSES, SPP = 26, 128


def reference(scene_file: Path, light: str) -> tuple[np.ndarray, float]:
    """RGBA mean over all passes, and the relative standard error of an average object pixel."""
    scene = mi.load_file(str(scene_file), light=light)
    images = np.stack([np.array(mi.render(scene, spp=SPP, seed=seed)) for seed in range(PASSES)])
    mean, error = images.mean(0), images.std(0, ddof=1) / np.sqrt(PASSES)
    inside = mean[..., 3] > 0.5
    return mean, float(np.sqrt((error[inside][:, :3] ** 2).mean()) / mean[inside][:, :3].mean())


def main() -> None:
    """Render both lights of every scene named on the command line."""
    mi.set_variant("llvm_ad_rgb")
    for name in sys.argv[1:] or NAMES:
        folder = Path(__file__).parent / name
        for light in ("point", "env"):
            image, error = reference(folder / "mesh.xml", light)
            write_exr(folder / f"reference_{light}.exr", image)
            print(f"{name} {light}: {PASSES * SPP} paths a pixel, relative standard error {error:.2%}", flush=True)


if __name__ == "__main__":
    main()

"""Render the pictures of the gallery page: docs/gallery/NAME.xml becomes NAME.jpg.

    python docs/gallery/make.py [NAME ...] [--size 400] [--out docs/gallery]

Volumes of the scenes that are not in ``docs/gallery/assets`` yet are made first, by ``assets.py``.
"""

import time
from pathlib import Path

import assets
import mitsuba as mi
import numpy as np
import tyro
from PIL import Image

mi.set_variant("llvm_ad_rgb")

import mi_ntf  # noqa: E402  (Mitsuba's types exist only after the variant is set)

mi_ntf.register()

GALLERY = Path(__file__).parent


def main(names: tyro.conf.Positional[tuple[str, ...]] = (), size: int = 400, spp: int | None = None,
         out: Path = GALLERY) -> None:
    """Render the scenes `names`, or all."""
    out.mkdir(parents=True, exist_ok=True)
    names = names or tuple(sorted(path.stem for path in GALLERY.glob("*.xml")))
    assets.make(names)
    for name in names:
        start = time.perf_counter()
        parameters = {"res": str(size)} | ({} if spp is None else {"spp": str(spp)})
        image = np.array(mi.render(mi.load_file(str(GALLERY / f"{name}.xml"), **parameters)))
        pixels = 0.5 + 0.5 * image[..., -3:] if name == "normals" else image[..., :3]
        pixels = np.array(mi.util.convert_to_bitmap(mi.TensorXf(pixels), uint8_srgb=name != "normals"))
        if pixels.dtype != np.uint8:
            pixels = (255 * np.clip(pixels, 0, 1) + 0.5).astype(np.uint8)
        Image.fromarray(pixels).save(out / f"{name}.jpg", quality=92, optimize=True)
        print(f"{name} {time.perf_counter() - start:.1f} s", flush=True)


if __name__ == "__main__":
    tyro.cli(main)

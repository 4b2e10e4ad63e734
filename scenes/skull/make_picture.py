"""docs/skull.jpg: a photograph that training did not see, and the field under a lamp and a sky.

    python scenes/skull/make_picture.py skull_flash/images/17.jpg
"""

from pathlib import Path

import mitsuba as mi
import numpy as np
import tyro
from PIL import Image

ROOT = Path(__file__).parents[2]
SIZE = 300


def main(photograph: tyro.conf.Positional[Path], out: Path = ROOT / "docs/skull.jpg") -> None:
    """Photograph, lamp, sky, side by side."""
    mi.set_variant("llvm_ad_rgb")
    import mi_ntf.render
    from mi_ntf.data.images import levels

    mi_ntf.render.register()
    with Image.open(photograph) as picture:
        edge = picture.height
        left = (picture.width - edge) // 2
        parts = [np.asarray(picture.crop((left, 0, left + edge, edge)).resize((SIZE, SIZE)).convert("RGB"))]
    for light, spp in (("point", "64"), ("env", "8")):
        scene = mi.load_file(str(ROOT / "scenes/skull/scene.xml"), light=light, spp=spp, res=str(SIZE))
        parts.append(levels(np.array(mi.render(scene)))[..., :3])
    Image.fromarray(np.concatenate(parts, 1)).save(out, quality=88, optimize=True)


if __name__ == "__main__":
    tyro.cli(main)

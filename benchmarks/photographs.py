"""How a field looks beside the photographs that it was not trained on, by the renderer that users have.

    python -m benchmarks.photographs FIELD DATASET [--mesh SCENE.xml] [--spp 32] [--depth -1]

Test views of the data set: mean PSNR and SSIM (both sRGB) of the field lit as the photograph was. `--depth`:
``max_depth``, 2 for photographs without light that bounced. `--mesh`: the captured meshes; adds the mean angle between
their shading normals and the field's, degrees, over pixels that both fill.
"""

import argparse
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS
from mi_ntf.data.images import linear
from mi_ntf.data.readers import load_dataset
from mi_ntf.evaluate import metrics

FILLED = 0.98
"""Opacity from which on a pixel's normal counts: silhouettes mix it with nothing."""


def study(field: Path, dataset: Path, mesh: Path | None = None, spp: int = 32, depth: int = -1) -> dict[str, float]:
    """``psnr`` (dB) and ``ssim``, means over the test views; with `mesh`, ``normal_error`` (degrees)."""
    split = load_dataset(dataset, lambda note: None)["test"]
    ball = field_ball(field)
    originals = None if mesh is None else mi.load_file(str(mesh))
    scores, angles = [], []
    for i, stored in enumerate(split.images):
        photograph = linear(stored)
        view = sensor(split, i)
        lamp = {"type": "point", "position": split.light_pos[i].tolist(),
                "intensity": {"type": "rgb", "value": split.light_intensity[i].tolist()}}
        integrator = {"type": "nrf", "max_depth": depth, "aovs": "normal,opacity" if mesh else ""}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, "lamp": lamp, "ball": ball})
        seed: Any = i  # a number, where Mitsuba's stub asks for an array
        image = np.array(mi.render(scene, sensor=view, spp=spp, seed=seed))
        truth = photograph[..., :3].astype(np.float64)
        scores.append((metrics.psnr(image[..., :3], truth), metrics.ssim(image[..., :3], truth)))
        if originals is not None:
            filled = (image[..., 7] > FILLED) & (photograph[..., 3] > 0.999)
            angles.append(_angles(image[..., 4:7], _normals(originals, view, spp))[filled])
    psnr, ssim = np.mean(scores, axis=0)
    found = {"psnr": float(psnr), "ssim": float(ssim)}
    return found | ({"normal_error": float(np.nanmean(np.concatenate(angles)))} if angles else {})


def sensor(split, i: int):
    """The camera of view `i` of a :class:`mi_ntf.data.schema.Split`. Raises MiNtfError where Mitsuba's cannot be it."""
    height, width = split.images.shape[1:3]
    fx, fy = split.focal[i]
    if abs(fx - fy) > 1e-3 * fx or np.abs(split.principal[i] - [width / 2, height / 2]).max() > 0.5:
        raise MiNtfError(f"view {i}: focal lengths {fx:.5g}, {fy:.5g} and principal point "
                         f"{split.principal[i].tolist()}, expected square pixels and a centred camera")
    to_world = split.c2w[i] @ np.diag([-1, 1, -1, 1])  # OpenGL → Mitsuba axes
    return mi.load_dict({
        "type": "perspective", "fov_axis": "x", "fov": float(2 * np.degrees(np.arctan(width / 2 / fx))),
        "near_clip": 1e-4, "far_clip": 1e6, "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"},
                 "pixel_format": "rgba"},
        "sampler": {"type": "independent"},
    })  # fmt: skip


def field_ball(field: Path) -> dict:
    """The field in its unit sphere, where it was captured."""
    similarity = field_file.load_header(field).similarity
    return {"type": "sphere", "center": list(similarity.center), "radius": similarity.radius, "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(field)}}


def _normals(originals, view, spp: int) -> np.ndarray:
    """Mean shading normals (h, w, 3) of the meshes, not normalised."""
    integrator = mi.load_dict({"type": "aov", "aovs": "normal:sh_normal"})
    return np.array(mi.render(originals, sensor=view, integrator=integrator, spp=spp))[..., -3:]


def _angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between the vectors of two images; NaN where one is none, or edges mix it of several."""
    lengths = np.linalg.norm(a, axis=-1), np.linalg.norm(b, axis=-1)
    cosine = (a * b).sum(-1) / np.maximum(lengths[0] * lengths[1], 1e-6)
    return np.where(np.minimum(*lengths) > 0.9, np.degrees(np.arccos(np.clip(cosine, -1, 1))), np.nan)


def main() -> None:
    """Print the study of one field."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.photographs", description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("field", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--spp", type=int, default=32)
    parser.add_argument("--depth", type=int, default=-1)
    given = parser.parse_args()
    mi.set_variant(*VARIANTS)
    from mi_ntf import render

    render.register()
    for name, value in study(given.field, given.dataset, given.mesh, given.spp, given.depth).items():
        print(f"{name:<13} {value:.4g}")


if __name__ == "__main__":
    main()

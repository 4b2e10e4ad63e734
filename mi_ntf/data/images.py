"""Image files as linear premultiplied RGBA, colour spaces explicit.

    EXR          linear; alpha premultiplied, as renderers write it
    PNG, JPEG    8 bit, sRGB; alpha straight (JPEG has none)
    masks        grey level / 255 is the alpha; black: background. Only used where the image itself has no alpha

Pillow and OpenEXR are imported where they are needed.
"""

from pathlib import Path

import numpy as np

from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError

SUFFIXES = (".png", ".exr", ".jpg", ".jpeg")
_LEVELS = np.arange(256) / 255.0
LINEAR = np.where(_LEVELS <= 0.04045, _LEVELS / 12.92, ((_LEVELS + 0.055) / 1.055) ** 2.4).astype(np.float32)
"""sRGB's 256 levels in linear light (IEC 61966-2-1)."""


def read_image(path: Path) -> np.ndarray:
    """Linear premultiplied RGBA (H, W, 4) float32 of an EXR, PNG or JPEG; alpha 1 where the file has none.

    Raises MiNtfError where the file is missing, unreadable, of another kind, or holds NaN or infinity.
    """
    rgb, alpha = _decode(Path(path))
    return _premultiplied(rgb, np.ones(rgb.shape[:2], np.float32) if alpha is None else alpha)


def read_photograph(path: Path, masks: list[Path]) -> np.ndarray:
    """:func:`read_image`, with the first existing file of `masks` as alpha where the image has none.

    Training must know which pixels show the object, so an image with neither is an error.
    """
    rgb, alpha = _decode(Path(path))
    if alpha is None:
        mask = next((m for m in masks if m.is_file()), None)
        if mask is None:
            raise MiNtfError(f"{path}: has no alpha channel and no mask{' (' + str(masks[0]) + ')' if masks else ''}; "
                             "training must tell the object from what is behind it: put a mask there (PNG, white: "
                             "object, black: background), or write the photograph as RGBA PNG")
        alpha = _read_mask(mask)
        if alpha.shape != rgb.shape[:2]:
            raise MiNtfError(f"{mask}: is {alpha.shape[1]}x{alpha.shape[0]}, its photograph {path} is "
                             f"{rgb.shape[1]}x{rgb.shape[0]}; a mask has the size of its photograph")
        return _premultiplied(rgb * alpha[..., None], alpha)
    return _premultiplied(rgb, alpha)


def _premultiplied(rgb: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    return np.concatenate([rgb, alpha[..., None]], -1).astype(np.float32)


def _decode(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Linear RGB (H, W, 3), premultiplied if there is alpha, and alpha (H, W) or None."""
    if not path.is_file():
        raise MiNtfError(f"{path} does not exist; the data set is incomplete: put the file there, take its entry out, "
                         "or run the capture again (it resumes)")
    reader = {".exr": _read_exr, ".png": _read_srgb, ".jpg": _read_srgb, ".jpeg": _read_srgb}.get(path.suffix.lower())
    if reader is None:
        raise MiNtfError(f"{path}: images of type '{path.suffix}' are not read; convert it to .exr, .png or .jpg")
    try:
        rgb, alpha = reader(path)
    except MiNtfError:
        raise
    except Exception as error:  # OpenEXR and Pillow raise many kinds for a damaged file
        raise MiNtfError(f"{path}: cannot be read as an image ({error}); delete it and capture or copy it again"
                         ) from error
    finite = np.isfinite(rgb).all(-1) & (True if alpha is None else np.isfinite(alpha))
    bad = int(np.count_nonzero(~finite))
    if bad:
        raise MiNtfError(f"{path}: {bad} pixels are NaN or infinite (half precision ends at 65504); write it with 32 "
                         "bits a channel or under a weaker light. One of `mi-ntf capture` can be deleted: the same "
                         "command makes it anew")
    return rgb, alpha


def _read_exr(path: Path):
    import OpenEXR

    with OpenEXR.File(str(path), separate_channels=True) as file:
        channels = {name: np.array(c.pixels, dtype=np.float32) for name, c in file.channels().items()}
    missing = [name for name in "RGB" if name not in channels]
    if missing:
        raise MiNtfError(f"{path}: has channels {', '.join(sorted(channels))}, lacks {', '.join(missing)}; "
                         "write it as RGB or RGBA")
    return np.stack([channels["R"], channels["G"], channels["B"]], -1), channels.get("A")


def _read_srgb(path: Path):
    """8-bit image. The Exif orientation is left aside on purpose: poses and masks belong to the stored pixels."""
    from PIL import Image

    with Image.open(path) as image:
        if image.mode not in ("L", "LA", "P", "RGB", "RGBA"):
            raise MiNtfError(f"{path}: image of mode '{image.mode}'; write it with 8 bits a channel, or as EXR")
        has_alpha = image.mode in ("LA", "RGBA") or "transparency" in image.info
        stored = np.asarray(image.convert("RGBA"))
    linear, alpha = LINEAR[stored[..., :3]], stored[..., 3] / np.float32(255)
    return (linear * alpha[..., None], alpha) if has_alpha else (linear, None)


def _read_mask(path: Path) -> np.ndarray:
    """Alpha (H, W) float32 in [0, 1] of a mask; a grey level is a share of coverage, no colour."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("L"), dtype=np.float32) / 255.0
    except Exception as error:
        raise MiNtfError(f"{path}: cannot be read as a mask ({error}); write it as 8-bit grey PNG") from error


def is_file_name(name: object) -> bool:
    """Whether `name` is text that a file could be called by and that one line can show, in any folder."""
    if not isinstance(name, str) or not name.isprintable():  # half a character is not printable either
        return False
    parts = [len(part.encode()) for part in name.split("/")]
    return 0 < sum(parts) <= 2000 and max(parts) <= 240


def mask_places(root: Path, name: str) -> list[Path]:
    """Where the mask of photograph `name` (relative to `root`) may lie: `root`/masks, the same name, as PNG or as
    COLMAP writes it (name.jpg.png). A leading folder `images` is left out."""
    relative = Path(name)
    if relative.is_absolute():
        return []
    if relative.parts[:1] == ("images",):
        relative = relative.relative_to("images")
    base = root / "masks" / relative
    return [base.with_suffix(".png"), base.with_name(base.name + ".png")]


def write_exr(path: Path, rgba: np.ndarray) -> None:
    """Write linear premultiplied RGBA (H, W, 4) as EXR, whole or not at all: in half precision, in single where a value
    is beyond it."""
    import OpenEXR

    dtype = np.float32 if np.abs(rgba).max() > np.finfo(np.float16).max else np.float16
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with OpenEXR.File(header, {"RGBA": np.ascontiguousarray(rgba, dtype=dtype)}) as file:
        with files.replacing(path) as temporary:
            file.write(str(temporary))

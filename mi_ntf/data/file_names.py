"""Names of photographs and masks as data sets write them, and the files on the disk that they mean.

A name is taken literally first. A photograph that is not there is then looked for with "/" in place of Windows' "\\",
with its extension in another case, and with any other extension that is read, as far as only one file fits.
"""

from collections.abc import Iterable
from pathlib import Path

from mi_ntf.core.errors import MiNtfError

SUFFIXES = (".png", ".exr", ".jpg", ".jpeg", ".tif", ".tiff")
MASK_SUFFIXES = (".png", ".jpg", ".jpeg", ".tif", ".tiff")


def is_file_name(name: object) -> bool:
    """Return True if `name` could be the name of a file and can be shown in one line."""
    if not isinstance(name, str) or not name.isprintable():  # half a character is not printable either
        return False
    parts = [len(part.encode()) for part in name.split("/")]
    return 0 < sum(parts) <= 2000 and max(parts) <= 240


def plain(name: str) -> str:
    """`name` with "/" between its parts."""
    return name.replace("\\", "/")


def locate(folder: Path, name: str) -> Path:
    """The photograph `name` in `folder`; where no file fits, the place where it should be. Raises MiNtfError."""
    place = folder / name
    if place.is_file():
        return place
    place = folder / plain(name)
    found = on_disk(place)
    if found is not None or place.suffix.lower() not in SUFFIXES:
        return found or place
    others = [other for suffix in SUFFIXES if (other := on_disk(place.with_suffix(suffix)))]
    if len(others) > 1:
        raise MiNtfError(f"{place} does not exist, and {' and '.join(other.name for other in others)} lie there; leave "
                         "the one that is meant")
    return others[0] if others else place


def on_disk(place: Path) -> Path | None:
    """`place`, or else the file whose name differs from it by the case of the extension alone."""
    suffix = place.suffix
    for own in dict.fromkeys((suffix, suffix.lower(), suffix.upper(), f".{suffix[1:].capitalize()}")):
        if suffix and (other := place.with_suffix(own)).is_file():
            return other
    return place if place.is_file() else None


def first(places: Iterable[Path]) -> Path | None:
    """The first of `places` that is on the disk."""
    return next((found for place in places if (found := on_disk(place))), None)


def mask_places(masks: Path, name: str) -> list[Path]:
    """Return the possible paths of the mask of photograph `name` in the folder `masks`.

    A mask has the photograph's name as a PNG file, the name that COLMAP writes (name.jpg.png), or another suffix. A
    leading folder `images` (`images_4`) is left out."""
    relative = Path(name)
    if relative.is_absolute() or not relative.name:
        return []
    if len(relative.parts) > 1 and relative.parts[0].startswith("images"):
        relative = Path(*relative.parts[1:])
    base = masks / relative
    return [base.with_suffix(".png"), base.with_name(base.name + ".png"),
            *(base.with_suffix(suffix) for suffix in MASK_SUFFIXES[1:])]

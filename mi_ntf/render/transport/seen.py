"""What camera rays meet in the fields, kept for renders in which lights alone differ: finding it takes most of a
preview's time."""

from collections.abc import Callable
from typing import Any

from ...infer.samples import Samples
from ...infer.shade import Points


class Seen:
    """Samples of some camera rays, and the field points that they are.

    Whoever keeps one for another render answers for its rays, fields, surfaces and steps being the same. `keep`: False
    keeps nothing, for what is rendered once."""

    def __init__(self, keep: bool = True) -> None:
        self._keep = keep
        self._samples: dict[tuple, Samples] = {}
        self._points: dict[tuple, Points] = {}
        self._chunks: dict[int, Seen] = {}

    def chunk(self, first: int) -> "Seen":
        """What is kept of the rays through source pixels from `first` on."""
        return self._chunks.setdefault(first, Seen())

    def samples(self, shade: bool, view: bool, make: Callable[[], Samples]) -> Samples:
        """Those of :func:`mi_ntf.infer.march.camera_samples` with these options."""
        return self._kept(self._samples, (shade, view), make)

    def points(self, samples: Samples, strand: int, make: Callable[[], Points]) -> Points:
        """Those of `samples` that lie in the field `strand`."""
        which = next((key for key, value in self._samples.items() if value is samples), ())
        return self._kept(self._points, (*which, strand), make)

    def _kept(self, found: dict, key: tuple, make: Callable[[], Any]) -> Any:
        if not self._keep:
            return make()
        if key not in found:
            found[key] = make()
        return found[key]

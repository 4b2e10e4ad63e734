"""Glints that fewer lights of an environment would make: a lobe sees one light where it should see a patch of the sky,
in a thousandth of the pixels, which had half of the squared error of ``skull``."""

from collections.abc import Callable

from ..scene.settings import Settings
from .composition import Composition
from .estimate import Estimate
from .probing import Look, Probes

PIXELS = 4096
DULL = 1 / 3
"""Of a white diffuse surface, what no lobe exceeds in which glints are not looked for (:class:`mi_ntf.infer.grid.
GridField`, `gloss`): of the shadowless error of 32 lights, 1.7 % at most, a tenth is in a thousandth of the pixels."""


class Glints:
    """They are looked for in pictures without shadows, which are cheap enough for many pixels.

    composed  how settings become what a picture is rendered with
    whole     settings of the picture that has all its lights
    """

    def __init__(self, composed: Callable[[Settings], Composition], estimate: Estimate, sensor, whole: Settings):
        self._composed, self._estimate, self._sensor, self._whole = composed, estimate, sensor, whole
        self._found: tuple[Probes, Look] | None = None

    def error(self, settings: Settings, spp: int) -> float:
        """Relative RMSE of a picture of `spp` samples by `settings`; 0 where nothing can glint."""
        if self._dull():
            return 0.0
        if self._found is None:
            probes = Probes(self._sensor, self._estimate.media, PIXELS)
            self._found = probes, self._look(probes, self._whole)
        probes, truth = self._found
        return probes.error(self._look(probes, settings), truth, spp)

    def _look(self, probes: Probes, settings: Settings) -> Look:
        return probes.look(lambda: self._composed(settings.but(visibility="none", max_depth=2)))

    def _dull(self) -> bool:
        found = self._estimate.effects
        return not (found.surfaces or found.fresnel) and (
            not found.specular or all(m.field.grid.gloss < DULL for m in self._estimate.media))

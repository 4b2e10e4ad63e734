"""Settings and limits of a render, apart from the ``nrf`` plugin, so that other values can be tried."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Settings:
    """Properties of the ``nrf`` integrator, and omissions that make a render faster.

    shadow_gradients  "exact", or "none" for shadows that derivatives by a density hold fixed
    specular          False leaves out the specular lobes
    brightest_lights  number of the light table's lights that shine, brightest first; 0: all
    without_media     numbers of the media that take no part
    only_emitters     numbers of the emitters that shine, for scenes without surfaces; None: all
    """

    visibility: str
    samples: int
    light_samples: int
    environment_lights: int
    map_resolution: int
    map_source: str
    map_components: int
    map_memory: float
    map_file: str
    max_depth: int
    rr_depth: int
    bounces: str
    frames: int
    hide_emitters: bool
    unbiased: bool = False
    shadow_gradients: str = "exact"
    specular: bool = True
    brightest_lights: int = 0
    without_media: tuple[int, ...] = ()
    only_emitters: tuple[int, ...] | None = None


@dataclass(frozen=True)
class Limits:
    """Limits of a render, which ends when the first of them is reached; 0 sets no limit.

    noise    Monte Carlo noise (:func:`mi_ntf.render.transport.passes.noise`)
    error    relative RMSE of the picture against ``raymarch``
    seconds  time since the call of ``render``, everything included
    """

    noise: float = 0.0
    error: float = 0.0
    seconds: float = 0.0

    @property
    def of_samples(self) -> bool:
        """True if the number of samples is decided while rendering."""
        return self.noise > 0 or self.seconds > 0


NO_LIMITS = Limits()

"""Properties of an ``nrf`` integrator, apart from the plugin, so that others can be tried in their place."""

from dataclasses import dataclass, fields, replace


@dataclass(frozen=True)
class Settings:
    """Properties of the plugin's table, and what is left out of what the scene calls for.

    specular   specular lobes take part
    brightest  number of the table's lights that shine, the brightest ones; 0: all
    without    numbers of the media that take no part
    share      (part, parts): the discrete lights of one part, and in part 0 all else; parts add up to the picture
    only       numbers of the emitters that shine; None: all (of a scene without surfaces)
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
    bounces: str
    frames: int
    hide_emitters: bool
    unbiased: bool = False
    specular: bool = True
    brightest: int = 0
    without: tuple[int, ...] = ()
    share: tuple[int, int] = (0, 1)
    only: tuple[int, ...] | None = None

    @classmethod
    def of(cls, integrator) -> "Settings":
        """Return the settings of an integrator, or of other settings."""
        return cls(**{f.name: getattr(integrator, f.name) for f in fields(cls) if hasattr(integrator, f.name)})

    def but(self, **changed) -> "Settings":
        """Return these settings with some of them changed."""
        return replace(self, **changed)


@dataclass(frozen=True)
class Limits:
    """Limits of a render, which ends when the first of them is reached; 0: no limit of the kind.

    noise    Monte Carlo noise (:func:`mi_ntf.render.transport.passes.noise`)
    error    bias against ``raymarch``, relative RMSE of the picture
    seconds  from the call of ``render`` on, everything included
    """

    noise: float = 0.0
    error: float = 0.0
    seconds: float = 0.0

    @property
    def of_samples(self) -> bool:
        """True if the number of samples is found while rendering."""
        return self.noise > 0 or self.seconds > 0

"""The ways to render a scene that a study compares: visibility methods with their dials, and what stock Mitsuba has."""

from dataclasses import dataclass
from typing import Any

from ...infer.visibility import REGISTRY
from .subject import Subject

STOCK, MESH, BOUND = "volpath", "mesh", "none"
"""Ways besides the visibility methods, and the method that looks for no visibility: a bound, and no choice."""
DRAWN = 4
"""Lights drawn at each point in place of all. The samples of a pixel draw others each time, so that a few suffice, and
the picture costs that of four lights however many there are."""
BASELINES = ("ray_network", "visibility_mlp", "transmittance_volume")
"""Methods that are here to be compared with. They come late, as a single pass of theirs may take more than its share of
the budget, which the other ways would lack."""

_TITLES = {STOCK: "stock volpath", MESH: "exported mesh, stock path", BOUND: "no shadows",
           "visibility_mlp": "visibility MLP"}
_WORDS = {"samples": "{} steps", "light_samples": "{} lights drawn at each point",
          "environment_lights": "{} environment lights", "map_resolution": "{0}×{0} texels",
          "map_components": "{} logistics a texel"}


@dataclass(frozen=True)
class Way:
    """One way to render the scene.

    method    name of a visibility method, `STOCK` or `MESH`
    changes   properties of the integrator that differ from the scene's own: finer or coarser dials
    """

    method: str
    changes: tuple[tuple[str, Any], ...] = ()

    @property
    def name(self) -> str:
        """Short name, for files."""
        return "-".join([self.method, *(f"{name}-{value}" for name, value in self.changes)])

    @property
    def title(self) -> str:
        """Description in words."""
        words = [_WORDS[name].format(value) for name, value in self.changes]
        return ", ".join([_TITLES.get(self.method, self.method.replace("_", " ")), *words])

    @property
    def plugin(self) -> str:
        """Mitsuba's name of the integrator."""
        return {STOCK: STOCK, MESH: "path"}.get(self.method, "nrf")

    def properties(self, subject: Subject) -> dict[str, Any]:
        """Return the properties of the integrator."""
        own = subject.properties
        if self.plugin != "nrf":
            return {name: own[name] for name in ("max_depth", "hide_emitters")}
        whole = {"light_samples": 0} if REGISTRY[self.method].drawn else {}  # its maps are of all lights
        return own | whole | {"visibility": self.method} | dict(self.changes)


def plan(subject: Subject, mesh: bool) -> list[Way]:
    """Return the ways of a study in their order; `mesh`: there is one to compare with.

    Every method that serves the scene, with the scene's own dials; stock ``volpath`` and the exported mesh before the
    `BASELINES`; and finer dials.
    """
    methods = [name for name in subject.serves if name not in BASELINES]
    stock = [STOCK, *([MESH] if mesh else []), *(name for name in BASELINES if name in subject.serves)]
    return [*map(Way, [*methods, *stock]), *finer(subject, subject.serves)]


def finer(subject: Subject, methods: list[str]) -> list[Way]:
    """Return `methods` with one other dial each, of one kind of dial after the other."""
    own, methods = subject.properties, [name for name in methods if name != BOUND]
    summed = [name for name in methods if not REGISTRY[name].drawn]
    found = []
    if subject.lights > DRAWN and not own["light_samples"]:
        found += [(name, "light_samples", DRAWN) for name in summed]
    found += [(name, "map_resolution", 2 * (own["map_resolution"] or subject.texels(name))) for name in methods
              if "map_resolution" in REGISTRY[name].dials]
    if own["map_components"] == 1 and own["map_source"] == "field":
        found += [(name, "map_components", 2) for name in methods if "map_components" in REGISTRY[name].dials]
    found.append(("raymarch", "samples", min(2 * own["samples"], 8192)))
    if subject.environment and not own["light_samples"]:
        cells = own["environment_lights"]
        found += [(name, "environment_lights", min(4 * cells, 65536) if name in summed else max(cells // 4, 1))
                  for name in methods]
    return [Way(name, ((dial, value),)) for name, dial, value in found]

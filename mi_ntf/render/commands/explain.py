"""The command ``mi-ntf explain``: how the ``nrf`` integrator renders a scene, the reasons, and the cost."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

import mitsuba as mi
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from ...core import progress
from ...core.quantities import duration
from ...infer.visibility import REGISTRY
from .. import timing, user_cache
from ..lights import environment
from ..lights.light_rows import Discrete
from ..maps import building
from ..plugins.registration import load_scene
from ..scene.environment_option import Environment
from ..scene.media import find_media, ordinary_shapes
from ..scene.settings import Settings
from ..transport import candidates, choosing, effects
from ..transport.composition import Composition
from ..transport.context import RenderContext, context_of

PLAIN: dict[str, Any] = {"box": SIMPLE_HEAD, "pad_edge": False}
"""Options of tables without vertical lines, which leave more columns for the text."""
Report: TypeAlias = dict[str, Any]
"""Part of the report, as it is written to JSON."""


def explain(scene: Path, parameters: dict[str, str], measure: bool = False, environment: Environment | None = None
            ) -> Report:
    """Load `scene` (with `parameters` for its $names) and describe its render.

    Parameters
    ----------
    scene
        A scene file with an ``nrf`` integrator.
    parameters
        Values of its $names.
    measure
        Render the scene as well.
    environment
        Changes of the scene's environment.

    Returns
    -------
    dict
        ``fields`` (file, placement), ``lights`` (kinds, count), ``environments`` (for each that is summed: its
        ``lights``, their ``radius_degrees``, and a bound on the error of an unshadowed surface's irradiance, in
        percent of all light of that environment), ``effects`` (name → ``{"on": bool, "why": str}``), ``predicted`` by
        a pilot (``seconds`` without compilation, ``error`` against the march and its ``bound``), ``trials`` under
        limits, ``memory_bytes`` of the voxels and of maps or volumes, and ``measured`` (:func:`.timing.once`).

    Raises
    ------
    MiNtfError
        If rendering would raise it.
    """
    with progress.Stage(f"reading {scene}"):
        loaded = load_scene(scene, parameters, environment)
    sensor, media, context = loaded.sensors()[0], find_media(loaded), context_of(loaded)
    whole = context.settings
    width, height = (int(v) for v in sensor.film().crop_size())
    spp = sensor.sampler().sample_count()
    with progress.Stage("predicting the render by a pilot"), user_cache.switched("off"):
        composition, choice = choosing.Chooser(loaded, whole, context.limits, sensor, spp).explain()
    active = replace(composition.effects, reason=choice.best.why) if choice.best else composition.effects
    settings, light, count = composition.settings, composition.lights, len(composition.lights.rows.power)
    report = {
        "scene": str(scene),
        "image": {"width": width, "height": height, "spp": spp},
        "fields": [{"file": m.path, "representation": m.representation, "center": m.frame.origin.tolist(),
                    "radius": m.frame.length} for m in media],
        "lights": {"emitters": list(active.emitters), "count": count,
                   "drawn": effects.sampled_light_count(settings, light)},
        "environments": [_environment(each, each.cells) for each in light.discrete if each.cells],
        "visibility": active.visibility,
        "method": candidates.name(settings, whole),
        "effects": _effects(loaded, active, settings, count, int(light.suns().sum())),
        "predicted": choice.predicted,
        "trials": [vars(t) for t in choice.trials],
        "memory_bytes": {"voxels": sum(m.field.grid.nbytes for m in composition.media),
                         "maps or volumes": _memory_of_maps(composition)},
    }
    if measure:
        report["measured"] = _measured(loaded, context, spp)
    return report


def _measured(scene: mi.Scene, context: RenderContext, spp: int) -> timing.RenderCost:
    """Render twice, since the first time may compile kernels, and build everything anew each time."""
    with progress.Stage("renders to measure", 2) as stage, user_cache.switched("off"):
        timing.once(scene, scene.integrator(), spp, 1)
        stage.advance()
        context.patches = None
        return timing.once(scene, scene.integrator(), spp, 0)[1]


def _environment(light: Discrete, cells: environment.Cells) -> Report:
    """Return the error of the directional lights of an environment, without the sun of a ``sunsky``."""
    return {"emitter": environment.name(light.emitter, light.kind), "lights": int((cells.weight > 0).sum()),
            "radius_degrees": math.degrees(cells.radius), "irradiance_error_percent": 100 * cells.error()}


def _memory_of_maps(composition: Composition) -> int:
    """Return the bytes of the maps or volumes that are in memory at once."""
    active, media = composition.effects, composition.media
    if not (active.lit and active.needs_visibility):
        return 0
    table, settings = composition.lights.table(media[0].frame), composition.settings
    first, end = building.parts(active.visibility, media, table, settings)[0]
    per_light = [building.size_per_light(active.visibility, medium, table, settings) for medium in media]
    per_field = [building.size_per_field(active.visibility, medium, table, settings) for medium in media]
    return (end - first) * sum(per_light) + sum(per_field)


def _effects(scene: mi.Scene, active: effects.Effects, settings: Settings, count: int, suns: int) -> Report:
    """Return for each effect whether it is active, and the reason."""
    marched = f"; marched to {suns} that outshine the others" if suns and REGISTRY[active.visibility].per_field else ""
    use_map = active.needs_visibility and bool(REGISTRY[active.visibility].sampled)
    shapes = len(ordinary_shapes(scene))
    unlit = "no emitter has power" if active.emitters else "there is no emitter"
    answers = {
        "visibility": (active.needs_visibility and active.visibility != "none",
                       f"{active.visibility}: {active.reason}{marched}"),
        "every light at every point": (active.exhaustive, f"light_samples is {settings.light_samples}"),
        "transmittance maps": (
            use_map,
            f"{count} lights of {settings.map_resolution}² texels, source {settings.map_source}"
            if use_map else "the camera sees what the light sees" if active.collocated and not active.needs_visibility
            else f"{active.visibility} needs none"),
        "view transmittance for light": (
            active.collocated, "all light comes from the camera" if active.collocated else "a light is elsewhere"),
        "environment background": (
            active.background, "an environment is visible" if active.background else
            "there is no environment" if scene.environment() is None else "emitters are hidden"),
        "shading": (active.lit, "the scene has lights" if active.lit else unlit),
        "specular lobe": (
            active.specular, "a field has one" if active.specular else "no field has one above the threshold"),
        "Fresnel effect": (
            active.fresnel, "a field was trained with it" if active.fresnel else "no field was trained with it"),
        "fields in view": (any(active.in_view), f"{sum(active.in_view)} of {len(active.in_view)}"),
        "ordinary surfaces": (
            active.surfaces, f"{shapes} shapes beside the fields' bounds" if shapes else "there are none"),
        "multiple scattering": (
            active.bounces,
            f"max_depth is {settings.max_depth}" + (f", by {active.bounces}" if active.bounces else "")),
        "gradients": (active.gradients, "a parameter is attached" if active.gradients else "no parameter is attached"),
    }
    return {name: {"on": bool(on), "why": why} for name, (on, why) in answers.items()}


def print_table(report: Report) -> None:
    """Print a report of :func:`explain` as tables."""
    console = Console()
    image = report["image"]
    console.print(
        f"{report['scene']}: {image['width']}×{image['height']}, {image['spp']} samples a pixel", highlight=False,
        soft_wrap=True)
    for field in report["fields"]:
        console.print(f"field {field['file']} as {field['representation']}", highlight=False, soft_wrap=True)
    for each in report["environments"]:
        console.print(
            f"{each['emitter']}: {each['lights']} directional lights of cells of "
            f"{each['radius_degrees']:.2g}° (RMS); the irradiance of an unshadowed surface is right within "
            f"{each['irradiance_error_percent']:.2g} % of all light", highlight=False)
    table = Table("effect", "on", "why", **PLAIN)
    for name, effect in report["effects"].items():
        table.add_row(name, "yes" if effect["on"] else "–", effect["why"])
    console.print(table)
    if report["trials"]:
        console.print(_trials(report["trials"]))
    console.print(_costs(report))


def _trials(trials: list[Report]) -> Table:
    table = Table("tried", "time", "error", "error below", "verdict", **PLAIN)
    for trial in trials:
        numbers = ["–"] * 3 if math.isnan(trial["bound"]) else [
            duration(trial["seconds"]), f"{trial['error']:.2%}", f"{trial['bound']:.2%}"]
        table.add_row(trial["name"], *numbers, trial["why"])
    return table


def _costs(report: Report) -> Table:
    predicted, measured = report["predicted"], report.get("measured")
    table = Table(report["method"], "predicted by a pilot", *(["measured"] if measured else []),
                  caption="time without the compilation of kernels; error against the march", caption_justify="left",
                  **PLAIN)

    def row(name: str, prediction: str, measurement: str = "") -> None:
        table.add_row(name, prediction, *([measurement] if measured else []))

    if predicted:
        row("time", duration(predicted["seconds"]),
            duration(measured["wall_seconds"] - measured["compile_seconds"]) if measured else "")
        row("error", f"{predicted['error']:.2%}, below {predicted['bound']:.2%}")
    for name, size in report["memory_bytes"].items():
        row(f"memory: {name}", f"{size / 2**20:.0f} MiB")
    if measured:
        row("memory: peak", "", f"{measured['peak_bytes'] / 2**20:.0f} MiB")
    return table

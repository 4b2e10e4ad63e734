"""The command ``mi-ntf explain``: what the ``nrf`` integrator will do with a scene, why, and at what cost."""

import math
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ...infer.visibility import REGISTRY
from ..cost import model
from ..cost.measurement import measure as watch
from ..lights import environment, scene_lights
from ..maps import building
from ..plugins.registration import load_scene
from ..scene import effects
from ..scene.media import find_media, ordinary_shapes
from ..scene.settings import Limits, Settings
from ..transport import choosing
from ..transport.composition import IN_SMOKE
from ..transport.rendering import CHUNK
from . import calibration


def explain(scene: Path, parameters: dict[str, str], measure: bool = False) -> dict:
    """Load `scene` (with `parameters` for its $names) and describe its render.

    Returns ``fields`` (file, placement), ``lights`` (kinds, count), ``environments`` (of each that is summed:
    ``lights``; their ``radius_degrees``, see :class:`mi_ntf.render.lights.environment.Cells`; the bound on the error of
    an unshadowed surface's irradiance, in percent of all light of that environment), ``effects``: name → ``{"on": bool,
    "why": str}``; ``constants``: where the prices of the machine are from; ``seconds``: predicted, by stage;
    ``memory_bytes`` of what is held beside the film; ``choice`` under limits: what was looked at, and predicted for it.
    With `measure`, measures the machine's prices and renders: ``measured``, see
    :func:`mi_ntf.render.cost.measurement.measure`. Raises MiNtfError where rendering would.
    """
    loaded = load_scene(scene, parameters)
    integrator, media = loaded.integrator(), find_media(loaded)
    if measure:
        calibration.calibrate(media[0])
    sensor = loaded.sensors()[0]
    width, height = (int(v) for v in sensor.film().crop_size())
    spp = sensor.sampler().sample_count()
    settings = Settings.of(integrator)
    chooser = choosing.Chooser(loaded, settings, integrator.limits, sensor, spp, None)
    choice = chooser.choose() if integrator.limits != Limits() else None
    if choice:
        settings, light, found = choice.composition.settings, choice.composition.lights, choice.effects
        media = choice.composition.media
    else:
        light = scene_lights.Lights(loaded, media, settings.light_samples, settings.environment_lights)
        settings = building.resolved(settings, len(light.rows.power), media)
        found = effects.describe(loaded, settings, sensor, spp, media, light)
    count = light.table(media[0].frame).count
    drawn = effects.drawn(settings, light)
    work = works(settings, media, found, width * height * spp, count, drawn)
    report = {
        "scene": str(scene),
        "image": {"width": width, "height": height, "spp": spp},
        "fields": [{"file": m.path, "representation": m.representation, "center": m.frame.origin.tolist(),
                    "radius": m.frame.length} for m in media],
        "lights": {"emitters": list(found.emitters), "count": count, "drawn": drawn},
        "environments": [_environment(each) for each in light.discrete if each.cells],
        "visibility": found.visibility,
        "effects": _effects(loaded, found, settings, count, light.suns().sum()),
        "constants": "measured on this machine" if model.measured() else "built in; --measure measures this machine's",
        "points": sum(w.points for w in work),
        "seconds": _sum(model.seconds(w, model.constants()) for w in work),
        "memory_bytes": _memory(work) | {"maps or volumes": _held(settings, media, found, light)},
    }
    report |= {"choice": choice.told()} if choice else {}
    return report | ({"measured": watch(loaded, integrator, spp)} if measure else {})


def _environment(light) -> dict:
    """Return the error of an environment that directional lights stand for, the sun of a ``sunsky`` left out."""
    cells = light.cells
    return {"emitter": environment.name(light.emitter, light.kind), "lights": int((cells.weight > 0).sum()),
            "radius_degrees": math.degrees(cells.radius), "irradiance_error_percent": 100 * cells.error()}


def works(integrator, media: list, found, rays: int, count: int, drawn: int) -> list[model.Work]:
    """Return the size of the render's work, for each medium."""
    method = found.visibility if found.needs_visibility else "none"
    radiosity = found.bounces == "radiosity"
    works = []
    for medium, seen in zip(media, found.in_view, strict=True):
        others = effects.others(integrator, rays, found.surfaces, found.bounces) if found.lit else 0
        work = model.work(integrator, medium, method, rays if seen else 0, count, drawn, others)
        work = replace(work, patches=model.patches(medium.field.grid) if radiosity else 0)
        works.append(work if found.lit else replace(work, points=0))
    return works


def _memory(works: list[model.Work]) -> dict[str, int]:
    chunk = CHUNK if all(w.opaque for w in works) else CHUNK // IN_SMOKE
    return _sum(model.memory(replace(w, rays=max(w.rays, 1)), chunk) for w in works)


def _held(integrator, media: list, found, light) -> int:
    """Bytes of the maps or volumes that are held at a time."""
    if not (found.lit and found.needs_visibility):
        return 0
    table, options = light.table(media[0].frame), building.options(integrator)
    first, last = building.parts(found.visibility, media, table, options)[0]
    sizes = [building.size_per_light(found.visibility, medium, table, options) for medium in media]
    own = [building.size_per_field(found.visibility, medium, table, options) for medium in media]
    return (last - first) * sum(sizes) + sum(own)


def _sum(stages) -> dict:
    total: dict = {}
    for each in stages:
        total = {name: total.get(name, 0) + value for name, value in each.items()}
    return total


def _effects(scene, found, integrator, count: int, suns: int) -> dict:
    """Each effect: whether it takes part, and the reason."""
    marched = f"; marched to {suns} that outshine the others" if suns and REGISTRY[found.visibility].per_field else ""
    use_map = found.needs_visibility and bool(REGISTRY[found.visibility].drawn)
    others = len(ordinary_shapes(scene))
    unlit = "no emitter has power" if found.emitters else "there is no emitter"
    answers = {
        "visibility": (found.needs_visibility and found.visibility != "none",
                       f"{found.visibility}: {found.reason}{marched}"),
        "every light at every point": (found.exhaustive, f"light_samples is {integrator.light_samples}"),
        "transmittance maps": (
            use_map,
            f"{count} lights of {integrator.map_resolution}² texels, source {integrator.map_source}"
            if use_map else "the camera sees what the light sees" if found.collocated and not found.needs_visibility
            else f"{found.visibility} needs none"),
        "view transmittance for light": (
            found.collocated, "all light comes from the camera" if found.collocated else "a light is elsewhere"),
        "environment background": (
            found.background, "an environment is visible" if found.background else
            "there is no environment" if scene.environment() is None else "emitters are hidden"),
        "shading": (found.lit, "the scene has lights" if found.lit else unlit),
        "specular lobe": (
            found.specular, "a field has one" if found.specular else "no field has one above the threshold"),
        "Fresnel effect": (
            found.fresnel, "a field was trained with it" if found.fresnel else "no field was trained with it"),
        "fields in view": (any(found.in_view), f"{sum(found.in_view)} of {len(found.in_view)}"),
        "ordinary surfaces": (
            found.surfaces, f"{others} shapes beside the fields' bounds" if others else "there are none"),
        "multiple scattering": (
            found.bounces, f"max_depth is {integrator.max_depth}" + (f", by {found.bounces}" if found.bounces else "")),
        "gradients": (found.gradients, "a parameter is attached" if found.gradients else "no parameter is attached"),
    }
    return {name: {"on": bool(on), "why": why} for name, (on, why) in answers.items()}


def print_table(report: dict) -> None:
    """The report for a reader."""
    console = Console()
    console = console if console.is_terminal else Console(width=120)
    image, real = report["image"], report.get("measured")
    console.print(
        f"{report['scene']}: {image['width']}×{image['height']}, {image['spp']} samples a pixel", highlight=False)
    for field in report["fields"]:
        console.print(f"field {field['file']} as {field['representation']}", highlight=False)
    for each in report["environments"]:
        console.print(
            f"{each['emitter']}: {each['lights']} directional lights of cells of "
            f"{each['radius_degrees']:.2g}° (RMS); what an unshadowed surface receives is right within "
            f"{each['irradiance_error_percent']:.2g} % of all light", highlight=False)
    table = Table("effect", "", "why")
    for name, effect in report["effects"].items():
        table.add_row(name, "yes" if effect["on"] else "–", effect["why"])
    console.print(table)
    if report.get("choice", {}).get("trials"):
        table = Table("tried", "predicted", "error", "verdict")
        for trial in report["choice"]["trials"]:
            error = "–" if math.isnan(trial["error"]) else f"{trial['error']:.2%}"
            table.add_row(trial["name"], f"{trial['seconds']:.3g} s", error, trial["why"])
        console.print(table)
    stages = {name: report["seconds"].get(name, 0.0) for name in real["stages"]} if real else report["seconds"]
    table = Table("stage", "predicted", *(["measured"] if real else []),
                  caption=f"prices of the machine: {report['constants']}; compilation is not counted")
    for name, value in stages.items():
        table.add_row(name, f"{value:.3g} s", *([f"{real['stages'][name]:.3g} s"] if real else []))
    table.add_row("all", f"{sum(stages.values()):.3g} s", *([f"{real['wall_seconds']:.3g} s"] if real else []))
    table.add_row("shading points", f"{report['points']:.3g}", *([f"{real['points']:.3g}"] if real else []))
    for name, size in report["memory_bytes"].items():
        table.add_row(f"memory: {name}", f"{size / 2**20:.0f} MiB", *([""] if real else []))
    if real:
        table.add_row("memory: all", f"{sum(report['memory_bytes'].values()) / 2**20:.0f} MiB",
                      f"{real['peak_bytes'] / 2**20:.0f} MiB")
    console.print(table)

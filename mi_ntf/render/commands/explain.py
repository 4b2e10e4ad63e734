"""The command ``mi-ntf explain``: what the ``nrf`` integrator will do with a scene, why, and at what cost."""

import math
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ...infer.visibility import REGISTRY
from .. import timing, user_cache
from ..lights import environment
from ..maps import building
from ..plugins.registration import load_scene
from ..scene import effects
from ..scene.media import find_media, ordinary_shapes
from ..scene.settings import Settings
from ..transport import candidates, choosing


def explain(scene: Path, parameters: dict[str, str], measure: bool = False) -> dict:
    """Load `scene` (with `parameters` for its $names) and describe its render.

    Parameters
    ----------
    scene
        A scene file with an ``nrf`` integrator.
    parameters
        Values of its $names.
    measure
        Render the scene, too.

    Returns
    -------
    dict
        ``fields`` (file, placement), ``lights`` (kinds, count), ``environments`` (of each that is summed: its
        ``lights``, their ``radius_degrees``, and the bound on the error of an unshadowed surface's irradiance, in
        percent of all light of that environment), ``effects`` (name → ``{"on": bool, "why": str}``), ``predicted`` by
        a pilot (``seconds`` without compilation, ``error`` against the march and its ``bound``), ``trials`` under
        limits, ``memory_bytes`` of the voxels and of maps or volumes, and ``measured`` (:func:`.timing.once`).

    Raises
    ------
    MiNtfError
        Where rendering would.
    """
    loaded = load_scene(scene, parameters)
    integrator, sensor, media = loaded.integrator(), loaded.sensors()[0], find_media(loaded)
    width, height = (int(v) for v in sensor.film().crop_size())
    spp = sensor.sampler().sample_count()
    with user_cache.switched("off"):
        choice = choosing.Chooser(loaded, Settings.of(integrator), integrator.limits, sensor, spp).explain()
    composition, described = choice.composition, choice.effects
    settings, light, count = composition.settings, composition.lights, len(composition.lights.rows.power)
    report = {
        "scene": str(scene),
        "image": {"width": width, "height": height, "spp": spp},
        "fields": [{"file": m.path, "representation": m.representation, "center": m.frame.origin.tolist(),
                    "radius": m.frame.length} for m in media],
        "lights": {"emitters": list(described.emitters), "count": count, "drawn": effects.drawn(settings, light)},
        "environments": [_environment(each) for each in light.discrete if each.cells],
        "visibility": described.visibility,
        "method": candidates.name(settings, Settings.of(integrator)),
        "effects": _effects(loaded, described, settings, count, light.suns().sum()),
        "predicted": choice.predicted,
        "trials": [vars(t) for t in choice.trials],
        "memory_bytes": {"voxels": sum(m.field.grid.nbytes for m in composition.media),
                         "maps or volumes": _held(composition)},
    }
    if measure:
        report["measured"] = _measured(loaded, integrator, spp)
    return report


def _measured(scene, integrator, spp: int) -> dict:
    """Render twice, since the first time may compile kernels; what is built is built anew."""
    with user_cache.switched("off"):
        timing.once(scene, integrator, spp, 1)
        integrator.patches = None
        return timing.once(scene, integrator, spp, 0)[1]


def _environment(light) -> dict:
    """Return the error of an environment that directional lights stand for, the sun of a ``sunsky`` left out."""
    cells = light.cells
    return {"emitter": environment.name(light.emitter, light.kind), "lights": int((cells.weight > 0).sum()),
            "radius_degrees": math.degrees(cells.radius), "irradiance_error_percent": 100 * cells.error()}


def _held(composition) -> int:
    """Return the bytes of the maps or volumes that are held at a time."""
    described, media = composition.effects, composition.media
    if not (described.lit and described.needs_visibility):
        return 0
    table, options = composition.lights.table(media[0].frame), building.options(composition.settings)
    first, last = building.parts(described.visibility, media, table, options)[0]
    sizes = [building.size_per_light(described.visibility, medium, table, options) for medium in media]
    own = [building.size_per_field(described.visibility, medium, table, options) for medium in media]
    return (last - first) * sum(sizes) + sum(own)


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
    """Print the report for a reader."""
    console = Console()
    console = console if console.is_terminal else Console(width=120)
    image = report["image"]
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
    if report["trials"]:
        console.print(_trials(report["trials"]))
    console.print(_costs(report))


def _trials(trials: list[dict]) -> Table:
    table = Table("tried", "seconds", "error", "error below", "verdict")
    for trial in trials:
        numbers = ["–"] * 3 if math.isnan(trial["bound"]) else [
            f"{trial['seconds']:.2g}", f"{trial['error']:.2%}", f"{trial['bound']:.2%}"]
        table.add_row(trial["name"], *numbers, trial["why"])
    return table


def _costs(report: dict) -> Table:
    predicted, measured = report["predicted"], report.get("measured")
    table = Table(report["method"], "predicted by a pilot", *(["measured"] if measured else []),
                  caption="seconds without the compilation of kernels; error against the march")

    def row(name: str, value: str, real: str = "") -> None:
        table.add_row(name, value, *([real] if measured else []))

    if predicted:
        real = f"{measured['wall_seconds'] - measured['compile_seconds']:.2g}" if measured else ""
        row("seconds", f"{predicted['seconds']:.2g}", real)
        row("error", f"{predicted['error']:.2%}, below {predicted['bound']:.2%}")
    for name, size in report["memory_bytes"].items():
        row(f"memory: {name}", f"{size / 2**20:.0f} MiB")
    if measured:
        row("memory: most that was held", "", f"{measured['peak_bytes'] / 2**20:.0f} MiB")
    return table

"""What the ``nrf`` integrator will do with a scene, and why, before any ray is traced: ``mi-ntf explain``."""

from pathlib import Path

import mitsuba as mi
from rich.console import Console
from rich.table import Table

from ..core.errors import MiNtfError
from ..infer.visibility.transmittance_map import channels
from . import effects, lights, register


def explain(scene: Path, parameters: dict[str, str]) -> dict:
    """Load `scene` (with `parameters` for its $names) and describe its render.

    Returns ``field`` (file, placement), ``lights`` (kinds, count), ``effects``: name → ``{"on": bool, "why": str}``,
    and ``memory_bytes`` of what is held beside the film. Raises MiNtfError where rendering would.
    """
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    register()
    loaded = mi.load_file(str(scene), **parameters)
    integrator = loaded.integrator()
    if not hasattr(integrator, "map_resolution"):
        raise MiNtfError(f'{scene}: its integrator is {integrator.class_name()}; explain reads <integrator type="nrf">')
    media = effects.find_media(loaded)
    medium = media[0]
    sensor = loaded.sensors()[0]
    width, height = (int(v) for v in sensor.film().size())
    spp = sensor.sampler().sample_count()
    light = lights.Lights(loaded, media, integrator.light_samples, integrator.environment_lights)
    found = effects.describe(loaded, integrator, sensor, spp, media, light)
    table = light.table(medium.frame) if found.exhaustive else None
    return {
        "scene": str(scene),
        "image": {"width": width, "height": height, "spp": spp},
        "field": {
            "file": medium.path,
            "representation": medium.representation,
            "center": medium.frame.origin.tolist(),
            "radius": medium.frame.length,
        },
        "lights": {"emitters": list(found.emitters), "count": table.count if table else integrator.light_samples},
        "visibility": found.visibility,
        "effects": _effects(loaded, found, table, integrator),
        "memory_bytes": _memory(found, table, integrator, medium),
    }


def _effects(scene, found, table, integrator) -> dict:
    """Each effect: whether it takes part, and the reason."""
    others = len(effects.ordinary_shapes(scene))
    shadow = found.visibility != "none"
    use_map = found.visibility == "transmittance_map"
    unlit = table is not None and table.count == 0
    return {
        "visibility": {"on": shadow and not unlit, "why": f"{found.visibility}: {found.reason}"},
        "every light at every point": {
            "on": found.exhaustive,
            "why": f"light_samples is {integrator.light_samples}",
        },
        "transmittance maps": {
            "on": use_map,
            "why": f"{table.count} lights of {integrator.map_resolution}² texels, source {integrator.map_source}"
            if use_map and table
            else f"{found.visibility} needs none",
        },
        "environment background": {
            "on": found.background,
            "why": "an environment is visible" if found.background else "no environment, or hide_emitters",
        },
        "shading": {"on": not unlit, "why": "no emitter has power" if unlit else "the scene has lights"},
        "ordinary surfaces": {
            "on": found.surfaces,
            "why": f"{others} shapes beside the fields' bounds" if others else "there are none",
        },
        "multiple scattering": {"on": found.bounces, "why": f"max_depth is {integrator.max_depth}"},
    }


def _memory(found, table, integrator, medium) -> dict:
    """Bytes held during the render, by what holds them."""
    from .integrator import CHUNK

    resolution = medium.field.grid.resolution
    maps = 0
    if found.visibility == "transmittance_map" and table:
        components = medium.field.network.components if integrator.map_source == "network" else 1
        maps = 4 * channels(components) * integrator.map_resolution**2 * table.count
    return {
        "field grid": 4 * resolution**3 + 32 * min(resolution, 128) ** 3,
        "transmittance maps": maps,
        # 20 floats a shading point, some ten points a ray at most on opaque fields.
        "rays in flight": CHUNK * 10 * 80,
    }


def print_table(report: dict) -> None:
    """The report for a reader."""
    console = Console()
    image, where = report["image"], report["field"]
    console.print(
        f"{report['scene']}: {image['width']}×{image['height']}, {image['spp']} samples a pixel", highlight=False
    )
    console.print(f"field {where['file']} as {where['representation']}", highlight=False)
    table = Table("effect", "", "why")
    for name, effect in report["effects"].items():
        table.add_row(name, "yes" if effect["on"] else "–", effect["why"])
    for name, size in report["memory_bytes"].items():
        table.add_row(f"memory: {name}", "", f"{size / 2**20:.0f} MiB")
    console.print(table)

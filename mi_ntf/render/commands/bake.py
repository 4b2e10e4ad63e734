"""``mi-ntf bake``: the transmittance maps of a scene, written to a file."""

import dataclasses
from pathlib import Path

import mitsuba as mi

from ...core import files
from ...core.errors import MiNtfError
from ...core.variants import VARIANTS
from ...infer.visibility import REGISTRY
from ..lights import scene_lights
from ..maps import building, map_cache, map_file
from ..plugins.registration import load_scene
from ..scene import loaded
from ..scene.media import find_media
from ..scene.settings import Settings


def bake(scene: Path, output: Path, parameters: dict[str, str]) -> dict:
    """Write the maps of all lights of `scene` (with `parameters` for its $names), made with the settings of its ``nrf``
    integrator; those of the field's own directions where its `visibility` is ``transmittance_atlas`` or
    ``neural_transmittance``. Returns ``file``, ``lights``, ``resolution``, ``components`` and ``bytes``.

    Raises MiNtfError where the scene has several media, or no lights that maps can be made for.
    """
    files.check(output)
    described = load_scene(scene, parameters)
    integrator, media = described.integrator(), find_media(described)
    if len(media) != 1:
        raise MiNtfError(f"{scene} has {len(media)} nrf media, and a map file belongs to one; bake them one by one")
    (medium,) = media
    known = REGISTRY.get(integrator.visibility)
    if known and known.per_field:
        atlas = building.build(known.name, medium, None, _options(integrator))
        return _written(output, medium, atlas.maps.lights, atlas.options, [atlas.maps])
    table = scene_lights.Lights(described, media, 0, integrator.environment_lights).table(medium.frame)
    if not table.count:
        raise MiNtfError(f"{scene} has no lights that maps can be made for (point, spot, directional, environment)")
    options = _options(building.resolved(Settings.of(integrator), table.count, media))
    runs = [table.part(*run) for run in building.parts("transmittance_map", media, table, options)]
    return _written(output, medium, table, options,
                    (building.build("transmittance_map", medium, run, options) for run in runs))


def bake_fields(path: Path, parameters: dict[str, str]) -> dict:
    """Put the voxels of a field file, or of all field files of a scene, into the files (`mi-ntf bake --baked`).

    Returns file → ``voxels`` and ``bytes``. Raises MiNtfError.
    """
    if path.suffix != ".safetensors":
        media = find_media(load_scene(path, parameters))
        wanted = {m.path: m.field.grid.resolution for m in media}
    else:
        if mi.variant() is None:
            mi.set_variant(*VARIANTS)
        wanted = {str(path): None}
    return {file: loaded.add_baked(Path(file), n) for file, n in wanted.items()}


def _options(settings) -> building.Options:
    return dataclasses.replace(building.options(settings), map_file="", cache=False)


def _written(output: Path, medium, table, options, maps) -> dict:
    map_file.write(output, medium, table, options, maps)
    return {"file": str(output), "lights": table.count, "resolution": options.map_resolution,
            "components": map_cache.components(medium, options), "bytes": output.stat().st_size}

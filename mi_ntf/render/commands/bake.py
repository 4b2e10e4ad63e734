"""``mi-ntf bake``: the transmittance maps of a scene, written to a file."""

import dataclasses
from pathlib import Path

from ...core import files
from ...core.errors import MiNtfError
from ...infer.visibility import REGISTRY
from ..lights import scene_lights
from ..maps import building, map_file
from ..plugins.registration import load_scene
from ..scene.media import find_media


def bake(scene: Path, output: Path, parameters: dict[str, str]) -> dict:
    """Write the maps of all lights of `scene` (with `parameters` for its $names), made with the settings of its ``nrf``
    integrator; those of the field's own directions where its `visibility` is ``transmittance_atlas`` or
    ``neural_transmittance``. Returns ``file``, ``lights``, ``resolution``, ``components`` and ``bytes``.

    Raises MiNtfError where the scene has several media, or no lights that maps can be made for.
    """
    files.check(output)
    loaded = load_scene(scene, parameters)
    integrator, media = loaded.integrator(), find_media(loaded)
    if len(media) != 1:
        raise MiNtfError(f"{scene} has {len(media)} nrf media, and a map file belongs to one; bake them one by one")
    (medium,) = media
    options = dataclasses.replace(building.options(integrator), map_file="", cache=False)
    known = REGISTRY.get(integrator.visibility)
    if known and known.per_field:
        atlas = building.build(known.name, medium, None, options)
        return _written(output, medium, atlas.maps.lights, atlas.options, [atlas.maps])
    table = scene_lights.Lights(loaded, media, 0, integrator.environment_lights).table(medium.frame)
    if not table.count:
        raise MiNtfError(f"{scene} has no lights that maps can be made for (point, spot, directional, environment)")
    runs = [table.part(*run) for run in building.parts("transmittance_map", media, table, options)]
    return _written(output, medium, table, options,
                    (building.build("transmittance_map", medium, run, options) for run in runs))


def _written(output: Path, medium, table, options, maps) -> dict:
    map_file.write(output, medium, table, options, maps)
    return {"file": str(output), "lights": table.count, "resolution": options.map_resolution,
            "components": map_file.components(medium, options), "bytes": output.stat().st_size}

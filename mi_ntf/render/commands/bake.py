"""The command ``mi-ntf bake``, which writes the transmittance maps of a scene to a file."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TypedDict, cast

import mitsuba as mi

from ...core import files, progress
from ...core.errors import MiNtfError
from ...core.quantities import size
from ...core.variants import VARIANTS
from ...infer.lights import LightTable
from ...infer.types import Visibility
from ...infer.visibility import REGISTRY
from ...infer.visibility.marched_begin import MarchedBegin
from ...infer.visibility.method import Options
from ...infer.visibility.transmittance_atlas import TransmittanceAtlas
from ...infer.visibility.transmittance_map import TransmittanceMap
from ..lights import scene_lights
from ..maps import building, map_cache, map_file
from ..plugins.registration import load_scene
from ..scene import loaded
from ..scene.environment_option import Environment
from ..scene.media import NRFMedium, find_media
from ..scene.settings import Settings
from ..transport.context import context_of


class MapFile(TypedDict):
    """Description of a map file: its path, number of lights, texels along a side, logistics per texel and size."""

    file: str
    lights: int
    resolution: int
    components: int
    bytes: int


def bake(scene: Path, output: Path, parameters: dict[str, str], environment: Environment | None = None) -> MapFile:
    """Write the maps of all lights of a scene, made with the settings of its ``nrf`` integrator.

    If its `visibility` is ``transmittance_atlas`` or ``neural_transmittance``, the maps are those of the field's own
    directions. `parameters`: values of the scene's $names; `environment`: changes of its environment. Raises MiNtfError
    if the scene has several media, or no lights for which maps can be made.
    """
    files.check(output)
    with progress.Stage(f"reading {scene}"):
        loaded_scene = load_scene(scene, parameters, environment)
    settings, media = context_of(loaded_scene).settings, find_media(loaded_scene)
    if len(media) != 1:
        raise MiNtfError(f"{scene} has {len(media)} nrf media, and a map file belongs to one; bake them one by one")
    with progress.Stage(f"baking {output}") as stage:
        return _bake(output, loaded_scene, settings, media, stage)


def _bake(output: Path, scene: mi.Scene, settings: Settings, media: list[NRFMedium], stage: progress.Stage) -> MapFile:
    (medium,) = media
    method = REGISTRY.get(settings.visibility)
    if method and method.per_field:
        atlas = cast(TransmittanceAtlas, _lookup(method.name, medium, None, _options(settings, medium)))
        return _write(output, medium, atlas.maps.lights, atlas.options, [atlas.maps])
    table = scene_lights.Lights(scene, media, 0, settings.environment_lights).table(medium.frame)
    if not table.count:
        raise MiNtfError("the scene has no lights that maps can be made for (point, spot, directional, environment)")
    settings = building.resolved(settings, table.count, media)
    options = _options(settings, medium)
    runs = [table.part(*run) for run in building.parts("transmittance_map", media, table, settings)]

    def maps() -> Iterator[TransmittanceMap]:
        for number, run in enumerate(runs):
            stage.update(number / len(runs))
            yield cast(TransmittanceMap, _lookup("transmittance_map", medium, run, options))

    return _write(output, medium, table, options, maps())


def print_maps(report: MapFile) -> None:
    """Print the file of :func:`bake`, and the use of it."""
    lights = f"{report['lights']} light{'s' if report['lights'] > 1 else ''}"
    print(f"map file: {report['file']} ({lights} of {report['resolution']}² texels, "
          f"{size(report['bytes'])})",
          f'next: <string name="map_file" value="{report["file"]}"/> in the integrator of the scene', sep="\n")


def print_fields(report: dict[str, dict[str, str | int]]) -> None:
    """Print the files of :func:`bake_fields`, and the use of them."""
    for file, about in report.items():
        print(f"field: {file} ({about['voxels']}³ voxels, {size(int(about['bytes']))})")
    print("next: render as before; the voxels are read from the file")


def bake_fields(path: Path, parameters: dict[str, str], environment: Environment | None = None
                ) -> dict[str, dict[str, str | int]]:
    """Write the voxels of a field file, or of all field files of a scene, into the files (`mi-ntf bake --baked`).

    Returns file → ``voxels`` and ``bytes``. Raises MiNtfError.
    """
    if path.suffix != ".safetensors":
        with progress.Stage(f"reading {path}"):
            media = find_media(load_scene(path, parameters, environment))
        trained = [m for m in media if m.field.trained]
        resolutions: dict[str, int | None] = {m.path: m.resolution for m in trained}
        for medium in trained:
            if medium.resolution != resolutions[medium.path]:
                raise MiNtfError(f"{path}: media of {medium.path} differ in resolution, but a file holds those of one; "
                                 "give all the same")
        if not resolutions:
            raise MiNtfError(f"{path} holds no trained field, and voxels of other fields are read as they are; render "
                             "it without baking")
    else:
        if mi.variant() is None:
            mi.set_variant(*VARIANTS)
        resolutions = {str(path): None}
    result = {}
    with progress.Stage("fields", len(resolutions), then="the same command goes on") as stage:
        for file, resolution in resolutions.items():
            result[file] = loaded.add_baked(Path(file), resolution)
            stage.advance()
    return result


def _lookup(method: str, medium: NRFMedium, table: LightTable | None, options: Options) -> Visibility | None:
    """Return a visibility method without the marches that renders add to it."""
    visibility = building.build(method, medium, table, options)
    return visibility.looked_up if isinstance(visibility, MarchedBegin) else visibility


def _options(settings: Settings, medium: NRFMedium) -> Options:
    return dataclasses.replace(building.options(settings, medium), map_file="", cache=False)


def _write(output: Path, medium: NRFMedium, table: LightTable, options: Options, maps: Iterable[TransmittanceMap]
           ) -> MapFile:
    map_file.write(output, medium, table, options, maps)
    return {"file": str(output), "lights": table.count, "resolution": options.map_resolution,
            "components": map_cache.components(medium, options), "bytes": output.stat().st_size}

"""Transmittance maps as EXR: ``mi-ntf bake``, and the integrator's ``map_file``.

A multi-part file, one part a light, float32 channels ``a`` and ``b`` (one logistic) or ``w0 a0 b0 w1 a1 b1`` (mixtures;
see :mod:`mi_ntf.core.mixture`), the light's rays along rows and columns as in
:mod:`mi_ntf.infer.visibility.light_rays`. The attribute ``mi_ntf`` of each part is JSON: the field's hash, the light's
place in field coordinates and how the map was made.
"""

import dataclasses
import json
import os
from pathlib import Path

import numpy as np
import OpenEXR

from ..core.errors import MiNtfError
from ..infer.visibility.light_rays import frames
from . import map_cache

ATTRIBUTE = "mi_ntf"


def bake(scene: Path, output: Path, parameters: dict[str, str]) -> dict:
    """Write the maps of all lights of `scene` (with `parameters` for its $names), made with the settings of its ``nrf``
    integrator. Returns ``file``, ``lights``, ``resolution``, ``components`` and ``bytes``.

    Raises MiNtfError where the scene has several media, or no lights that maps can be made for.
    """
    from . import effects, lights, load_scene, visibility

    loaded = load_scene(scene, parameters)
    integrator, media = loaded.integrator(), effects.find_media(loaded)
    if len(media) != 1:
        raise MiNtfError(f"{scene} has {len(media)} nrf media, and a map file belongs to one; bake them one by one")
    (medium,) = media
    table = lights.Lights(loaded, media, 0, integrator.environment_lights).table(medium.frame)
    if not table.count:
        raise MiNtfError(f"{scene} has no lights that maps can be made for (point, spot, directional, environment)")
    options = dataclasses.replace(visibility.options(integrator), map_file="", cache=False)
    runs = [table.part(*run) for run in visibility.parts("transmittance_map", media, table, options)]
    maps = (visibility.build("transmittance_map", medium, run, options) for run in runs)
    write(output, medium, table, options, maps)
    return {"file": str(output), "lights": table.count, "resolution": options.map_resolution,
            "components": _components(medium, options), "bytes": output.stat().st_size}


def write(path: Path, medium, table, options, maps) -> None:
    """Write `maps`, one after the other those of all lights of `table`, atomically."""
    if not path.absolute().parent.is_dir():
        raise MiNtfError(f"cannot write {path}: folder {path.parent} does not exist; create it first")
    shapes = [_shape(row, options.map_resolution)
              for row in frames(table, medium.field.grid.hull, options.map_resolution)]
    window = np.zeros(2, np.int32), np.array(shapes, np.int32).max(0)[::-1] - 1
    parts = []
    for tmap in maps:
        for values in np.array(tmap.values).reshape(tmap.count, -1, tmap.width):
            k = len(parts)
            lines, columns = shapes[k]
            texels = values[: lines * columns].reshape(lines, columns, tmap.width)
            header = {
                "name": f"light {k}", "type": OpenEXR.scanlineimage, "compression": OpenEXR.ZIP_COMPRESSION,
                "displayWindow": window, ATTRIBUTE: json.dumps(_description(medium, options) | _light(table, k)),
            }
            channels = {name: np.ascontiguousarray(texels[..., c]) for c, name in _names(tmap.width).items()}
            parts.append(OpenEXR.Part(header, channels))
    temporary = path.with_name(f".{path.name}.part.exr")
    OpenEXR.File(parts).write(str(temporary))
    os.replace(temporary, path)


def read(path: Path, medium, table, options, width: int) -> np.ndarray:
    """The numbers of the map that `path` holds, for a :class:`TransmittanceMap` of `table`'s lights, `width` a texel.

    Raises MiNtfError, naming file and scene, where it was made from another field, for other lights or with other
    settings.
    """
    if not path.is_file():
        raise MiNtfError(f"map_file {path} does not exist; make it with `mi-ntf bake SCENE.xml -o {path.name}`")
    try:
        parts = OpenEXR.File(str(path)).parts
    except RuntimeError as error:
        raise MiNtfError(f"map_file {path} is no EXR file ({error}); make it with `mi-ntf bake`") from None
    if len(parts) != table.total:
        raise MiNtfError(f"map_file {path} holds {len(parts)} lights, the scene has {table.total}; bake it anew")
    wanted = _description(medium, options)
    values = np.zeros((table.count, options.map_resolution**2, width), np.float32)
    parts = parts[table.first : table.first + table.count]
    rows = frames(table, medium.field.grid.hull, options.map_resolution)
    for k, (part, row) in enumerate(zip(parts, rows, strict=True)):
        if ATTRIBUTE not in part.header:
            raise MiNtfError(f"map_file {path} is an EXR file of another program; make it with `mi-ntf bake`")
        found = json.loads(part.header[ATTRIBUTE])
        _compare(path, k, found, wanted | _light(table, k))
        lines, columns = _shape(row, options.map_resolution)
        for c, name in _names(width).items():
            values[k, : lines * columns, c] = part.channels[name].pixels.reshape(-1)
    return values.ravel()


def _compare(path: Path, k: int, found: dict, wanted: dict) -> None:
    for name, value in wanted.items():
        other = found.get(name)
        same = np.allclose(other, value, rtol=1e-5, atol=1e-6) if name == "where" and other else other == value
        if not same:
            raise MiNtfError(f"map_file {path}, light {k}: {name} is {other}, the scene's is {value}; "
                             "bake it anew or render with the settings it was baked with")


def _components(medium, options) -> int:
    return medium.field.network.components if options.map_source == "network" else options.map_components


def _description(medium, options) -> dict:
    return {"field": map_cache.field_hash(medium.path), "representation": medium.representation,
            "grid": medium.field.grid.resolution, "map_resolution": options.map_resolution,
            "map_source": options.map_source, "map_components": _components(medium, options)}


def _light(table, k: int) -> dict:
    return {"kind": "point" if table.is_point[k] else "directional", "where": table.where[k].tolist()}


def _shape(row: np.ndarray, resolution: int) -> tuple[int, int]:
    """Lines and columns of the map of a light with this row."""
    return int((resolution**2 + 0.5) // row[11]), int(row[11])


def _names(width: int) -> dict[int, str]:
    """Place in a texel → channel."""
    if width == 2:
        return {0: "a", 1: "b"}
    return {4 * k + j: f"{name}{k}" for k in range(width // 4) for j, name in enumerate("wab")}

"""`mi-ntf export`: a field's surface as a mesh, with what it reflects, for Blender and other programs.

A PLY file has for each vertex, in this order:

    x y z                       scene units of the capture
    nx ny nz                    the field's normal
    red green blue alpha        albedo, sRGB, 8 bits: Blender's colour attribute `Col`
    albedo_r albedo_g albedo_b  the same, linear float; Mitsuba 3.9's `vertex_albedo_color`
    roughness                   as Blender's Principled BSDF has it: α = roughness²
    specular                    weight of the specular lobe

Source of the names: Blender's `io/ply/importer/ply_import_data.cc` (what is none of the standard names becomes a float
attribute of its name) and Mitsuba's plugin `ply`, which has no place for single numbers and says so.
"""

import importlib.util
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf.core import field_file, files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.srgb import encode
from mi_ntf.infer.backend import module
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.surface import RESOLUTIONS, Surface, surface

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
"""OBJ and GLB have colours, STL the shape alone."""

_SHAPE = """<shape type="ply">
    <string name="filename" value="{file}"/>
    <transform name="to_world"><matrix value="{place}"/></transform>
    <bsdf type="twosided">
        <bsdf type="blendbsdf">
            <float name="weight" value="{specular:.4g}"/>
            <bsdf type="diffuse">
                <texture type="mesh_attribute" name="reflectance">
                    <string name="name" value="vertex_albedo_color"/>
                </texture>
            </bsdf>
            <bsdf type="roughconductor">
                <string name="material" value="none"/>
                <string name="distribution" value="ggx"/>
                <float name="alpha" value="{alpha:.4g}"/>
            </bsdf>
        </bsdf>
    </bsdf>
</shape>
"""


def export(field: Path, output: Path, resolution: int = 256, level: float | None = None) -> dict[str, Any]:
    """Write the surface of a field file as a mesh, whose kind is that of `output`'s suffix.

    `resolution`: voxels per side of the field's unit sphere; `level`: density of the surface, 1/(unit-sphere radius),
    found where None (:func:`mi_ntf.infer.surface.surface`). Returns ``file``, ``vertices``, ``faces``, ``level``,
    ``size``: its sides in scene units, and the means of ``roughness`` and ``specular``. Raises MiNtfError.
    """
    field, output = Path(field), Path(output)
    if output.suffix.lower() not in SUFFIXES:
        raise MiNtfError(f"{output}: the name ends in {output.suffix!r}, expected one of {', '.join(SUFFIXES)}")
    if not RESOLUTIONS[0] <= resolution <= RESOLUTIONS[1]:
        raise MiNtfError(f"--resolution is {resolution}, expected {RESOLUTIONS[0]} to {RESOLUTIONS[1]} voxels per side")
    if level is not None and not 0 < level < np.inf:
        raise MiNtfError(f"--level is {level:g}, expected a positive density, 1/(radius of the field's sphere)")
    _libraries()
    files.check(output)
    header, tensors = field_file.load(field)
    dj = module("llvm_ad_rgb")
    found = surface(NetworkField(header, tensors, dj), resolution, level, dj)
    vertices = found.vertices * header.similarity.radius + np.array(header.similarity.center)
    files.write(output, _encoded(found, vertices, output.suffix.lower()))
    return {"file": str(output), "vertices": len(vertices), "faces": len(found.faces), "level": found.level,
            "size": np.ptp(vertices, axis=0).round(6).tolist(),
            "roughness": float(found.roughness.mean()), "specular": float(found.specular.mean())}


def mitsuba_shape(mesh: Path, made: dict[str, Any], to_world: np.ndarray) -> str:
    """Return the ``<shape>`` of a PLY file for Mitsuba's stock integrators.

    Parameters
    ----------
    mesh
        The file as the XML names it.
    made
        What :func:`export` returned for it; roughness and specular weight are the same all over the mesh, since the
        plugin ``ply`` has no place for single numbers.
    to_world
        (4, 4) matrix from the capture's coordinates to the scene's.
    """
    return _SHAPE.format(file=escape(str(mesh)), place=" ".join(f"{value:.9g}" for value in to_world.ravel()),
                         specular=made["specular"], alpha=made["roughness"] ** 2)


def _libraries() -> None:
    missing = [name for name in ("skimage", "scipy", "trimesh") if importlib.util.find_spec(name) is None]
    if missing:
        raise MiNtfError(f"meshes need scikit-image, SciPy and trimesh, and {', '.join(missing)} is missing: "
                         "pip install 'mi-ntf[mesh]'")


def _encoded(found: Surface, vertices: np.ndarray, suffix: str) -> Any:
    """The file's contents."""
    import trimesh

    # Colours of glTF are linear, those of the others are shown as they are.
    colours = found.albedo if suffix == ".glb" else encode(np, found.albedo)
    alpha = np.ones((len(vertices), 1))
    mesh = trimesh.Trimesh(vertices, found.faces, vertex_normals=found.normals, process=False,
                           vertex_colors=np.round(255 * np.concatenate([colours, alpha], 1)).astype(np.uint8))
    if suffix == ".ply":
        names = ("albedo_r", "albedo_g", "albedo_b", "roughness", "specular")
        values = (*found.albedo.T, found.roughness, found.specular)
        mesh.vertex_attributes.update(dict(zip(names, map(np.ascontiguousarray, values), strict=True)))
    return mesh.export(file_type=suffix[1:])

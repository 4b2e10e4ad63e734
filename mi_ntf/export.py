"""`mi-ntf export`: a field's surface as a mesh with its reflectance, for Blender and other programs.

A PLY file has for each vertex, in this order:

    x y z                       scene units of the capture
    nx ny nz                    the field's normal
    red green blue alpha        albedo, sRGB, 8 bits: Blender's colour attribute `Col`
    albedo_r albedo_g albedo_b  the same, linear float; Mitsuba 3.9's `vertex_albedo_color`
    roughness                   as Blender's Principled BSDF has it: α = roughness²
    specular_r specular_g specular_b  weight of the specular lobe, linear; `vertex_specular_color`

Source of the names: Blender's `io/ply/importer/ply_import_data.cc`, where other than standard names become float
attributes, and Mitsuba's plugin `ply`, which ignores attributes of a single number and warns about them.
"""

from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np

from mi_ntf.core import extras, field_file, files, progress, voxels
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.srgb import encode
from mi_ntf.infer.backend import module
from mi_ntf.infer.network import NetworkField
from mi_ntf.infer.surface import RESOLUTIONS, Surface, surface
from mi_ntf.infer.volume import of_file

SUFFIXES = (".ply", ".obj", ".glb", ".stl")
"""Endings of files. OBJ and GLB have colours, STL has the shape alone."""

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
                <rgb name="specular_reflectance" value="{colour}"/>
            </bsdf>
        </bsdf>
    </bsdf>
</shape>
"""


@dataclass(frozen=True)
class MeshFile:
    """Figures of a mesh: `size` in scene units; `roughness` and `specular` (linear RGB), means over the vertices."""

    file: str
    vertices: int
    faces: int
    level: float
    size: list[float]
    roughness: float
    specular: list[float]


def export(field: Path, output: Path, resolution: int = 256, level: float | None = None) -> MeshFile:
    """Write the surface of a field file as a mesh, in the format of `output`'s suffix.

    `resolution` is the number of voxels per side of the field's unit sphere, `level` the density of the surface,
    1/(unit-sphere radius). None chooses it (:func:`mi_ntf.infer.surface.surface`). Raises MiNtfError if an argument is
    out of range, or the field has no surface.
    """
    field, output = Path(field), Path(output)
    if not RESOLUTIONS[0] <= resolution <= RESOLUTIONS[1]:
        raise MiNtfError(f"--resolution is {resolution}, expected {RESOLUTIONS[0]} to {RESOLUTIONS[1]} voxels per side")
    if level is not None and not 0 < level < np.inf:
        raise MiNtfError(f"--level is {level:g}, expected a positive density, 1/(radius of the field's sphere)")
    extras.need("mesh", "a mesh")
    files.check(output, SUFFIXES)
    with progress.Stage(f"making {output}") as stage:
        header, dj = field_file.load_header(field), module("llvm_ad_rgb")
        density = (of_file(header, voxels.load(field, header), dj) if isinstance(header, voxels.Voxels)
                   else NetworkField(*field_file.load(field), dj))
        mesh = surface(density, resolution, level, dj, stage.update)
        vertices = mesh.vertices * header.similarity.radius + np.array(header.similarity.center)
        files.write(output, _encoded(mesh, vertices, output.suffix.lower()))
    return MeshFile(str(output), len(vertices), len(mesh.faces), mesh.level, np.ptp(vertices, axis=0).round(6).tolist(),
                    float(mesh.roughness.mean()), mesh.specular.mean(0, np.float64).round(6).tolist())


def print_summary(mesh: MeshFile) -> None:
    """Print the file, the figures of the mesh, and the use of it."""
    size = " × ".join(f"{length:.3g}" for length in mesh.size)
    specular = ", ".join(dict.fromkeys(f"{value:.2f}" for value in mesh.specular))
    print(f"mesh: {mesh.file} ({mesh.vertices} vertices, {mesh.faces} faces, {size} in scene units)",
          f"surface: at density {mesh.level:.3g}; mean roughness {mesh.roughness:.2f}, specular {specular}",
          f"next: import {mesh.file} in Blender or another program", sep="\n")


def mitsuba_shape(path: Path, mesh: MeshFile, to_world: np.ndarray) -> str:
    """Return the ``<shape>`` of a PLY file for Mitsuba's stock integrators.

    `path` is the file as the XML names it, `mesh` the result of :func:`export`. Its mean roughness and specular weight
    hold all over the mesh, because the plugin ``ply`` has no attributes of a single number. `to_world` is the (4, 4)
    matrix from the capture's coordinates to the scene's.
    """
    weight = max(*mesh.specular, 1e-6)
    colour = ", ".join(f"{value / weight:.4g}" for value in mesh.specular)
    return _SHAPE.format(file=escape(str(path)), place=" ".join(f"{value:.9g}" for value in to_world.ravel()),
                         specular=weight, colour=colour, alpha=mesh.roughness**2)


def _encoded(surface: Surface, vertices: np.ndarray, suffix: str) -> bytes | str:
    """Return the contents of the file."""
    import trimesh

    # Colours of glTF are linear, those of the other formats are sRGB.
    colours = surface.albedo if suffix == ".glb" else encode(np, surface.albedo)
    alpha = np.ones((len(vertices), 1))
    mesh = trimesh.Trimesh(vertices, surface.faces, vertex_normals=surface.normals, process=False,
                           vertex_colors=np.round(255 * np.concatenate([colours, alpha], 1)).astype(np.uint8))
    if suffix == ".ply":
        names = ("albedo_r", "albedo_g", "albedo_b", "roughness", "specular_r", "specular_g", "specular_b")
        values = (*surface.albedo.T, surface.roughness, *surface.specular.T)
        mesh.vertex_attributes.update(dict(zip(names, map(np.ascontiguousarray, values), strict=True)))
    contents = mesh.export(file_type=suffix[1:])
    assert isinstance(contents, bytes | str)  # not a dict, as for other formats
    return contents

"""Objects of other people, photographed, trained and relit: ``results/objects.json``.

    python -m benchmarks.objects [--only horse-metal spot-principled …] [--work out/objects] [--views 100] [--size 256]
                                 [--minutes 10 | --steps N]

Eight meshes × four materials. Each object is photographed with a flash, trained for ten minutes, and rendered by
``nrf`` and, as meshes, by ``path``, both with all bounces, under five lights. A row has the errors to the meshes: raw,
after one factor a colour channel (aligned), and of the mean. The folder `--work` keeps photographs, fields, pictures
and rows; what is there is not made again, so the same command goes on after an interruption. All 32 objects take about
8 hours on two cores.

The meshes come from https://github.com/alecjacobson/common-3d-test-models, the environment maps (CC0, Poly Haven) from
https://github.com/pmndrs/drei-assets. They are downloaded into ``WORK/data`` unless they are there.
"""

import json
import subprocess
import sys
import time
import urllib.request
import zipfile
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from mi_ntf.core import files
from mi_ntf.evaluate import metrics

from . import record

MODELS = "https://raw.githubusercontent.com/alecjacobson/common-3d-test-models/master/data/"
MAPS = "https://raw.githubusercontent.com/pmndrs/drei-assets/master/hdri/"
MESHES = {
    "horse": ("horse.zip", "horse.ply", "Cyberware, Large Geometric Models Archive of Georgia Tech", (-90, 60)),
    "spot": ("spot.zip", "spot/spot_triangulated.obj", "Keenan Crane, CC0", (0, 180)),
    "fandisk": ("fandisk.obj", "fandisk.obj", "Hugues Hoppe, a part of Pratt & Whitney's", (0, 0)),
    "rocker-arm": ("rocker-arm.obj", "rocker-arm.obj", "INRIA, AIM@SHAPE repository", (0, 60)),
    "bunny": ("stanford-bunny.obj", "stanford-bunny.obj", "Stanford 3D Scanning Repository", (0, 0)),
    "cheburashka": ("cheburashka.obj", "cheburashka.obj", "Ilya Baran", (0, 0)),
    "nefertiti": ("nefertiti.obj", "nefertiti.obj", "Nelles and Al-Badri, Egyptian Museum of Berlin, CC0", (-90, 0)),
    "ogre": ("ogre.obj", "ogre.obj", "Kiaran Ritchie", (0, 0)),
}
"""Name → file in the collection, mesh within it, source, and rotation in degrees about x and y that makes it upright
and face the camera."""
CREASE = np.radians(30)
"""Angle between triangles from which an edge is sharp."""
PAINT = """<texture type="mesh_attribute" name="{}"><string name="name" value="vertex_color"/></texture>"""
MATERIALS = {
    "diffuse": f"""<bsdf type="diffuse">{PAINT.format("reflectance")}</bsdf>""",
    "plastic": """<bsdf type="roughplastic"><rgb name="diffuse_reflectance" value="0.1, 0.25, 0.5"/>
        <float name="alpha" value="0.25"/></bsdf>""",
    "principled": f"""<bsdf type="principled">{PAINT.format("base_color")}<float name="roughness" value="0.5"/>
        <float name="specular" value="0.5"/></bsdf>""",
    "metal": """<bsdf type="roughconductor"><string name="material" value="Cu"/><float name="alpha" value="0.35"/>
        </bsdf>""",
    "gold": """<bsdf type="roughconductor"><string name="material" value="Au"/><float name="alpha" value="0.35"/>
        <string name="distribution" value="ggx"/></bsdf>""",
}
"""The first four are of the table; gold can be asked for by name."""
FLASH = (-1.1, 0.9, 3.6)
LIGHTS = {
    "flash": """<emitter type="point" id="light"><point name="position" value="-1.1, 0.9, 3.6"/>
        <rgb name="intensity" value="40"/></emitter>""",
    "lamp": """<emitter type="point" id="light"><point name="position" value="2.2, 2.8, 2.4"/>
        <rgb name="intensity" value="55, 50, 45"/></emitter>""",
    "sky": """<emitter type="sunsky" id="light"><vector name="sun_direction" value="0.6, 0.6, 0.5"/>
        <float name="sky_scale" value="0.05"/><float name="sun_scale" value="0.05"/><transform name="to_world">
        <rotate x="1" angle="-90"/></transform></emitter>""",
    "indoor": """<emitter type="envmap" id="light"><string name="filename" value="../data/st_fagans_interior_1k.hdr"/>
        </emitter>""",
    "outdoor": """<emitter type="envmap" id="light"><string name="filename" value="../data/kiara_1_dawn_1k.hdr"/>
        </emitter>""",
    "constant": """<emitter type="constant" id="light"><rgb name="radiance" value="1"/></emitter>""",
}
"""The first five are of the table; the last is the test of energy."""
SCENE = """<scene version="3.9.0">
    <default name="spp" value="64"/> <default name="res" value="{size}"/> <default name="light" value="lamp"/>
    <integrator type="path"> <boolean name="hide_emitters" value="true"/> </integrator>
    <sensor type="perspective" id="camera">
        <float name="fov" value="32"/>
        <transform name="to_world"> <lookat origin="-1.1, 0.9, 3.6" target="0, 0, 0" up="0, 1, 0"/> </transform>
        <sampler type="independent"> <integer name="sample_count" value="$spp"/> </sampler>
        <film type="hdrfilm">
            <integer name="width" value="$res"/> <integer name="height" value="$res"/>
            <string name="pixel_format" value="rgba"/> <rfilter type="box"/>
        </film>
    </sensor>
    <include filename="light_$light.xml"/>
    <shape type="ply" id="object">
        <string name="filename" value="mesh.ply"/>
        <bsdf type="twosided">{material}</bsdf>
    </shape>
</scene>
"""
SAMPLES = {"meshes": 512, "field": 64}
"""Samples a pixel."""


def fetched(folder: Path, address: str) -> Path:
    """Return a file of the web in `folder`, downloaded unless it is there; archives are unpacked beside it."""
    path = folder / address.rpartition("/")[2]
    if not path.is_file():
        files.make_folder(folder)
        print(f"downloading {address}", flush=True)
        with urllib.request.urlopen(address) as answer:
            files.write(path, answer.read())
    if path.suffix == ".zip":
        zipfile.ZipFile(path).extractall(folder)
    return path


def write_mesh(path: Path, data: Path, name: str) -> None:
    """Write a mesh with painted vertices, upright, its bounding sphere of radius 1 around the origin."""
    import trimesh

    file, member, _, (x, y) = MESHES[name]
    fetched(data, MODELS + file)
    mesh = trimesh.load(data / member, force="mesh", process=True, merge_tex=True, merge_norm=True)
    for angle, axis in ((x, [1, 0, 0]), (y, [0, 1, 0])):
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(angle), axis))
    mesh.apply_translation(-mesh.bounds.mean(0))
    mesh.apply_scale(1 / np.linalg.norm(mesh.vertices, axis=1).max())
    mesh = trimesh.graph.smooth_shade(mesh, angle=CREASE)
    v, n = mesh.vertices, mesh.vertex_normals
    colour = 0.45 + 0.25 * np.sin(v @ np.array([[7, 2, -4], [-3, 6, 5], [4, -5, 6]]) + [0, 1, 2])
    result = mi.Mesh(name, len(v), len(mesh.faces), has_vertex_normals=True)
    result.add_attribute("vertex_color", 3, colour.ravel().astype(np.float32))
    values = mi.traverse(result)
    values["vertex_positions"], values["vertex_normals"] = v.ravel().astype(np.float32), n.ravel().astype(np.float32)
    values["faces"] = mesh.faces.ravel().astype(np.uint32)
    values.update()
    result.write_ply(str(path))


def write_scene(folder: Path, data: Path, name: str, material: str, size: int) -> Path:
    """Write the scene of meshes and its lights into `folder`, and return its file."""
    files.make_folder(folder)
    for address in ("st_fagans_interior_1k.hdr", "kiara_1_dawn_1k.hdr"):
        fetched(data, MAPS + address)
    if not (folder / "mesh.ply").is_file():
        write_mesh(folder / "mesh.ply", data, name)
    for light, text in LIGHTS.items():
        (folder / f"light_{light}.xml").write_text(f'<scene version="3.9.0">{text}</scene>\n')
    (folder / "mesh.xml").write_text(SCENE.format(size=size, material=MATERIALS[material]))
    return folder / "mesh.xml"


def run(folder: Path, *words: object) -> None:
    """Run a `mi-ntf` command in `folder`. Raises CalledProcessError if it fails."""
    print("$ mi-ntf", *words, flush=True)
    subprocess.run([sys.executable, "-m", "mi_ntf", *map(str, words)], cwd=folder, check=True)


def trained(folder: Path, views: int, size: int, length: tuple[str, str]) -> None:
    """Photograph the meshes in `folder`, train a field, and write the scene that holds it, as far as they lack."""
    if not (folder / "field.safetensors").is_file():
        run(folder, "capture", "mesh.xml", "photographs", "--views", views, "--size", size)
        run(folder, "train", "photographs", "-o", "field.safetensors", *length)
    if not (folder / "scene.xml").is_file():
        run(folder, "swap", "mesh.xml", "field.safetensors", "-o", "scene.xml")


def picture(folder: Path, scene: str, light: str) -> np.ndarray:
    """Return the picture (h, w, 4) of ``mesh.xml`` or ``scene.xml`` under a light, kept in the folder."""
    of = "meshes" if scene == "mesh.xml" else "field"
    path = folder / f"{of}_{light}.exr"
    if not path.is_file():
        loaded = mi.load_file(str(folder / scene), light=light)
        nrf = {"type": "nrf", "visibility": "raymarch", "max_depth": -1, "hide_emitters": True}
        stock = {"type": "path", "hide_emitters": True}
        image = mi.render(loaded, integrator=mi.load_dict(stock if of == "meshes" else nrf), spp=SAMPLES[of])
        mi.Bitmap(image).write(str(path))
        mi.Bitmap(image).convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True).write(
            str(path.with_suffix(".png")))
    return np.array(mi.Bitmap(str(path)), np.float64)


def row(folder: Path, light: str) -> dict[str, Any]:
    """Return the errors of the field to the meshes under a light."""
    ours, theirs = picture(folder, "scene.xml", light), picture(folder, "mesh.xml", light)
    image, reference, mask = ours[..., :3], theirs[..., :3], theirs[..., 3] > 0.5
    aligned = image * metrics.alignment(image, reference, mask)
    mean = image[mask].mean(0) / reference[mask].mean(0)
    return {"light": light, "relative_rmse": metrics.relative_rmse(image, reference),
            "aligned": metrics.relative_rmse(aligned, reference), "psnr": metrics.psnr(image, reference),
            "ssim": metrics.ssim(image, reference), "mean": [float(c) for c in mean]}


def measured(work: Path, name: str, lights: list[str], views: int, size: int, length: tuple[str, str]
             ) -> list[dict[str, Any]]:
    """Return the rows of an object, called MESH-MATERIAL."""
    mesh, _, material = name.rpartition("-")
    folder, start = work / name, time.perf_counter()
    write_scene(folder, work / "data", mesh, material, size)
    trained(folder, views, size, length)
    rows = [{"object": name, **row(folder, light)} for light in lights]
    for r in rows:
        print(f"{name} {r['light']}: relative RMSE {r['relative_rmse']:.1%}, aligned {r['aligned']:.1%}, "
              f"{r['psnr']:.1f} dB, SSIM {r['ssim']:.3f}, mean {', '.join(f'{c - 1:+.1%}' for c in r['mean'])}",
              flush=True)
    (folder / "rows.json").write_text(json.dumps(rows, indent=1))
    print(f"{name}: {time.perf_counter() - start:.0f} s", flush=True)
    return rows


def main() -> None:
    """Measure and write the results."""
    table = [f"{mesh}-{material}" for mesh in MESHES for material in list(MATERIALS)[:4]]
    every = [f"{mesh}-{material}" for mesh in MESHES for material in MATERIALS]
    options = record.options(
        __doc__, ("--only", {"nargs": "+", "default": table, "choices": every, "metavar": "MESH-MATERIAL"}),
        ("--lights", {"nargs": "+", "default": list(LIGHTS)[:5], "choices": LIGHTS}),
        ("--work", {"type": Path, "default": Path("out/objects")}), ("--views", {"type": int, "default": 100}),
        ("--size", {"type": int, "default": 256}), ("--minutes", {"type": float, "default": 10.0}),
        ("--steps", {"type": int, "default": None}))
    start = time.perf_counter()
    views, size = (6, 32) if options.quick else (options.views, options.size)
    steps = 3 if options.quick else options.steps
    length = ("--minutes", str(options.minutes)) if steps is None else ("--steps", str(steps))
    record.prepare("memory")
    rows = [r for name in options.only for r in measured(options.work, name, options.lights, views, size, length)]
    values = {"views": views, "size": size, "length": " ".join(length), "rows": rows,
              "sources": {name: source for name, (_, _, source, _) in MESHES.items()}}
    record.write("objects", values, start, options.out)


if __name__ == "__main__":
    main()

"""A virtual camera with a flash: photographs any ordinary Mitsuba scene, surfaces or media, into a data set (`schema`).

Every view has a point light exactly at the camera (collocated capture, method of Bi et al. 2020), or at one place
beside it, as flashes are. At the camera the light's transmittance is the view's: a medium of density σ dims it twice,
L = ∫ σ_s f T² I/t² dt. Alpha is the opacity: the share of paths that meet matter. The scene's own sensors and emitters
are left out; its shapes, media, materials and, where it suits them, its integrator are kept. The one file of `data`
that uses Mitsuba.
"""

import hashlib
import json
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from mi_ntf import jobs
from mi_ntf.core import files, spheres
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS, enough_threads
from mi_ntf.data import schema
from mi_ntf.data.bounds import bounding_sphere

DISTANCE = 3.2  # camera to object's centre, in radii of the bounding sphere
MARGIN = 1.04   # bounding sphere over the object's extent: room for a soft surface in the field
SURFACE_INTEGRATORS = {"PathIntegrator", "DirectIntegrator"}
VOLUME_INTEGRATORS = {"VolumetricPathIntegrator", "VolpathMisIntegratorImpl"}  # class names of volpath and volpathmis


def view_directions(count: int, rng: np.random.Generator) -> np.ndarray:
    """Unit directions (count, 3) from the object to the cameras: a Fibonacci lattice, turned at random."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    lattice = spheres.fibonacci(count, 0.5) * (1, -1, 1)
    return lattice @ (q * np.sign(np.diag(r))).T


def camera_to_world(position: np.ndarray, target: np.ndarray) -> np.ndarray:
    """OpenGL camera-to-world (4, 4) of a camera at `position` that looks at `target`, y up (z at the poles)."""
    back = (position - target) / np.linalg.norm(position - target)
    right = np.cross((0.0, 1.0, 0.0) if abs(back[1]) < 0.99 else (0.0, 0.0, 1.0), back)
    right /= np.linalg.norm(right)
    c2w = np.eye(4)
    c2w[:3, :] = np.stack([right, np.cross(back, right), back, position], -1)
    return c2w


def _load(path: Path):
    """The scene's shapes that emit no light, and an integrator that sees them: its own where it is a path tracer, for
    media a volumetric one, else `path` or `volpath` of depth 6."""
    import drjit as dr
    import mitsuba as mi

    enough_threads(dr)
    variant = mi.variant()
    if variant is None:
        mi.set_variant(*VARIANTS)
    elif "rgb" not in variant:
        raise MiNtfError(f"variant '{variant}' is active; photographs are linear RGB: set an rgb variant "
                         "such as llvm_ad_rgb")
    if not Path(path).is_file():
        raise MiNtfError(f"{path} does not exist; name a Mitsuba scene file (.xml)")
    scene = mi.load_file(str(path))
    if not isinstance(scene, mi.Scene):
        raise MiNtfError(f"{path}: holds a {type(scene).__name__}, not a scene; the root element must be <scene>")
    shapes = [shape for shape in scene.shapes() if not shape.is_emitter()]
    if not shapes:
        raise MiNtfError(f"{path}: no shapes that reflect light ({len(scene.shapes())} emitters); "
                         "add the object to photograph")
    around = [shape.id() for shape in shapes if shape.exterior_medium()]
    if around:
        raise MiNtfError(f"{path}: shape '{around[0]}' has an exterior medium, in which the cameras would stand; give "
                         "the medium to a bounding shape as its interior")
    media = any(shape.interior_medium() for shape in shapes)
    integrator = scene.integrator()
    if integrator is None or integrator.class_name() not in VOLUME_INTEGRATORS | (set() if media else
                                                                                   SURFACE_INTEGRATORS):
        integrator = mi.load_dict({"type": "volpath" if media else "path", "max_depth": 6, "hide_emitters": True})
    return sorted(shapes, key=lambda shape: (_fingerprint(shape), shape.id())), integrator  # Mitsuba's order is chance


def _outline(shapes: list) -> np.ndarray:
    """Points (P, 3) whose hull holds every shape: the vertices of meshes, points all over spheres (within 0.5 %), the
    box corners of everything else. Media count by the shapes that bound them."""
    import mitsuba as mi

    points = []
    for shape in shapes:
        params = mi.traverse(shape)
        if "vertex_positions" in params:  # a rectangle calls itself a mesh and has none
            points.append(np.array(params["vertex_positions"]).reshape(-1, 3))
        elif shape.shape_type() == int(mi.ShapeType.Sphere):
            to_world = np.array(params["to_world"].matrix).reshape(4, 4)
            lattice = view_directions(1000, np.random.default_rng(0))
            points.append(lattice @ to_world[:3, :3].T + to_world[:3, 3])
        else:
            points.append(np.array([np.array(shape.bbox().corner(i)).ravel() for i in range(8)]))
    return np.concatenate(points).astype(np.float64)


def _fingerprint(thing) -> str:
    """Hash of all parameters of a Mitsuba object (vertices, materials): tells a changed one from the same one."""
    import mitsuba as mi

    digest = hashlib.sha256()
    for key, value in sorted(mi.traverse(thing), key=lambda item: item[0]):
        digest.update(key.encode())
        digest.update(np.array(value).tobytes() if hasattr(value, "__len__") else repr(value).encode())
    return digest.hexdigest()[:16]


def _studio(shapes: list, integrator, angle: float, size: int):
    """Scene of the shapes with a perspective camera (box filter, RGBA) and a point light, both still to be placed."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "component_format": "float32",
            "rfilter": {"type": "box"}}
    contents = {f"shape_{i:04d}": shape for i, shape in enumerate(shapes)}
    return mi.load_dict({
        "type": "scene",
        "integrator": integrator,
        "sensor": {"type": "perspective", "fov": float(np.degrees(angle)), "near_clip": 1e-4, "far_clip": 1e6,
                   "film": film, "sampler": {"type": "independent"}},
        "light": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
        **contents,
    })


def _open_manifest(out: Path, settings: dict) -> None:
    """Note the settings in `capture.json`, or hold them against those of the run that this one resumes."""
    path = out / "capture.json"
    if path.exists():
        try:
            before = {"flash_offset": [0.0, 0.0, 0.0]} | dict(json.loads(path.read_bytes()))  # older ones do not say
        except (ValueError, TypeError, RecursionError) as error:
            raise MiNtfError(f"{path}: cannot be read ({error}), so what this folder was captured with is not known; "
                             "use another folder or delete this one") from None
        for key, value in settings.items():
            if before.get(key) != value:
                raise MiNtfError(f"{path}: this folder was captured with {key} = {before.get(key)}, now {key} = "
                                 f"{value}; use another folder, delete this one, or give the former value to resume")
        return
    files.write(path, json.dumps(settings, indent=1) + "\n")


def _plan(counts: dict[str, int], center: np.ndarray, radius: float, offset: np.ndarray,
          seed: int) -> dict[str, list[schema.Frame]]:
    """The frames of every split; the flash, at `offset` from the lens, has I = pi d^2: a white diffuse surface at the
    centre that faces it has radiance 1."""
    rng = np.random.default_rng(seed)
    distance = DISTANCE * radius
    beside = offset * (1.0, 1.0, -1.0)
    intensity = np.full(3, np.pi * float(((beside + np.array([0, 0, distance])) ** 2).sum()))
    plan = {}
    for split, count in counts.items():
        poses = [camera_to_world(center + distance * d, center) for d in view_directions(count, rng)]
        plan[split] = [schema.Frame(f"{split}/{i:04d}.exr", c2w, c2w[:3, 3] + c2w[:3, :3] @ beside, intensity)
                       for i, c2w in enumerate(poses)]
    return plan


@dataclass(frozen=True)
class Request:
    """Settings of :func:`capture`. `variant`: Mitsuba's; `object`: the fingerprint of what is photographed."""

    scene: Path
    out: Path
    views: int
    size: int
    test_views: int
    spp: int
    seed: int
    flash_offset: tuple[float, float, float]
    variant: str = ""
    object: str = ""


class Session:
    """The studio and the frames of a request, and the photographs one by one. Raises MiNtfError."""

    def __init__(self, request: Request):
        import mitsuba as mi

        if request.variant:
            mi.set_variant(request.variant)
        shapes, integrator = _load(request.scene)
        self.center, radius = bounding_sphere(_outline(shapes))
        self.radius = MARGIN * radius
        self.angle = float(2.0 * np.arcsin(1.0 / DISTANCE))
        self.studio = _studio(shapes, integrator, self.angle, request.size)
        self.request = replace(request, variant=str(mi.variant()), object=_fingerprint(self.studio))
        self.offset = np.array(request.flash_offset, dtype=np.float64)
        far = DISTANCE * self.radius
        if self.offset.shape != (3,) or not np.isfinite(self.offset).all() or self.offset[2] > 0.5 * far:
            raise MiNtfError(f"capture: flash_offset is {request.flash_offset}, must be three finite lengths right,up,"
                             f"forward of the lens, forward at most half of the way to the object ({far:.4g})")
        counts = {"train": request.views, "val": max(4, request.views // 20), "test": request.test_views}
        self.plan = _plan(counts, self.center, self.radius, self.offset, request.seed)
        self.frames = [frame for split in self.plan.values() for frame in split]
        self._params = mi.traverse(self.studio)

    def photograph(self, index: int) -> None:
        """Render and write frame `index`."""
        import mitsuba as mi

        request, frame = self.request, self.frames[index]
        self._params["sensor.to_world"] = mi.Transform4f(mi.Matrix4f(schema.mitsuba_to_opengl(frame.c2w).tolist()))
        self._params["light.position"] = mi.Point3f(frame.light_pos.tolist())
        self._params["light.intensity.value"] = mi.Color3f(frame.light_intensity.tolist())
        self._params.update()
        stream: Any = request.seed * len(self.frames) + index  # a number, where Mitsuba's stub asks for an array
        image = np.array(mi.render(self.studio, spp=request.spp, seed=stream))
        if bad := np.count_nonzero(~np.isfinite(image).all(-1)):
            raise MiNtfError(f"{request.scene}: {bad} pixels of view {frame.file} are NaN or infinite; look for "
                             "extreme values in its materials and media, or give it another integrator")
        path = request.out / frame.file
        files.make_folder(path.parent)
        schema.write_exr(path, image)


_kept: list[Session] = []
"""The session of this process, kept from view to view."""


def photograph(task: tuple[Request, int]) -> None:
    """Write one view, in any process: a request as its session has completed it, and the number of the frame."""
    request, index = task
    if not _kept or _kept[0].request != request:
        _kept[:] = [Session(request)]
    if _kept[0].request != request:
        raise MiNtfError(f"{request.scene} is not the scene that this capture was begun with; wait for all machines to "
                         "see the same file, or use another folder")
    _kept[0].photograph(index)


def capture(scene: Path, out: Path, *, views: int = 100, size: int = 128, test_views: int = 20, spp: int = 64,
            seed: int = 0, flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0),
            workers: jobs.Workers = jobs.Workers()) -> dict:  # noqa: B008
    """Photograph `scene` (Mitsuba XML: surfaces, media) into the data set `out`; resumes what an earlier run began.

    `views` train, max(4, views // 20) val and `test_views` test photographs of size x size pixels, `spp` paths a pixel.
    `flash_offset`: right, up and forward from the lens to the flash, scene lengths. `workers`: who renders them.
    Returns center, radius, the number of images rendered and kept, and the seconds taken. Raises MiNtfError for a scene
    that cannot be photographed, for a folder that holds a capture with other settings, and for views that fail, after
    the others.
    """
    for name, value in (("views", views), ("size", size), ("test_views", test_views), ("spp", spp)):
        if value < 1:
            raise MiNtfError(f"capture: {name} is {value}, must be 1 or more")
    workers.check()
    start = time.monotonic()
    out = Path(out).absolute()
    session = Session(Request(Path(scene).absolute(), out, views, size, test_views, spp, seed, flash_offset))
    request, frames = session.request, session.frames
    files.make_folder(out)
    _open_manifest(out, {"scene": Path(scene).name, "object": request.object,
                         "integrator": " ".join(str(session.studio.integrator()).split()), "views": views, "size": size,
                         "test_views": test_views, "spp": spp, "seed": seed, "flash_offset": session.offset.tolist()})
    left = [index for index, frame in enumerate(frames) if not (out / frame.file).exists()]
    _kept[:] = [session]
    try:
        jobs.run(photograph, [(request, index) for index in left], workers, title="photographs",
                 names=[frames[index].file for index in left], folder=out)
    finally:
        _kept.clear()
    for split, entries in session.plan.items():
        found = schema.Transforms(session.angle, size, size, session.center, session.radius, entries)
        schema.write_transforms(out, split, found)
    return {"center": session.center.tolist(), "radius": session.radius, "rendered": len(left),
            "kept": len(frames) - len(left), "seconds": time.monotonic() - start}

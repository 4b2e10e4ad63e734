"""Virtual camera with a flash: photographs any ordinary Mitsuba scene, surfaces or media, into a data set (`schema`).

Every view has a point light exactly at the camera (collocated capture, method of Bi et al. 2020), or at one place
beside it. At the camera the light's transmittance is the view's: a medium of density σ dims it twice,
L = ∫ σ_s f T² I/t² dt. Alpha is the opacity, the fraction of paths that meet matter. The scene's own sensors and
emitters are ignored; its shapes, media, materials and, if suitable, its integrator are used. In `data`, only
this file and `capture_scene` use Mitsuba.
"""

import json
import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from mi_ntf import jobs
from mi_ntf.core import files, progress
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture_scene, schema
from mi_ntf.data.estimates import bounding_sphere
from mi_ntf.data.poses import camera_to_world, view_directions

if TYPE_CHECKING:
    import mitsuba as mi

DISTANCE = 3.2  # camera to object's centre, in radii of the bounding sphere
MARGIN = 1.04   # bounding sphere over the object's extent: room for a soft surface in the field


def _studio(subject: capture_scene.Subject, angle: float, size: int) -> "mi.Scene":
    """Return a scene of the subject with a perspective camera (box filter, RGBA) and a point light, not yet placed."""
    import mitsuba as mi

    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "component_format": "float32",
            "rfilter": {"type": "box"}}
    scene = mi.load_dict({
        "type": "scene",
        "integrator": subject.integrator,
        "sensor": {"type": "perspective", "fov": float(np.degrees(angle)), "near_clip": 1e-4, "far_clip": 1e6,
                   "film": film, "sampler": {"type": "independent"}},
        "light": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
        **{f"group_{i}": group for i, group in enumerate(subject.groups)},
        **{f"shape_{i:04d}": shape for i, shape in enumerate(subject.shapes)},
    })
    assert isinstance(scene, mi.Scene)
    return scene


def _open_manifest(out: Path, settings: dict[str, object], origin: dict[str, object]) -> None:
    """Write settings and `origin` to `capture.json`, or compare settings with those of the run that this one resumes.

    The `origin` tells `mi-ntf train` the command that puts the field into the scene. It may change.
    """
    path = out / "capture.json"
    if not path.exists():
        files.write(path, json.dumps(settings | origin, indent=1) + "\n")
        return
    try:
        before = {"flash_offset": [0.0, 0.0, 0.0], "shapes": ""}  # which old files lack
        before |= dict(json.loads(path.read_bytes()))
    except (ValueError, TypeError, RecursionError) as error:
        raise MiNtfError(f"{path}: cannot be read ({error}), so what this folder was captured with is not known; "
                         "use another folder or delete this one") from None
    for key, value in settings.items():
        if before.get(key) != value:
            raise MiNtfError(f"{path}: this folder was captured with {key} = {before.get(key)}, now {key} = {value}; "
                             "use another folder, delete this one, or give the former value to resume")


@dataclass(frozen=True)
class Request:
    """Settings of :func:`capture`."""

    scene: Path
    out: Path
    views: int
    size: int
    test_views: int
    spp: int
    seed: int
    flash_offset: tuple[float, float, float]
    shapes: str = ""  # names as in the option --shapes
    parameters: tuple[tuple[str, str], ...] = ()  # values of the scene's $names
    variant: str = ""  # of Mitsuba
    object: str = ""  # fingerprint of the studio


class Session:
    """Studio and frames of a request, for one process. Raises MiNtfError."""

    def __init__(self, request: Request):
        import mitsuba as mi

        if request.variant:
            mi.set_variant(request.variant)
        subject = capture_scene.load(request.scene, request.shapes, dict(request.parameters))
        self.notes = subject.notes
        self.center, radius = bounding_sphere(capture_scene.outline(subject.shapes))
        self.radius = MARGIN * radius
        self.angle = float(2.0 * np.arcsin(1.0 / DISTANCE))
        self.studio = _studio(subject, self.angle, request.size)
        self.request = replace(request, variant=str(mi.variant()), object=capture_scene.fingerprint(self.studio))
        self.offset = np.array(request.flash_offset, dtype=np.float64)
        far = DISTANCE * self.radius
        if self.offset.shape != (3,) or not np.isfinite(self.offset).all() or self.offset[2] > 0.5 * far:
            raise MiNtfError(f"capture: flash_offset is {request.flash_offset}, must be three finite lengths right,up,"
                             f"forward of the lens, forward at most half of the way to the object ({far:.4g})")
        self.plan = self._plan()
        self.frames = [frame for split in self.plan.values() for frame in split]
        self._params = mi.traverse(self.studio)

    def _plan(self) -> dict[str, list[schema.Frame]]:
        """Return the frames of every split.

        The flash has I = π d², so a white diffuse surface at the object's centre that faces it has radiance 1.
        """
        request, distance = self.request, DISTANCE * self.radius
        rng = np.random.default_rng(request.seed)
        beside = self.offset * (1.0, 1.0, -1.0)
        intensity = np.full(3, np.pi * float(((beside + np.array([0, 0, distance])) ** 2).sum()))
        plan = {}
        for split, count in (("train", request.views), ("val", max(4, request.views // 20)),
                             ("test", request.test_views)):
            poses = [camera_to_world(self.center + distance * d, self.center) for d in view_directions(count, rng)]
            plan[split] = [schema.Frame(f"{split}/{i:04d}.exr", c2w, c2w[:3, 3] + c2w[:3, :3] @ beside, intensity)
                           for i, c2w in enumerate(poses)]
        return plan

    def photograph(self, index: int) -> None:
        """Render and write frame `index`."""
        import mitsuba as mi

        request, frame = self.request, self.frames[index]
        self._params["sensor.to_world"] = mi.Transform4f(mi.Matrix4f(schema.mitsuba_to_opengl(frame.c2w).tolist()))
        self._params["light.position"] = mi.Point3f(frame.light_pos.tolist())
        self._params["light.intensity.value"] = mi.Color3f(frame.light_intensity.tolist())
        self._params.update()
        seed = cast("mi.UInt32", request.seed * len(self.frames) + index)  # the stub forbids a number
        image = np.array(mi.render(self.studio, spp=request.spp, seed=seed))
        if bad := np.count_nonzero(~np.isfinite(image).all(-1)):
            raise MiNtfError(f"{request.scene}: {bad} pixels of view {frame.file} are NaN or infinite; look for "
                             "extreme values in its materials and media, or give it another integrator")
        path = request.out / frame.file
        files.make_folder(path.parent)
        schema.write_exr(path, image)


_sessions: list[Session] = []  # the session of this process, reused from view to view


def photograph(task: tuple[Request, int]) -> None:
    """Write one view in any process: a request as its session has completed it, and the number of the frame."""
    request, index = task
    if not _sessions or _sessions[0].request != request:
        _sessions[:] = [Session(request)]
    if _sessions[0].request != request:
        raise MiNtfError(f"{request.scene} is not the scene that this capture was begun with; wait for all machines to "
                         "see the same file, or use another folder")
    _sessions[0].photograph(index)


def capture(scene: Path, out: Path, *, views: int = 100, size: int = 128, test_views: int = 20, spp: int = 64,
            seed: int = 0, flash_offset: tuple[float, float, float] = (0.0, 0.0, 0.0), shapes: str = "",
            parameters: dict[str, str] | None = None, workers: jobs.Workers = jobs.Workers()) -> dict[str, Any]:  # noqa: B008
    """Photograph a scene (Mitsuba XML) into the data set `out`. The same call resumes what an earlier run began.

    `views` are for training, and max(4, views // 20) are added for validation. `size` is the width and height in
    pixels; each pixel has `spp` paths. `flash_offset` is the flash's place right, up and forward of the lens in scene
    lengths. `shapes` chooses shapes as the option ``--shapes`` does: by names, by ``not:`` and names, or all.
    `parameters` are values of the scene's $names.

    The result has the "center" and "radius" of the object's sphere, the numbers of images "rendered" and "kept", and
    "seconds". Raises MiNtfError if the scene cannot be photographed, if the folder holds a capture with other settings,
    or, after all others, if views fail.
    """
    for name, value in (("views", views), ("size", size), ("test_views", test_views), ("spp", spp)):
        if value < 1:
            raise MiNtfError(f"capture: {name} is {value}, must be 1 or more")
    workers.check()
    start = time.monotonic()
    out = Path(out).absolute()
    with progress.Stage(f"reading {scene}"):
        session = Session(Request(Path(scene).absolute(), out, views, size, test_views, spp, seed, flash_offset,
                                  shapes, tuple((parameters or {}).items())))
    request, frames = session.request, session.frames
    for note in session.notes:
        progress.say(note)
    files.make_folder(out)
    _open_manifest(out, {"scene": Path(scene).name, "shapes": shapes, "object": request.object,
                         "integrator": " ".join(str(session.studio.integrator()).split()), "views": views, "size": size,
                         "test_views": test_views, "spp": spp, "seed": seed, "flash_offset": session.offset.tolist()},
                   {"folder": Path(os.path.relpath(Path(scene).resolve().parent, out.resolve())).as_posix(),
                    "parameters": parameters or {}})
    missing = [index for index, frame in enumerate(frames) if not (out / frame.file).exists()]
    _sessions[:] = [session]
    try:
        jobs.run(photograph, [(request, index) for index in missing], workers, title="photographs",
                 names=[frames[index].file for index in missing], folder=out, done=len(frames) - len(missing))
    finally:
        _sessions.clear()
    for split, entries in session.plan.items():
        transforms = schema.Transforms(session.angle, size, size, session.center, session.radius, entries)
        schema.write_transforms(out, split, transforms)
    return {"center": session.center.tolist(), "radius": session.radius, "rendered": len(missing),
            "kept": len(frames) - len(missing), "seconds": time.monotonic() - start}

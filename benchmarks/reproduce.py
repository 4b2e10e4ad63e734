"""The paper's table 2 on our scenes, its ablation, its curves, and the making of maps: ``results/reproduce.json``.

    python -m benchmarks.reproduce [--work out/reproduce] [--scenes statue …] [--methods NRF TM …] [--full]
                                   [--environments FOLDER]

=========  ===========================================================================================================
NRF        ``transmittance_volume``: transmittance tabulated for each light (Bi et al. 2020), the baseline
TM         ``transmittance_map``, filled by the transmittance network of the field
TM field   maps marched from the field, the default of the renderer
March      ``raymarch``: the transmittance that NRF tabulates
AG         ``ray_network`` with the paper's network, trained on random rays too; queried at every point and light
No AG      the same, trained on camera rays alone
NeRV       ``visibility_mlp``: a network of a point and a direction (Srinivasan et al. 2021)
TM of AG   maps filled by the network of AG, as in the paper
=========  ===========================================================================================================

The first four are measured by default; the others are trained first, for 20 minutes a scene and network on two cores.
All columns light the same shipped field, so only the transmittance differs. Ground truth are the path-traced meshes.
``--full`` takes the paper's sizes, and days. Times of networks of the paper's size are those of ``benchmarks.speed``.

The folder of ``--work`` holds references, networks, and ``jobs.jsonl`` with a line for each finished job: the same
command continues there. A job that fails is tried again by the next run; the exit code is 1 then. Takes about 30
minutes on two cores.
"""

import hashlib
import json
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from mi_ntf import __version__, swap
from mi_ntf.core import errors, field_file, files, spheres
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.exr import write_exr
from mi_ntf.evaluate import compare, metrics, perceptual
from mi_ntf.render.maps import building

from . import fields, networks, paper, record, scenes, timing
from .paper import BASE, METRICS
from .paper_lights import DISTANCE, Light, environments, point_lights

Row = dict[str, Any]
DEPTH = 6
"""Edges of a path, of the meshes and of the field."""
PATHS = 1 << 23
"""Paths of the meshes that are traced at once."""
POINTS, SIDE = 400, 33
"""Points of a transmittance curve, and side of the picture among whose camera rays its ray is chosen."""
FINE, DARK = 2 / 1536, 0.01
"""Step of the curves' march, and transmittance below which a ray has met the object."""


@dataclass(frozen=True)
class Method:
    """A column: its visibility, further properties of the integrator, and the network that it needs, if any."""

    visibility: str
    properties: dict[str, str] = field(default_factory=dict)
    network: str = ""


NETWORK = {"map_source": "network"}
METHODS = {
    "NRF": Method("transmittance_volume"), "TM": Method("transmittance_map", NETWORK),
    "TM field": Method("transmittance_map"), "March": Method("raymarch"), "AG": Method("ray_network", network="AG"),
    "No AG": Method("ray_network", network="No AG"), "NeRV": Method("visibility_mlp", network="AG"),
    "TM of AG": Method("transmittance_map", NETWORK, network="AG")}
TRAINING = {"AG": ["--visibility-mlp"], "No AG": ["--no-augmentation"]}
"""Network → options of its training. NeRV's network is trained beside that of AG."""


@dataclass(frozen=True)
class Sizes:
    """Amounts that are measured.

    - pixels: along a side of a picture
    - points, skies: pictures under point lights, half of them with a moving camera, and under environments
    - spp: samples a pixel of the field, under point lights and under environments
    - reference_spp: paths a pixel of the meshes
    - cells: directional lights that stand for an environment
    - map_resolution: texels along a side of maps and volumes
    - views, photograph: photographs that networks are trained on, and pixels along a side of them
    - ntf, steps: network and steps of the trainings
    - stages: fractions of the steps, each trained by itself, for the transmittance curves
    - study: pixels along a side, samples, lights and queries of the ablation
    - build: numbers of lights that maps and volumes are made for
    """

    pixels: int = 192
    points: int = 8
    skies: int = 3
    spp: tuple[int, int] = (16, 2)
    reference_spp: int = 512
    cells: int = 64
    map_resolution: int = 192
    views: int = 60
    photograph: int = 128
    ntf: str = "ray"
    steps: int = 2000
    stages: tuple[float, ...] = (1 / 40, 1 / 16, 1 / 4)
    study: tuple[int, int, int, int] = (64, 2, 12, 1 << 20)
    build: tuple[int, ...] = (1, 2, 4)


DEFAULT = Sizes()
"""192² pixels, since MS-SSIM needs 176."""
FULL = Sizes(pixels=600, points=400, skies=18, spp=(16, 4), reference_spp=1024, cells=288, map_resolution=256,
             views=100, photograph=256, ntf="paper", steps=20000, stages=(1 / 100, 1 / 50, 1 / 20),
             study=(128, 4, 50, 1 << 20), build=(1, 2, 4, 8))
QUICK = replace(DEFAULT, pixels=24, points=2, skies=1, spp=(4, 1), reference_spp=16, cells=6, map_resolution=24,
                views=4, photograph=16, steps=8, stages=(0.25,), study=(16, 1, 2, 1 << 10), build=(1, 2))
COUNTERPARTS = {"knot": "Happy Buddha", "statue": "Sitting Buddha", "globe": "Globe"}
"""Shipped scenes with meshes and opaque fields, and the scenes of the paper beside them."""


@dataclass(frozen=True)
class Scene:
    """A folder with ``mesh.xml`` and ``field.safetensors``."""

    name: str
    folder: Path

    @property
    def mesh(self) -> Path:
        """Path of the scene of meshes."""
        return self.folder / "mesh.xml"

    @property
    def field(self) -> Path:
        """Path of the field."""
        return self.folder / "field.safetensors"

    def digest(self) -> list[str]:
        """Return hashes of the files that the scene is made of."""
        paths = sorted([self.field, *self.folder.glob("*.xml"), *self.folder.glob("meshes/*")])
        return [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()]


def scene_of(name: str) -> Scene:
    """Return the scene of this name in scenes/, or in this folder. Raises MiNtfError where it lacks mesh or field."""
    folder = scenes.SCENES / name if (scenes.SCENES / name).is_dir() else Path(name)
    scene = Scene(folder.resolve().name, folder)
    for path in (scene.mesh, scene.field):
        if not path.is_file():
            raise MiNtfError(f"scene {name} has no {path.name}; name one of {', '.join(COUNTERPARTS)}, or a folder "
                             "with mesh.xml and field.safetensors")
    return scene


class Jobs:
    """Rows of finished jobs in the file ``jobs.jsonl`` of a folder, by name.

    Lines that an interruption has left incomplete are ignored.
    """

    def __init__(self, folder: Path):
        files.make_folder(folder)
        self.path = folder / "jobs.jsonl"
        self.rows: dict[str, Row] = {}
        self.failed: dict[str, str] = {}
        for line in self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else ():
            try:
                row = json.loads(line)
                self.rows[row["job"]] = row
            except (ValueError, KeyError, TypeError):
                continue

    def do(self, name: str, about: Any, work: Callable[[], Row], file: Path | None = None) -> Row | None:
        """Return the row of a job, which `work` makes unless it is finished; None if it fails.

        A finished job counts if its settings `about`, for JSON, are the same, and its `file` still exists.
        """
        text = json.dumps([__version__, about], sort_keys=True, default=str)
        key = hashlib.sha256(text.encode()).hexdigest()[:16]
        row = self.rows.get(name, {})
        if row.get("about") == key and (file is None or file.exists()):
            return row
        start = time.perf_counter()
        try:
            row = {"job": name, "about": key, **work(), "wall_seconds": round(time.perf_counter() - start, 3)}
        except Exception as error:
            if errors.debug():
                raise
            self.failed[name] = errors.sentence(error)
            print(f"{name}: {self.failed[name]}", file=sys.stderr)
            return None
        self.rows[name] = row
        with open(self.path, "a", encoding="utf-8") as lines:
            lines.write(("" if lines.tell() == 0 or _ends(self.path) else "\n") + json.dumps(row) + "\n")
        return row


def _ends(path: Path) -> bool:
    """Return True if the last line of a file is complete."""
    return path.read_bytes().endswith(b"\n")


class Studio:
    """The pictures of a scene: meshes, camera, fields, and the patches between which their light bounces."""

    def __init__(self, scene: Scene, sizes: Sizes):
        self.sizes = sizes
        loaded = meshes(scene, sizes.pixels)
        self._meshes = {f"shape{i}": s for i, s in enumerate(loaded.shapes()) if not s.is_emitter()}
        self._sensor = loaded.sensors()[0]
        self._balls: dict[Path, Any] = {}
        self._patches: dict[Path, Any] = {}
        similarity = field_file.load_header(scene.field).similarity
        self.centre, self.radius = similarity.center, similarity.radius

    def reference(self, light: Light, seed: int) -> np.ndarray:
        """Return the path-traced meshes, linear RGBA (h, w, 4)."""
        scene = mi.load_dict({"type": "scene", "light": light.emitter, **self._meshes})
        integrator = mi.load_dict({"type": "path", "max_depth": DEPTH, "hide_emitters": True})
        passes = -(-self.sizes.pixels**2 * self.sizes.reference_spp // PATHS)
        total: Any = 0
        for k in range(passes):
            number: Any = 1000 * (seed + 1) + k  # a number, where Mitsuba's stub asks for an array
            image = mi.render(scene, sensor=self.sensor(light), integrator=integrator,
                              spp=-(-self.sizes.reference_spp // passes), seed=number)
            total = total + np.array(image, np.float64)
        mean: np.ndarray = (total / passes).astype(np.float32)
        return mean

    def image(self, light: Light, method: Method, field: Path, seed: int) -> tuple[np.ndarray, float]:
        """Return the `field` lit by `method`, linear RGBA (h, w, 4), and its seconds, tables included."""
        if field not in self._balls:
            self._balls[field] = mi.load_dict(scenes.field_ball(field))
        scene = mi.load_dict({"type": "scene", "light": light.emitter, "ball": self._balls[field]})
        integrator = scenes.integrator(visibility=method.visibility, max_depth=DEPTH,
                                       environment_lights=self.sizes.cells, map_resolution=self.sizes.map_resolution,
                                       **method.properties)
        integrator.context.patches = self._patches.get(field)  # they depend on the field, not on the light
        spp = self.sizes.spp[light.kind == "environment"]
        number: Any = seed
        start = time.perf_counter()
        image = np.array(mi.render(scene, sensor=self.sensor(light), integrator=integrator, spp=spp, seed=number))
        seconds = time.perf_counter() - start
        self._patches[field] = integrator.context.patches
        dr.flush_malloc_cache()  # volumes are gigabytes
        return image, seconds

    def sensor(self, light: Light) -> Any:
        """Return the scene's camera, or one at the place of the light's camera that sees the whole sphere."""
        if light.camera is None:
            return self._sensor
        up = [0.0, 1.0, 0.0]
        along = np.subtract(light.camera, self.centre)
        if abs(along[1]) > 0.99 * np.linalg.norm(along):
            up = [0.0, 0.0, 1.0]
        look: Any = mi.ScalarTransform4f().look_at(origin=list(light.camera), target=list(self.centre), up=up)
        film = {"type": "hdrfilm", "width": self.sizes.pixels, "height": self.sizes.pixels, "rfilter": {"type": "box"},
                "pixel_format": "rgba", "component_format": "float32"}
        fov = float(2 * np.degrees(np.arcsin(1 / DISTANCE)))
        return mi.load_dict({"type": "perspective", "fov": fov, "to_world": look, "film": film,
                             "sampler": {"type": "independent"}})


def meshes(scene: Scene, pixels: int) -> Any:
    """Return the Mitsuba scene of the meshes with `pixels`² pixels. Raises MiNtfError."""
    try:
        loaded: Any = mi.load_file(str(scene.mesh), res=str(pixels))
    except RuntimeError as error:
        raise MiNtfError(f"{scene.mesh} cannot be loaded ({errors.sentence(error)}); as in shipped scenes, "
                         "$res must be its film's size") from None
    if not loaded.sensors():
        raise MiNtfError(f"{scene.mesh} has no sensor; add the one of its pictures")
    return loaded


def measure(image: np.ndarray, reference: np.ndarray) -> dict[str, float | None]:
    """Return the metrics of table 2 of linear RGBA pictures on black; None for those that cannot be measured."""
    values: dict[str, float | None] = {}
    for name in METRICS:
        try:
            metric = getattr(perceptual if name == "lpips" else metrics, name)
            values[name] = metric(image[..., :3], reference[..., :3])
        except metrics.NotMeasured:
            values[name] = None
    return values


def command(*words: Any) -> None:
    """Run `mi-ntf` in a process of its own, since PyTorch and Mitsuba stay apart. Raises MiNtfError."""
    texts = list(map(str, words))
    done = subprocess.run([sys.executable, "-m", "mi_ntf", *texts], capture_output=True, text=True, check=False)
    if done.returncode:
        last = [line for line in done.stderr.splitlines() if line.strip()][-1:]
        raise MiNtfError(f"`mi-ntf {' '.join(texts)}` failed with exit code {done.returncode}: "
                         f"{' '.join(last).removeprefix('mi-ntf: error: ')}")


def build(scene: Scene, sizes: Sizes) -> Row:
    """Return the seconds to make maps (by the network) and volumes of some lights: medians of three rounds."""
    medium = _medium(scene.field)
    result: dict[str, Any] = {"resolution": sizes.map_resolution, "lights": list(sizes.build), "map": [], "volume": []}
    options = {"map": building.Options(2 / 384, sizes.map_resolution, "network"),
               "volume": building.Options(2 / 384, sizes.map_resolution)}
    for count in sizes.build:
        table = timing.table_of(spheres.fibonacci(max(count, 2))[:count])

        def make(kind: str, table: Any = table) -> None:
            building.build(f"transmittance_{kind}", medium, table, options[kind])

        times = timing.rounds({kind: partial(make, kind) for kind in options}, 3)
        for kind, values in times.items():
            result[kind].append(float(np.median(values)))
    return result


def curves(scene: Scene, networks_of: dict[str, tuple[Path, str]]) -> Row:
    """Return places ``t`` on a ray, in field units towards the light, and the transmittance there, by title.

    `networks_of` maps a title to a field file and a visibility. The light is at the camera. The ray is the first from
    the middle of the picture on that is dark at its end. Raises MiNtfError where the object covers none.
    """
    middle, d, half = _ray(scene)
    t = np.linspace(-half, half, POINTS)
    x = tuple(mi.Float((middle[k] + t * d[k]).astype(np.float32)) for k in range(3))
    wi = tuple(mi.Float(float(c)) for c in d)
    every = {"marched": (scene.field, "raymarch"), **networks_of}
    values = {title: _transmittance(_medium(file), visibility, x, wi, d[None]).round(5).tolist()
              for title, (file, visibility) in every.items()}
    return {"scene": scene.name, "t": t.round(5).tolist(), "curves": values}


def _ray(scene: Scene) -> tuple[np.ndarray, np.ndarray, float]:
    """Return the middle of a ray's chord, its direction towards the light, and half its length."""
    medium = _medium(scene.field)
    o, away, _ = networks.view_rays(meshes(scene, 16).sensors()[0], medium.frame, SIDE)
    o, away = (np.array(v).T.astype(np.float64) for v in (o, away))
    index, middle = np.arange(SIDE**2), SIDE // 2
    order = np.argsort(np.hypot(index % SIDE - middle, index // SIDE - middle))
    start, direction = (tuple(mi.Float(c) for c in v[order].T.astype(np.float32)) for v in (o, away))
    through = _transmittance(medium, "raymarch", start, direction, np.array([[0.0, 0.0, 1.0]]))
    dark = np.flatnonzero(through < DARK)
    if not len(dark):
        raise MiNtfError(f"scene {scene.name}: no camera ray ends on the object, so no curve can be drawn; turn its "
                         "sensor towards the object")
    first, d = o[order[dark[0]]], -away[order[dark[0]]]
    m = first - (first @ d) * d
    return m, d, float(np.sqrt(1 - m @ m))


def _transmittance(medium: Any, visibility: str, x: Any, wi: Any, lights: np.ndarray) -> np.ndarray:
    """Return the transmittance from `x` along `wi` without an end; tables are made for the directions `lights`."""
    built: Any = building.build(visibility, medium, timing.table_of(lights), building.Options(FINE))
    width = dr.width(x)
    infinite, active = dr.full(mi.Float, dr.inf, width), dr.full(mi.Bool, True, width)
    return np.array(built.tau(x, wi, infinite, dr.zeros(mi.UInt32, width), active), np.float64)


def _medium(file: Path) -> Any:
    ball: Any = mi.load_dict(scenes.field_ball(file))
    return ball.interior_medium()


def ablation(scene: Scene, file: Path, folder: Path, sizes: Sizes) -> Row:
    """Return the relative RMSE of the network of a field under directional lights, against a march."""
    files.make_folder(folder)
    path = folder / f"{file.stem}.xml"
    swap.swap(scene.mesh, file, path)
    result = fields.transmittance(path, fields.Sizes(transmittance=sizes.study))
    return {name: result[name] for name in ("ray_network", "map, network, 128²", "query_ns")}


class Reproduction:
    """The jobs of a run in their order: trainings, measurements, then picture by picture.

    All scenes and methods of one light come before the next light, so that means of an interrupted run are of equal
    sets.
    """

    def __init__(self, out: Path, sizes: Sizes, chosen: list[Scene], methods: Sequence[str],
                 skies: Path | None = None):
        self.out, self.sizes, self.scenes, self.methods = out, sizes, chosen, list(methods)
        self.jobs = Jobs(out)
        self.digests = {scene.name: scene.digest() for scene in chosen}
        self.studios = {scene.name: Studio(scene, sizes) for scene in chosen}
        sky = environments(sizes.skies, skies)
        self.lights = {scene.name: point_lights(sizes.points, self.studios[scene.name].centre,
                                                self.studios[scene.name].radius) + sky for scene in chosen}
        self.needed = list(dict.fromkeys(METHODS[m].network for m in self.methods if METHODS[m].network))

    def field(self, scene: Scene, network: str, steps: int = 0) -> Path:
        """Return the file of a trained network, or of the shipped field."""
        name = f"{network.lower().replace(' ', '_')}-{self.sizes.ntf}-{steps or self.sizes.steps}.safetensors"
        return self.out / "networks" / scene.name / name if network else scene.field

    def run(self) -> dict[str, Any]:
        """Do all jobs that are not finished, and return the values for the tables."""
        s = self.sizes
        values: dict[str, Any] = {}
        for scene in self.scenes:
            for network in self.needed:
                self._train(scene, network)
        values["build"] = {scene.name: row for scene in self.scenes if (
            row := self._do(f"build/{scene.name}", scene, [s.build, s.map_resolution], partial(build, scene, s)))}
        values["ablation"] = {scene.name: {network or "shipped": row for network in ["", *self.needed] if (
            row := self._ablation(scene, network))} for scene in self.scenes}
        values["curves"] = self._curves()
        pictures = self._pictures()
        return {"sizes": asdict(s), "methods": self.methods, "scenes": {n: COUNTERPARTS.get(n, "") for n in
                                                                        self.digests},
                **values, **summary(pictures), "failed": self.jobs.failed}

    def _do(self, name: str, scene: Scene, about: Any, work: Callable[[], Row], file: Path | None = None
            ) -> Row | None:
        return self.jobs.do(name, [self.digests[scene.name], about], work, file)

    def _trained(self, network: str) -> list[Any]:
        s = self.sizes
        return [network, s.views, s.photograph, s.ntf, s.steps] if network else []

    def _train(self, scene: Scene, network: str, steps: int = 0) -> None:
        """Capture the photographs of a scene, and train a network; `steps`: those of a stage of the curves."""
        s, file = self.sizes, self.field(scene, network, steps)
        data = file.parent / f"photographs-{s.views}-{s.photograph}"
        files.make_folder(data.parent)

        def run(*words: Any) -> Row:
            command(*words)
            return {}

        if self._do(f"photographs/{scene.name}", scene, [s.views, s.photograph], lambda: run(
                "capture", scene.mesh, data, "--views", s.views, "--size", s.photograph, "--test-views", 4),
                data) is None:
            return
        more = [] if steps else TRAINING[network]
        self._do(f"train/{scene.name}/{file.stem}", scene, [*self._trained(network), steps], lambda: run(
            "train", data, "-o", file, "--field", scene.field, "--ntf", s.ntf, "--steps", steps or s.steps, *more),
                 file)

    def _ablation(self, scene: Scene, network: str) -> Row | None:
        return self._do(f"ablation/{scene.name}/{network}", scene, [*self._trained(network), self.sizes.study],
                        lambda: ablation(scene, self.field(scene, network), self.out / "networks" / scene.name,
                                         self.sizes))

    def _curves(self) -> Row | None:
        """Return the curves of the first scene: of the shipped network, and of AG's after more and more steps."""
        scene, shown = self.scenes[0], {"shipped network": (self.scenes[0].field, "ray_network")}
        if "AG" in self.needed:
            for part in self.sizes.stages:
                steps = max(1, round(part * self.sizes.steps))
                self._train(scene, "AG", steps)
                shown[f"{steps} steps"] = self.field(scene, "AG", steps), "ray_network"
            shown[f"{self.sizes.steps} steps"] = self.field(scene, "AG"), "ray_network"
            shown["NeRV"] = self.field(scene, "AG"), "visibility_mlp"
        return self._do("curves", scene, [sorted(shown), *self._trained("AG" if "AG" in self.needed else "")],
                        lambda: curves(scene, shown))

    def _pictures(self) -> list[Row]:
        rows = []
        for k in range(max(map(len, self.lights.values()))):
            for scene in self.scenes:
                light = self.lights[scene.name][k]
                for name in self.methods:
                    row = self._picture(scene, light, k, name)
                    rows += [row] if row else []
        return rows

    def _picture(self, scene: Scene, light: Light, k: int, name: str) -> Row | None:
        """Render and measure a picture; its reference is made first where it is missing."""
        s, method, studio = self.sizes, METHODS[name], self.studios[scene.name]
        path = self.out / "references" / scene.name / f"{light.name}.exr"
        settings = [light.about, s.pixels, s.reference_spp]

        def reference() -> Row:
            files.make_folder(path.parent)
            write_exr(path, studio.reference(light, k))
            return {}

        def picture() -> Row:
            image, seconds = studio.image(light, method, self.field(scene, method.network), k)
            truth = compare.read_image(path)
            return {"scene": scene.name, "light": light.name, "kind": light.kind, "method": name,
                    "metrics": measure(image, truth), "seconds": round(seconds, 3)}

        reference_name = f"reference/{scene.name}/{light.name}"
        if reference_name in self.jobs.failed or self._do(reference_name, scene, settings, reference, path) is None:
            return None
        about = [*self._trained(method.network), settings, s.spp, s.cells, s.map_resolution, asdict(method)]
        return self._do(f"picture/{scene.name}/{light.name}/{name}", scene, about, picture)


def summary(pictures: list[Row]) -> dict[str, Any]:
    """Return ``accuracy``, means and drops against NRF by scene, kind of light, method and metric, and ``seconds``.

    A mean is of all pictures, a drop of those that both methods have.
    """
    values: dict[tuple[str, str, str, str], dict[str, float]] = {}
    seconds: dict[str, dict[str, list[float]]] = {}
    for row in pictures:
        seconds.setdefault(row["kind"], {}).setdefault(row["method"], []).append(row["seconds"])
        for metric, value in row["metrics"].items():
            if value is not None:
                values.setdefault((row["scene"], row["kind"], row["method"], metric), {})[row["light"]] = value
    accuracy: dict[str, Any] = {}
    for (scene, kind, method, metric), by_light in values.items():
        base = values.get((scene, kind, BASE, metric), {})
        common = sorted(by_light.keys() & base.keys())
        means = [float(np.mean([part[light] for light in common])) for part in (by_light, base)] if common else []
        cell = {"mean": float(np.mean(list(by_light.values()))), "images": len(by_light),
                "drop": paper.drop(metric, *means) if common else None, "common": len(common)}
        accuracy.setdefault(scene, {}).setdefault(kind, {}).setdefault(method, {})[metric] = cell
    return {"accuracy": accuracy, "seconds": {kind: {method: record.spread(each) for method, each in rows.items()}
                                              for kind, rows in seconds.items()}}


def draw(row: Row, path: Path) -> None:
    """Write the transmittance curves as PNG: red marched, blue the networks'."""
    from matplotlib.figure import Figure

    marched, *others = row["curves"]
    lines = -(-len(others) // 3)
    sheet = Figure(figsize=(10.5, 2.4 * lines), layout="constrained")
    for axes, name in zip(sheet.subplots(lines, min(3, len(others)), squeeze=False).flat, others, strict=False):
        axes.plot(row["t"], row["curves"][marched], color="#e0433a", linewidth=1.2)
        axes.plot(row["t"], row["curves"][name], color="#3b82e0", linewidth=1.2)
        axes.set(ylim=(-0.05, 1.05), title=name)
    with files.replacing(path) as temporary:
        sheet.savefig(temporary, format="png", dpi=110)


def main() -> int:
    """Do the jobs and write the results; return the exit code."""
    options = record.options(
        __doc__, ("--work", {"type": Path, "default": record.ROOT / "out" / "reproduce"}),
        ("--scenes", {"nargs": "+", "default": list(COUNTERPARTS)}),
        ("--methods", {"nargs": "+", "choices": METHODS, "default": ["NRF", "TM", "TM field", "March"]}),
        ("--full", {"action": "store_true"}), ("--environments", {"type": Path}))
    record.prepare()
    start, sizes = time.perf_counter(), QUICK if options.quick else FULL if options.full else DEFAULT
    try:
        chosen = [scene_of(name) for name in options.scenes[:1 if options.quick else None]]
        run = Reproduction(options.work, sizes, chosen, options.methods, options.environments)
    except MiNtfError as error:
        print(f"reproduce: {error}", file=sys.stderr)
        return 1
    values = run.run()
    record.write("reproduce", values, start, options.out)
    if values["curves"]:
        draw(values["curves"], options.out / "curves.png")
    return 1 if values["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())

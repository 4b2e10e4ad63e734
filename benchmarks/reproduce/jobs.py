"""The work as a list of jobs, each done at once or not at all: a picture, a reference, a training, a measurement."""

import hashlib
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from mi_ntf import __version__

from . import costs, curves, images, networks
from .compared import METHODS, Method, Scene, Sizes
from .lights import Light
from .networks import Training
from .state import fingerprint

FOR_COSTS = {"table1", "runtime", "maps", "complexity"}
"""Tables that are made of the costs of queries."""


@dataclass(frozen=True)
class Job:
    """`about`: a hash of all that decides the result; `run` → its row, JSON; `needs`: jobs before it; `makes`: a file
    without which it is not done; `tags`: members of the row that are known before; `alone`: it measures times, and
    nothing else may run beside it."""

    name: str
    about: str
    run: Callable[[], dict]
    needs: tuple[str, ...] = ()
    makes: Path | None = None
    tags: dict = field(default_factory=dict)
    alone: bool = False


class Plan:
    """All jobs of a run, in their order: trainings first, then measurements, then picture by picture, all scenes and
    methods of one light before the next, so that a run that is cut short has means of equal sets."""

    def __init__(self, out: Path, sizes: Sizes, scenes: list[Scene], lights: dict[str, list[Light]],
                 tables: list[str], methods: list[str]):
        self.out, self.sizes, self.scenes, self.lights = out, sizes, scenes, lights
        self.tables, self.methods = tables, [METHODS[name] for name in methods]
        self._studios: dict[str, images.Studio] = {}
        self._fields = {scene.name: fingerprint(list(files_hash(scene))) for scene in scenes}
        self.trainings = list(self._trainings())
        self.jobs = [*self._training_jobs(), *self._measurements(), *self._pictures()]

    def whole(self, scene: Scene, network: str) -> Training:
        """The training of a column's network."""
        return Training(scene, network, self.sizes.ntf, self.sizes.steps)

    def stages(self) -> list[Training]:
        """Those of the transmittance curves, of the first scene; the last is AG's own."""
        steps = [max(1, round(share * self.sizes.steps)) for share in self.sizes.stages]
        return [Training(self.scenes[0], "ag", self.sizes.ntf, n, n == self.sizes.steps) for n in steps]

    def _trainings(self) -> Iterator[Training]:
        wanted = {m.network: None for m in self.methods if m.network}
        if {"table2", "ablation"} & set(self.tables):
            yield from (self.whole(scene, network) for scene in self.scenes for network in wanted)
        if "curves" in self.tables and "ag" in wanted:
            yield from self.stages()

    def _about(self, scene: Scene | None, *more) -> str:
        own = self._fields[scene.name] if scene else ""
        return fingerprint([__version__, own, *more])

    def _training_jobs(self) -> Iterator[Job]:
        s, seen = self.sizes, set()
        for training in self.trainings:
            if training.job in seen:
                continue
            seen.add(training.job)
            scene = training.scene
            first = f"photographs/{scene.name}"
            if first not in seen:
                seen.add(first)
                yield Job(first, self._about(scene, s.views, s.photograph),
                          partial(networks.capture, scene, self.out, s),
                          makes=networks.photographs(scene, self.out, s))
            yield Job(training.job, self._about(scene, s.views, s.photograph, s.ntf, training.steps, training.network),
                      partial(networks.train, training, self.out, s), (first,),
                      training.file(self.out))

    def _measurements(self) -> Iterator[Job]:
        s, tables = self.sizes, set(self.tables)
        bench = self._about(None, asdict(s.bench))
        if tables & FOR_COSTS:
            yield Job("costs", bench, partial(costs.measure, s.bench), alone=True)
        if "runtime" in tables:
            yield Job("scaling", bench, partial(costs.scaling, s.bench), alone=True)
        if "maps" in tables:
            for scene in self.scenes:
                yield Job(f"build/{scene.name}", self._about(scene, s.build, s.map_resolution),
                          partial(costs.build, scene, s), alone=True)
        if "curves" in tables:
            yield self._curves()
        if "ablation" in tables:
            yield from self._ablations()

    def _curves(self) -> Job:
        scene, needs = self.scenes[0], []
        shown = {"shipped network": (scene.field, "ray_network")}
        if any(t in self.trainings for t in self.stages()):
            for training in self.stages():
                shown[f"{training.steps} steps"] = training.file(self.out), "ray_network"
                needs.append(training.job)
            shown["NeRV"] = self.whole(scene, "ag").file(self.out), "visibility_mlp"
        about = self._about(scene, sorted(shown), self.sizes.ntf, self.sizes.views, self.sizes.photograph)
        return Job("curves", about, partial(curves.along, scene, shown), tuple(needs), tags={"scene": scene.name})

    def _ablations(self) -> Iterator[Job]:
        s = self.sizes
        for scene in self.scenes:
            for network in dict.fromkeys(["", *(m.network for m in self.methods)]):
                training = self.whole(scene, network)
                path = training.file(self.out) if network else scene.field
                folder = networks.folder(scene, self.out)
                yield Job(f"ablation/{scene.name}/{network or 'shipped'}", self._trained(scene, network, s.study),
                          partial(curves.ablation, scene, path, folder, s),
                          (training.job,) if network else (), tags={"scene": scene.name, "network": network},
                          alone=True)

    def _trained(self, scene: Scene, network: str, *more) -> str:
        s = self.sizes
        training = [s.views, s.photograph, s.ntf, s.steps] if network else []
        return self._about(scene, network, training, *more)

    def _pictures(self) -> Iterator[Job]:
        every = "table2" in self.tables
        if not every and "ablation" not in self.tables:
            return
        count = max(map(len, self.lights.values()))
        for k in range(count):
            for scene in self.scenes:
                light = self.lights[scene.name][k]
                if every or light.shown:
                    yield self._reference(scene, light, k)
                    yield from (self._picture(scene, light, k, method) for method in self.methods)

    def _reference_about(self, scene: Scene, light: Light) -> str:
        return self._about(scene, light.about, self.sizes.pixels, self.sizes.reference_spp)

    def _reference(self, scene: Scene, light: Light, k: int) -> Job:
        path = images.reference_file(self.out, scene, light)

        def run() -> dict:
            images.save(path, self._studio(scene).reference(light, k))
            return {"file": str(path.relative_to(self.out))}

        return Job(f"reference/{scene.name}/{light.name}", self._reference_about(scene, light), run, makes=path)

    def _picture(self, scene: Scene, light: Light, k: int, method: Method) -> Job:
        s, training = self.sizes, self.whole(scene, method.network)
        file = images.picture_file(self.out, scene, light, method) if light.shown else None
        reference = f"reference/{scene.name}/{light.name}"

        def run() -> dict:
            field_file = training.file(self.out) if method.network else scene.field
            image, seconds = self._studio(scene).image(light, method, field_file, k)
            if file is not None:
                images.save(file, image)
            truth = images.load(images.reference_file(self.out, scene, light))
            return {"metrics": images.measure(image, truth), "seconds": round(seconds, 3)}

        about = self._trained(scene, method.network, self._reference_about(scene, light), s.spp, s.cells,
                              s.map_resolution, method.visibility, method.options)
        return Job(f"picture/{scene.name}/{light.name}/{method.name}", about, run,
                   (reference, *([training.job] if method.network else [])), file,
                   {"scene": scene.name, "light": light.name, "kind": light.kind, "method": method.name})

    def _studio(self, scene: Scene) -> images.Studio:
        """Of the scene in work; one at a time is kept, for its memory, but for scenes that take turns."""
        if scene.name not in self._studios:
            self._studios[scene.name] = images.Studio(scene, self.sizes)
        return self._studios[scene.name]


def files_hash(scene: Scene) -> Iterator[str]:
    """Hashes of what the scene is made of: its field, its meshes, its camera."""
    for path in sorted([scene.field, *scene.folder.glob("*.xml"), *scene.folder.glob("meshes/*")]):
        if path.is_file():
            yield hashlib.sha256(path.read_bytes()).hexdigest()

"""What is compared: the paper's systems in our settings, the scenes, and how much of it.

=========  ===========================================================================================================
NRF        ``transmittance_volume`` on the shipped field: τ tabulated per light (Bi et al. 2020), the baseline
TM         ``transmittance_map``, ``map_source`` ``network``: maps filled by the field's own ray network
AG         ``ray_network`` with the paper's network, trained on random rays too: asked at every point and light
No AG      the same, trained on camera rays alone
NeRV       ``visibility_mlp``: a network of a point and a direction (Srinivasan et al. 2021)
TM of AG   maps filled by the network of AG: the paper's own TM, letter by letter
TM field   maps marched from the field, the product's default: no network
March      ``raymarch``: the field's own transmittance, which NRF tabulates
=========  ===========================================================================================================

The fields are the shipped ones in every column: density, normals and reflectance are the same, so that columns differ
by the light's transmittance alone. Networks of AG, No AG and NeRV are trained on them (:mod:`.networks`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError

from ..bench_measure import FULL as BENCH
from ..bench_measure import Sizes as BenchSizes

SCENES = Path(__file__).parents[2] / "scenes"
LIGHTS = {"point": "Point light", "environment": "Environment map"}
METRICS = {"ms_ssim": "MS-SSIM", "lpips": "LPIPS", "rmse": "rMSE", "ssim": "SSIM"}
"""Of table 2, in its order; functions of :mod:`mi_ntf.evaluate.metrics` and :mod:`mi_ntf.evaluate.perceptual`."""
TABLES = {"table1": "Table 1: runtime", "table2": "Table 2: accuracy", "runtime": "Runtime by the number of lights",
          "maps": "Time to make maps and volumes", "complexity": "Time-complexity",
          "curves": "Transmittance along a ray", "ablation": "Ablation of the augmentation"}


@dataclass(frozen=True)
class Method:
    """A column. `options`: properties of the integrator; `network`: the training run that it needs, ``ag`` or
    ``no_ag``, or "" for the shipped field alone."""

    name: str
    visibility: str
    options: dict[str, str] = field(default_factory=dict)
    network: str = ""


NETWORK = {"map_source": "network"}
METHODS = {m.name: m for m in (
    Method("NRF", "transmittance_volume"),
    Method("TM", "transmittance_map", NETWORK),
    Method("AG", "ray_network", network="ag"),
    Method("No AG", "ray_network", network="no_ag"),
    Method("NeRV", "visibility_mlp", network="ag"),
    Method("TM of AG", "transmittance_map", NETWORK, network="ag"),
    Method("TM field", "transmittance_map"),
    Method("March", "raymarch"),
)}


@dataclass(frozen=True)
class Scene:
    """A folder with ``mesh.xml`` and ``field.safetensors``. `paper`: the paper's scene that it stands beside, or ""."""

    name: str
    folder: Path
    paper: str = ""

    @property
    def mesh(self) -> Path:
        return self.folder / "mesh.xml"

    @property
    def field(self) -> Path:
        return self.folder / "field.safetensors"


COUNTERPARTS = {"knot": "Happy Buddha", "statue": "Sitting Buddha", "globe": "Globe"}
"""Shipped scenes with meshes and opaque fields, and the scenes of the paper whose rows stand beside them. The statue
sits on a lotus; the globe is a globe; the knot is like nothing in the paper and takes the place that is left."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured.

    pixels               along a side of a picture
    points, skies        pictures under point lights, half of them with a moving camera, and under environments
    spp                  samples a pixel of the field, under points and environments; camera rays have no other noise
    reference_spp        paths a pixel of the meshes
    cells                directional lights that stand for an environment
    map_resolution       texels along a side of maps and volumes
    views, photograph    photographs that networks are trained on, and pixels along a side of them
    ntf, steps           the ray network of AG and No AG, and the steps of its training
    stages               shares of these steps that the transmittance curves are shown after
    study                pixels along a side, samples and lights of the ablation's own measurement
    build                lights that maps and volumes are built for
    bench                sizes of :mod:`benchmarks.bench`, which the times are measured with
    """

    pixels: int
    points: int
    skies: int
    spp: tuple[int, int]
    reference_spp: int
    cells: int
    map_resolution: int
    views: int
    photograph: int
    ntf: str
    steps: int
    stages: tuple[float, ...]
    study: tuple[int, int, int]
    build: tuple[int, ...]
    bench: BenchSizes


FULL = Sizes(pixels=600, points=400, skies=18, spp=(16, 4), reference_spp=1024, cells=288, map_resolution=256,
             views=100, photograph=256, ntf="paper", steps=20000, stages=(1 / 100, 1 / 50, 1 / 20, 1),
             study=(128, 4, 50), build=(1, 2, 4, 8), bench=BENCH)
QUICK = Sizes(pixels=192, points=8, skies=3, spp=(16, 2), reference_spp=512, cells=64, map_resolution=192,
              views=60, photograph=128, ntf="ray", steps=2000, stages=(1 / 40, 1 / 16, 1 / 4, 1),
              study=(64, 2, 12), build=(1, 2, 4),
              bench=replace(BENCH, queries=1 << 15, repeats=3, pixels=75, image=200, tables=(50, 64, 256)))
"""An afternoon on two cores. 192² pixels: MS-SSIM needs 176."""


def scenes(names: Sequence[str]) -> list[Scene]:
    """The scenes of these names in scenes/, or of these folders; without names the shipped ones of COUNTERPARTS.
    Raises MiNtfError where one lacks its meshes or its field."""
    found = []
    for name in names or COUNTERPARTS:
        folder = SCENES / name if (SCENES / name).is_dir() else Path(name)
        shipped = folder.resolve().parent == SCENES.resolve()
        scene = Scene(folder.resolve().name, folder, COUNTERPARTS.get(folder.name, "") if shipped else "")
        for path in (scene.mesh, scene.field):
            if not path.is_file():
                raise MiNtfError(f"scene {name} has no {path.name}; name one of {', '.join(COUNTERPARTS)}, or a folder "
                                 "with mesh.xml and field.safetensors")
        found.append(scene)
    if len({scene.name for scene in found}) < len(found):
        raise MiNtfError(f"--scenes has two of one name among {', '.join(names)}; name each once")
    return found


def chosen(what: str, names: Sequence[str], known: dict) -> list[str]:
    """`names` in the order of `known`; all of it without any. Raises MiNtfError for others."""
    for name in names:
        if name not in known:
            raise MiNtfError(f"{what} '{name}' is unknown; it is one of {', '.join(known)}")
    return [name for name in known if not names or name in names]


def ball(scene: Scene) -> tuple[tuple[float, float, float], float]:
    """Centre and radius, in scene units, of the field's unit sphere."""
    similarity = field_file.load_header(scene.field).similarity
    return similarity.center, similarity.radius


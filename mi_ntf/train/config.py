"""What decides a training run. Times are shares of the whole run, so a schedule scales with --minutes and --steps."""

import math
from dataclasses import dataclass, replace
from typing import ClassVar

from ..core.architecture import FAST, PAPER, VISIBILITY, Architecture, Encoding, Network
from ..core.errors import MiNtfError


@dataclass(frozen=True)
class TrainConfig:
    """One recipe. Lengths in field units (unit-sphere radii), weights relative to the colour loss."""

    architecture: Architecture = FAST
    samples: int = 30000
    """Field samples a step; the number of camera rays follows from how many samples a ray takes."""
    step: float = 1 / 100
    """Length of the cells of the quadrature, 200 across the unit sphere; steep ones are split."""
    cells: int = 96
    """Occupancy grid, cells along an edge."""
    bake: int = 128
    """Density grid for normals, cells along an edge."""
    lr_planes: float = 0.1
    lr_layers: float = 3e-3
    lr_gains: float = 0.02
    """Of the photographs' exposure and white balance, where those are learned."""
    lr_end: float = 0.03
    """Share of the learning rates that is left at the end (exponential decay)."""
    log_density: float = 3.0
    """ln σ at the start: a mist that colours can carve."""
    alpha: float = 1.0
    normal: float = 0.03
    facing: float = 0.1
    empty: float = 0.05
    """Weight of σ → 0 outside the visual hull, where no photograph's ray is sampled."""
    even: float = 5e-3
    """Weight of an even density along surfaces …"""
    even_over: float = 0.02
    """… over this length and less, to a quarter of it. Of `statue`, photographed at 512² and trained 600 steps more,
    the relit RMSE is 12.7 % with what :meth:`sharpened` makes of it, 13.1 % with twice as much and 13.0 % with half."""
    sharp: float = 2e-3
    """Weight of thin skins: −ln σ where pictures see matter."""
    steepen: float = 2.0
    """Factor of ln σ's slopes in opaque things …"""
    steepen_at: float = 0.5
    """… at this share of the run. Planes and layers follow skins that they find steep, but hardly get there by
    themselves: of `statue`, trained 600 steps more at 512², the relit RMSE is 11.8 % without and 11.5 % with."""
    gloss: float = 2e-3
    """Weight of the specular share: a rough lobe can stand in for the diffuse one in flash photographs,
    and then sends half as much again into all other directions."""
    lobes_from: float = 0.25
    """Until here roughness and specular weight stay where they start: before normals have formed, highlights that are
    where none are seen drive both to an end of their range, where sigmoids have no slope to come back by."""
    smooth: float = 2e-4
    """Weight of total variation of the planes."""
    shadows_from: float = 0.1
    """From here a flash that is not at the lens throws shadows: there has to be a skin first."""
    ntf_from: float = 0.8
    """Transmittance training starts here, the field has formed."""
    ntf_alone: float = 0.9
    """From here the field is finished and only its transmittance is trained."""
    ntf_rays: int = 384
    """Fresh transmittance rays a step."""
    augmentation: bool = True
    """Learn transmittance on rays of all directions, not those of the cameras alone."""
    colour_loss: bool = True
    """Also compare pixels lit by the learned transmittance with the photographs."""
    bounces: bool = True
    """The photographs hold light of the flash that the object throws on itself."""
    gains: bool = True
    """Each photograph has an exposure and a white balance of its own, unless its light's intensity is known."""

    def sharpened(self, pixel: float) -> "TrainConfig":
        """The recipe for photographs whose pixels are `pixel` wide at the object, in field units. Its own lengths are
        for 1/64, 128 pixels across the unit sphere; they shrink by the root of the pixels, those of the grids, whose
        upkeep costs the cube, by a third at most."""
        finer = max(math.sqrt(1 / (64 * pixel)), 1.0)
        grids = min(finer, 1.5)
        return replace(self, step=self.step / grids, cells=round(self.cells * grids), bake=round(self.bake * grids),
                       even_over=self.even_over / finer)


@dataclass(frozen=True)
class HierarchicalConfig:
    """The paper's recipe (method.md, section 5), see :mod:`mi_ntf.train.hierarchical`. It trains for days."""

    architecture: Architecture = PAPER
    coarse: int = 64
    """Stratified samples along each ray."""
    fine: int = 128
    """More of them, drawn from the weights of the coarse ones."""
    images: int = 4
    """Photographs a step …"""
    patch: int = 16
    """… and the edge of the square seen of each, in pixels."""
    random_rays: int = 128
    """Rays through two random points of the sphere a step, with augmentation."""
    lr: float = 2e-5
    """Adam's, to the end."""
    log_density: float = 0.0
    """ln σ at the start."""
    augmentation: bool = True
    colour_loss: bool = True
    step: float = 1 / 100
    """Cells of validation's quadrature, which is the renderer's and not that of training."""
    cells: int = 64
    """Grid of the cells that validation's rays are marched in."""
    ntf_alone: ClassVar[float] = 1.0
    """Field and transmittance learn together to the end."""


PRESETS: dict[str, TrainConfig | HierarchicalConfig] = {"fast": TrainConfig(), "paper": HierarchicalConfig()}


NTF = {
    "mixture2": FAST.transmittance,
    "logistic": replace(FAST.transmittance, components=1),
    "ray": Network(Encoding("frequency", octaves=6), (128, 128, 128, 128)),
    "paper": PAPER.transmittance,
}
"""Transmittance networks by name: two logistics or one, read from the ray's optical depths; and the paper's kind, one
logistic from the ray's end points alone, of a size that CPUs can train and of the paper's own."""


def configured(preset: str, *, ntf: str | None = None, augmentation: bool = True, colour_loss: bool = True,
               visibility_mlp: bool = False, bounces: bool = True, fresnel: bool = True,
               gains: bool = True) -> TrainConfig | HierarchicalConfig:
    """The recipe `preset` with another transmittance network, without parts of its training, for photographs without
    further `bounces`, of one exposure without `gains`, or of materials without a `fresnel` effect, or with the
    baseline's network (NeRV's, of a point and a direction) trained on the same transmittance beside it."""
    if preset not in PRESETS:
        raise MiNtfError(f"preset '{preset}' is unknown; it is one of {', '.join(PRESETS)}")
    if ntf is not None and ntf not in NTF:
        raise MiNtfError(f"--ntf '{ntf}' is unknown; it is one of {', '.join(NTF)}")
    config = replace(PRESETS[preset], augmentation=augmentation, colour_loss=colour_loss)
    if isinstance(config, TrainConfig):
        architecture = replace(config.architecture, fresnel=fresnel)
        config = replace(config, bounces=bounces, gains=gains, architecture=architecture)
    architecture = config.architecture
    if ntf is not None:
        architecture = replace(architecture, transmittance=NTF[ntf])
    if visibility_mlp:
        architecture = replace(architecture, visibility=VISIBILITY)
    return replace(config, architecture=architecture)


def transmittance_alone(config: TrainConfig | HierarchicalConfig, architecture: Architecture) -> TrainConfig:
    """The recipe `config` for a finished field of `architecture`: the whole run trains transmittance networks."""
    if not isinstance(config, TrainConfig):
        raise MiNtfError("--field goes with the preset 'fast' alone: the paper's learns field and transmittance as one")
    kept = {name: getattr(architecture, name) for name in ("density", "reflectance", "fresnel")}
    return replace(config, architecture=replace(config.architecture, **kept), ntf_from=0.0, ntf_alone=0.0)

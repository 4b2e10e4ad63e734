"""Settings of the recipes, and their presets."""

import math
from dataclasses import dataclass, replace

from ..core.architecture import FAST, PAPER, VISIBILITY, Architecture, Encoding, Network
from ..core.errors import MiNtfError


@dataclass(frozen=True)
class FastConfig:
    """Settings of the recipe ``fast``, see :mod:`mi_ntf.train.fast`.

    Lengths are in field units (radii of the unit sphere), weights are relative to the colour loss. Times are fractions
    of the whole run, so a schedule scales with ``--minutes`` and ``--steps``.
    """

    architecture: Architecture = FAST
    samples: int = 30000
    """Field samples a step; the number of camera rays follows from the samples that a ray takes."""
    step: float = 1 / 100
    """Length of the cells of the quadrature; steep ones are split."""
    cells: int = 96
    """Cells along an edge of the occupancy grid."""
    bake: int = 128
    """Cells along an edge of the density grid for normals."""
    lr_planes: float = 0.1
    """Learning rate of the planes."""
    lr_layers: float = 3e-3
    """Learning rate of the layers."""
    lr_gains: float = 0.02
    """Learning rate of single numbers: the photographs' exposure and white balance, where those are learned, and the
    numbers of a whole field's lobes."""
    lr_end: float = 0.03
    """Factor of the learning rates at the end, after an exponential decay."""
    log_density: float = 3.0
    """ln σ at the start: a mist that colours can carve."""
    alpha: float = 1.0
    """Weight of the alpha loss."""
    normal: float = 0.03
    """Weight of the distance between predicted normals and those of the density."""
    facing: float = 0.1
    """Weight of normals that face away from the camera."""
    empty: float = 0.05
    """Weight of σ → 0 outside the visual hull, where no photograph's ray is sampled."""
    even: float = 5e-3
    """Weight of an even density along surfaces …"""
    even_over: float = 0.02
    """… over this length and less, down to a quarter of it."""
    sharp: float = 2e-3
    """Weight of thin skins: −ln σ where pictures see matter."""
    steepen: float = 2.0
    """Factor of the slopes of ln σ in opaque objects …"""
    steepen_at: float = 0.5
    """… applied at this time. Planes and layers follow steep skins, but hardly get there by themselves."""
    gloss: float = 2e-3
    """Weight of the specular weight. A rough lobe can replace the diffuse one in flash photographs, and then sends half
    as much light again in all other directions."""
    lobes_from: float = 0.25
    """Time from which roughness and specular weight are learned, and from which colours may turn normals away from the
    light. Before normals have formed, highlights in wrong places would drive both to an end of their range, where
    sigmoids have no slope, and dark pixels would turn normals away from the light."""
    smooth: float = 2e-4
    """Weight of the total variation of the planes."""
    smooth_smoke: float = 2e-3
    """Weight of the total variation of the planes of smoke. It is larger, since smoke has no edges to blur."""
    shadows_from: float = 0.1
    """Time from which a flash beside the lens throws shadows: there has to be a skin first."""
    ntf_from: float = 0.8
    """Time from which transmittance is trained; the field has formed."""
    ntf_alone: float = 0.9
    """Time from which the field is finished, and only transmittance is trained."""
    ntf_rays: int = 384
    """Fresh transmittance rays a step."""
    augmentation: bool = True
    """Learn transmittance on rays of all directions, not only on those of the cameras."""
    colour_loss: bool = True
    """Compare pixels lit by the learned transmittance with the photographs, too."""
    bounces: bool = True
    """The photographs contain light of the flash that the object throws on itself."""
    gains: bool = True
    """Each photograph has an exposure and a white balance, unless the intensity of its light is known."""

    def sharpened(self, pixel: float) -> "FastConfig":
        """Return the settings for photographs whose pixels have the width `pixel` at the object, in field units.

        The default lengths are for 1/64, 128 pixels across the unit sphere. They shrink by the root of the pixel width;
        those of the grids, whose upkeep costs the cube, by a third at most.
        """
        finer = max(math.sqrt(1 / (64 * pixel)), 1.0)
        grids = min(finer, 1.5)
        return replace(self, step=self.step / grids, cells=round(self.cells * grids), bake=round(self.bake * grids),
                       even_over=self.even_over / finer)


@dataclass(frozen=True)
class HierarchicalConfig:
    """Settings of the recipe of Shafiei et al. 2021, see :mod:`mi_ntf.train.hierarchical`; days of training."""

    architecture: Architecture = PAPER
    coarse: int = 64
    """Stratified samples along each ray."""
    fine: int = 128
    """Further samples, distributed by the weights of the coarse ones."""
    images: int = 4
    """Photographs a step …"""
    patch: int = 16
    """… and the edge of the square taken from each, in pixels."""
    random_rays: int = 128
    """Rays through two random points of the sphere a step, with augmentation."""
    lr: float = 2e-5
    """Learning rate, constant."""
    log_density: float = 0.0
    """ln σ at the start."""
    augmentation: bool = True
    """See :class:`FastConfig`."""
    colour_loss: bool = True
    """See :class:`FastConfig`."""
    step: float = 1 / 100
    """Length of the cells of validation's quadrature, which is the renderer's and not that of training."""
    cells: int = 64
    """Cells along an edge of the occupancy grid for validation."""


Config = FastConfig | HierarchicalConfig

PRESETS: dict[str, Config] = {"fast": FastConfig(), "paper": HierarchicalConfig()}

NTF = {
    "mixture2": FAST.transmittance,
    "logistic": replace(FAST.transmittance, components=1),
    "ray": Network(Encoding("frequency", octaves=6), (128, 128, 128, 128)),
    "paper": PAPER.transmittance,
}
"""Transmittance networks by name. The first two are two logistics and one, from the ray's optical depths. The others
are the paper's kind, one logistic from the end points: of a size that CPUs can train, and of the paper's size."""


def configured(preset: str, *, ntf: str | None = None, augmentation: bool = True, colour_loss: bool = True,
               visibility_mlp: bool = False, bounces: bool = True, fresnel: bool = True,
               gains: bool = True, smoke: float | None = None) -> Config:
    """Return the settings of `preset` with changes.

    `ntf` names another transmittance network. `visibility_mlp` adds the baseline's network (NeRV's, of a point and a
    direction), trained on the same transmittance. `fresnel` is false for materials without a Fresnel effect. `smoke` is
    the asymmetry of the phase function of smoke; None means surfaces. The others are as in :class:`FastConfig`. Raises
    MiNtfError if a name is unknown or the asymmetry is out of range.
    """
    if preset not in PRESETS:
        raise MiNtfError(f"preset '{preset}' is unknown; it is one of {', '.join(PRESETS)}")
    if ntf is not None and ntf not in NTF:
        raise MiNtfError(f"--ntf '{ntf}' is unknown; it is one of {', '.join(NTF)}")
    if smoke is not None and not abs(smoke) < 1:
        raise MiNtfError(f"--asymmetry is {smoke:g}; expected a number between -1 and 1, exclusive")
    config = replace(PRESETS[preset], augmentation=augmentation, colour_loss=colour_loss)
    architecture = config.architecture
    if isinstance(config, FastConfig):
        fresnel &= smoke is None
        architecture = replace(architecture, fresnel=fresnel, retro=fresnel, tail=fresnel,
                               specular_channels=3 if fresnel else 1)
        config = replace(config, bounces=bounces, gains=gains)
    architecture = replace(architecture, phase=smoke)
    if ntf is not None:
        architecture = replace(architecture, transmittance=NTF[ntf])
    if visibility_mlp:
        architecture = replace(architecture, visibility=VISIBILITY)
    return replace(config, architecture=architecture)

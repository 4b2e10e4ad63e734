"""What decides a training run. Times are shares of the whole run, so a schedule scales with --minutes and --steps."""

from dataclasses import dataclass

from ..core.architecture import FAST, Architecture


@dataclass(frozen=True)
class TrainConfig:
    """One recipe. Lengths in field units (unit-sphere radii), weights relative to the colour loss."""

    architecture: Architecture = FAST
    samples: int = 20000
    """Field samples a step; the number of camera rays follows from how many samples a ray takes."""
    step: float = 1 / 100
    """Length of the cells of the quadrature: 200 across the unit sphere."""
    cells: int = 96
    """Occupancy grid, cells along an edge."""
    bake: int = 128
    """Density grid for normals, cells along an edge."""
    lr_planes: float = 0.1
    lr_layers: float = 3e-3
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
    """Weight of an even density along surfaces."""
    sharp: float = 1e-3
    """Weight of thin skins: −ln σ where pictures see matter."""
    gloss: float = 2e-3
    """Weight of the specular share: a rough lobe can stand in for the diffuse one in flash photographs, and then sends
    half as much again into all other directions."""
    smooth: float = 1e-3
    """Weight of total variation of the planes."""
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


PRESETS = {"fast": TrainConfig()}

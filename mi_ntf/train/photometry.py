"""Camera response that no scene knows of: exposure and white balance of each photograph, and clipped levels."""

import torch

from ..data.images import LINEAR
from .rays import Photographs

SATURATED = float(LINEAR[250])
"""Linear value from which an 8-bit level may stand for anything brighter."""
BLACK = float(LINEAR[3])
"""Linear value below which levels are mostly the camera's noise."""
BLACK_WEIGHT = 0.25
"""Weight of pixels below this value."""


class Gains:
    """Factors by channel of the photographs of the training split, of geometric mean 1 over all photographs.

    Photographs determine only the product of intensity and albedo, so the mean has to be fixed. Gains start at the mean
    brightness of the object in each photograph.
    """

    def __init__(self, photographs: Photographs):
        means = []
        for number in range(photographs.views):
            stride = max(1, min(photographs.height, photographs.width) // 128)
            pixels = photographs.pixels(photographs.frame(number, stride)[0])
            matter = pixels[pixels[:, 3] > (0.5 if photographs.masked else 0.99), :3]
            means.append(matter.mean(0) if len(matter) else torch.ones(3))
        logs = torch.stack(means).clamp(min=1e-6).log()
        self.first = photographs.first
        self.logs = torch.nn.Parameter((logs - logs.mean(0)).clamp(-2, 2))

    @torch.no_grad()
    def resume(self, gains: torch.Tensor) -> None:
        """Go on from the `gains` (views, 3) of an earlier run."""
        self.logs.copy_(gains.clamp(min=1e-6).log())

    def all(self) -> torch.Tensor:
        """Return the gains (views, 3)."""
        return (self.logs - self.logs.mean(0)).exp()

    def __call__(self, view: torch.Tensor) -> torch.Tensor:
        """Return the gains (n, 3) of the photographs `view` (n,)."""
        return self.all()[view - self.first]


def fitted(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the factors (3,) that bring the colours `predicted` (n, 3) closest to a held-out photograph `target`.

    They are least squares over the channels of `target` (n, 3) that are not saturated.
    """
    certain = (target < SATURATED).float()
    return (certain * predicted * target).sum(0) / (certain * predicted.square()).sum(0).clamp(min=1e-12)


def trust(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Return the weight of each channel (n, 3) of 8-bit photographs `target` (n, 4).

    A saturated channel has no weight if the prediction is brighter still. Nearly black ones on the object have a
    smaller weight.
    """
    color, matter = target[:, :3], target[:, 3:] > 0.5
    saturated = (color >= SATURATED) & (predicted.detach() > color)
    return torch.where(saturated, 0.0, torch.where(matter & (color < BLACK), BLACK_WEIGHT, 1.0))

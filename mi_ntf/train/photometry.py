"""What a camera does to light that no scene knows of: exposure and white balance by photograph, ends of its levels."""

import torch

from ..data.images import LINEAR
from .rays import Photographs

SATURATED = float(LINEAR[250])
"""Linear value from which on an 8-bit level may stand for anything brighter."""
BLACK = float(LINEAR[3])
"""Linear value under which levels are the camera's noise as much as light …"""
BLACK_WEIGHT = 0.25
"""… and how much they count."""


class Gains:
    """A factor a channel for each photograph for training, of geometric mean 1 over all of them.

    Intensity times albedo is all that photographs determine, so the mean has to be fixed. They start at the mean
    brightness of the object in each photograph.
    """

    def __init__(self, photographs: Photographs):
        means = []
        for number in range(photographs.views):
            stride = max(1, min(photographs.height, photographs.width) // 128)
            pixels = photographs.pixels(photographs.frame(number, stride)[0])
            object_ = pixels[pixels[:, 3] > (0.5 if photographs.masked else 0.99), :3]
            means.append(object_.mean(0) if len(object_) else torch.ones(3))
        logs = torch.stack(means).clamp(min=1e-6).log()
        self.first = photographs.first
        self.logs = torch.nn.Parameter((logs - logs.mean(0)).clamp(-2, 2))

    def all(self) -> torch.Tensor:
        """(views, 3)."""
        return (self.logs - self.logs.mean(0)).exp()

    def __call__(self, view: torch.Tensor) -> torch.Tensor:
        """Factors (n, 3) of photographs `view` (n,)."""
        return self.all()[view - self.first]


def fitted(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """The factors (3,) by which the colours `predicted` (n, 3) come nearest to those of a held-back photograph,
    `target` (n, 3), where that is not saturated: least squares."""
    sure = (target < SATURATED).float()
    return (sure * predicted * target).sum(0) / (sure * predicted.square()).sum(0).clamp(min=1e-12)


def trust(predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """How much each channel (n, 3) of 8-bit photographs `target` (n, 4) counts: what is saturated, nothing where the
    prediction is brighter still; what is nearly black on the object, less."""
    color, matter = target[:, :3], target[:, 3:] > 0.5
    saturated = (color >= SATURATED) & (predicted.detach() > color)
    return torch.where(saturated, 0.0, torch.where(matter & (color < BLACK), BLACK_WEIGHT, 1.0))

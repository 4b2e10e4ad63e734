"""Optical depths of packed samples, and the weights of alpha and light that follow from them."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Optical:
    """Optical depths (s,) of packed samples."""

    depth: torch.Tensor  # Optical depth of the sample's cell
    front: torch.Tensor  # Optical depth between the cell and the camera

    @classmethod
    def of(cls, sigma: torch.Tensor, ray: torch.Tensor, width: float | torch.Tensor) -> "Optical":
        """Return the optical depths of samples with density `sigma` (s,) in cells of `width`, one number or (s,).

        `ray` (s,) ascends. Sums run over all rays at once, in float64: at the last ray the sum is 10⁵, of which
        float32 keeps two decimals.
        """
        depth = sigma * width
        total = depth.double().cumsum(0)
        before = total - depth
        return cls(depth, (before - before[torch.searchsorted(ray, ray)]).float())

    def __getitem__(self, index: torch.Tensor) -> "Optical":
        return Optical(self.depth[index], self.front[index])

    def weights(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the alpha weights and the light weights, ``(w, v)``, (s,) each."""
        t = torch.exp(-self.front)
        return t * (1 - torch.exp(-self.depth)), t * t * (1 - torch.exp(-2 * self.depth)) / 2

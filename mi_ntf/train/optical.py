"""Optical depths of packed samples, and the weights of alpha and light that follow from them."""

from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Optical:
    """Packed samples' optical depths (s,): `depth` of their cells, `front` of what is between them and the camera."""

    depth: torch.Tensor
    front: torch.Tensor

    @classmethod
    def of(cls, sigma: torch.Tensor, ray: torch.Tensor, width: float | torch.Tensor) -> "Optical":
        """`ray` (s,) ascending, `sigma` (s,), `width` one or (s,).

        Sums run over all rays at once, in float64: at the last ray the sum is 10⁵, of which float32 keeps two decimals.
        """
        depth = sigma * width
        total = depth.double().cumsum(0)
        before = total - depth
        return cls(depth, (before - before[torch.searchsorted(ray, ray)]).float())

    def __getitem__(self, index) -> "Optical":
        return Optical(self.depth[index], self.front[index])

    def weights(self) -> tuple[torch.Tensor, torch.Tensor]:
        """``(w, v)``, alpha and light weights."""
        t = torch.exp(-self.front)
        return t * (1 - torch.exp(-self.depth)), t * t * (1 - torch.exp(-2 * self.depth)) / 2

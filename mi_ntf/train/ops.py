"""PyTorch's elementary functions under the names that the formulas of :mod:`mi_ntf.core` use."""

import torch

sqrt, exp, log, sin, cos, abs, where = torch.sqrt, torch.exp, torch.log, torch.sin, torch.cos, torch.abs, torch.where


def maximum(x: torch.Tensor | float, y: torch.Tensor | float) -> torch.Tensor:
    """Return the larger of `x` and `y`; one of them may be a Python number."""
    if not isinstance(y, torch.Tensor):
        return torch.as_tensor(x).clamp(min=y)
    return torch.maximum(x, y) if isinstance(x, torch.Tensor) else y.clamp(min=x)


def minimum(x: torch.Tensor | float, y: torch.Tensor | float) -> torch.Tensor:
    """Return the smaller of `x` and `y`; one of them may be a Python number."""
    if not isinstance(y, torch.Tensor):
        return torch.as_tensor(x).clamp(max=y)
    return torch.minimum(x, y) if isinstance(x, torch.Tensor) else y.clamp(max=x)

"""PyTorch's elementary functions under the names that :mod:`mi_ntf.core` formulas use."""

import torch

sqrt, exp, log, sin, cos, abs, where = torch.sqrt, torch.exp, torch.log, torch.sin, torch.cos, torch.abs, torch.where


def maximum(x, y):
    """Larger of `x` and `y`; one of them may be a Python number."""
    if not torch.is_tensor(y):
        return x.clamp(min=y)
    return torch.maximum(x, y) if torch.is_tensor(x) else y.clamp(min=x)


def minimum(x, y):
    """Smaller of `x` and `y`; one of them may be a Python number."""
    if not torch.is_tensor(y):
        return x.clamp(max=y)
    return torch.minimum(x, y) if torch.is_tensor(x) else y.clamp(max=x)

"""Device of training: a GPU where PyTorch finds one, else the CPU. ``CUDA_VISIBLE_DEVICES=`` forces the CPU."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def chosen() -> Iterator[None]:
    """Create new tensors on the device of this process: GPU number LOCAL_RANK (0 outside ``torchrun``), or the CPU."""
    if not torch.cuda.is_available():
        yield
        return
    device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")) % torch.cuda.device_count())
    torch.cuda.set_device(device)
    with device:
        yield


def generator(seed: int) -> torch.Generator:
    """Return a source of random numbers on the device of new tensors."""
    return torch.Generator(torch.get_default_device()).manual_seed(seed)

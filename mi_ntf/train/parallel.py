"""Data-parallel training over the processes that ``torchrun`` starts: gradients averaged, parameters the same in all.

Every process draws the same global batch, since all generators have the same seed, and evaluates the networks, forward
and backward, at its share of the points. The values are gathered; compositing, losses and decisions see all of them in
every process. So the run is that of one process at the same batch whatever the losses are, up to the order of sums;
a term that does not go through :class:`Shared` is computed by all processes alike, and is right too.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise

import torch
import torch.distributed as dist

from . import device
from .networks import Networks


@contextmanager
def processes() -> Iterator[None]:
    """Join the processes of ``torchrun``, if it started this one (it sets WORLD_SIZE), and leave them at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    dist.init_process_group(device.backend())
    try:
        yield
    finally:
        dist.destroy_process_group()


def count() -> int:
    """Number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def first() -> bool:
    """Whether this is the process that prints and writes files."""
    return count() == 1 or dist.get_rank() == 0


def agreed(value: float) -> float:
    """The first process's `value`: what all of them base decisions about time on."""
    if count() == 1:
        return value
    tensor = torch.tensor([value], dtype=torch.float64)
    dist.broadcast(tensor, 0)
    return float(tensor)


def average_gradients(tensors: list[torch.Tensor]) -> None:
    """Replace the gradients of `tensors` by their mean over the processes, in one message."""
    if count() == 1:
        return
    gradients = [t.grad for t in tensors if t.grad is not None]
    flat = torch.cat([g.reshape(-1) for g in gradients])
    dist.all_reduce(flat)
    flat /= count()
    for gradient, mean in zip(gradients, flat.split([g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def share(networks: Networks) -> Networks:
    """`networks`, evaluated by all processes together; the same tensors. Unchanged where there is one process."""
    return networks if count() == 1 else Shared(**vars(networks))


class Shared(Networks):
    """Networks whose points are divided among the processes. All processes must call them with the same points."""

    def log_density(self, x):
        return divided(Networks(**vars(self)).log_density, x)

    def reflectance(self, x):
        return divided(Networks(**vars(self)).reflectance, x)

    def ray_mixture(self, o, d, profile):
        return divided(Networks(**vars(self)).ray_mixture, o, d, profile)

    def visibility(self, x, d):
        return divided(Networks(**vars(self)).visibility, x, d)


def divided(function: Callable, *arguments: torch.Tensor):
    """``function(*arguments)``, each process computing some of the rows.

    `arguments` have n rows each, and so has every tensor that `function` returns, row for row: one tensor or a tuple,
    floating point or bool.
    """
    n, size = len(arguments[0]), count()
    if n < size:
        return function(*arguments)
    bounds = [i * n // size for i in range(size + 1)]
    own = slice(bounds[dist.get_rank()], bounds[dist.get_rank() + 1])
    result = function(*(a[own] for a in arguments))
    parts = result if isinstance(result, tuple) else (result,)
    columns = [p.reshape(len(p), -1) for p in parts]
    gathered = _Gather.apply(torch.cat([c.to(arguments[0].dtype) for c in columns], 1), bounds)
    whole = [g.reshape(n, *p.shape[1:]) for g, p in zip(gathered.split([c.shape[1] for c in columns], 1), parts,
                                                      strict=True)]
    whole = [g > 0.5 if p.dtype is torch.bool else g for g, p in zip(whole, parts, strict=True)]
    return tuple(whole) if isinstance(result, tuple) else whole[0]


class _Gather(torch.autograd.Function):
    """The rows ``bounds[i]:bounds[i + 1]`` of every process i, in order.

    Every process knows the loss's gradient at all rows. It passes on that of its own rows, times the number of
    processes: the mean over the processes that :func:`average_gradients` takes is then the sum over all rows.
    """

    @staticmethod
    def forward(ctx, own, bounds):
        ctx.bounds = bounds
        padded = own.new_zeros(max(b - a for a, b in pairwise(bounds)), own.shape[1])
        padded[:len(own)] = own
        parts = [torch.empty_like(padded) for _ in range(count())]
        dist.all_gather(parts, padded)
        return torch.cat([part[:b - a] for part, (a, b) in zip(parts, pairwise(bounds), strict=True)])

    @staticmethod
    def backward(ctx, gradient):
        rank = dist.get_rank()
        return gradient[ctx.bounds[rank]:ctx.bounds[rank + 1]] * count(), None

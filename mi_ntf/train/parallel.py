"""Data-parallel training over the processes that ``torchrun`` starts.

Each process draws the same global batch, since all generators have the same seed. It evaluates the networks, forward
and backward, at its part of the points, and the values are gathered. Compositing, losses and decisions see all values
in every process. Gradients are averaged, so all processes keep the same parameters. The result is that of one process
with the same batch, up to the order of sums. A loss term that does not go through :class:`Shared` is computed by
all processes alike, which is right too.
"""

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import pairwise
from typing import Protocol

import torch
import torch.distributed as dist

from .networks import Networks, Reflectance


@contextmanager
def processes() -> Iterator[None]:
    """Join the processes of ``torchrun``, if it started this one (it sets WORLD_SIZE), and leave them at the end."""
    if int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield
        return
    dist.init_process_group("nccl" if torch.get_default_device().type == "cuda" else "gloo")
    try:
        yield
    finally:
        dist.destroy_process_group()


def count() -> int:
    """Return the number of processes that train together."""
    return dist.get_world_size() if dist.is_initialized() else 1


def first() -> bool:
    """Return True in the process that prints and writes files."""
    return count() == 1 or dist.get_rank() == 0


def agreed(value: float) -> float:
    """Return the first process's `value`, on which all processes base decisions about time."""
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
    for gradient, mean in zip(gradients, torch.split(flat, [g.numel() for g in gradients]), strict=True):
        gradient.copy_(mean.view_as(gradient))


def distributed(networks: Networks) -> Networks:
    """Return `networks` for evaluation by all processes together; with one process, return `networks` itself."""
    return networks if count() == 1 else Shared(**vars(networks))


class Shared(Networks):
    """Networks whose points are divided among the processes. All processes must call them with the same points."""

    def log_density(self, x: torch.Tensor) -> torch.Tensor:
        """See :class:`Networks`."""
        return divided(lambda *a: (self._alone().log_density(*a),), x)[0]

    def reflectance(self, x: torch.Tensor) -> Reflectance:
        """See :class:`Networks`."""
        return Reflectance(*divided(self._alone().reflectance, x))

    def ray_mixture(self, o: torch.Tensor, d: torch.Tensor, profile: torch.Tensor
                    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See :class:`Networks`."""
        hit, mix = divided(self._alone().ray_mixture, o, d, profile)
        return hit, mix

    def visibility(self, x: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """See :class:`Networks`."""
        return divided(lambda *a: (self._alone().visibility(*a),), x, d)[0]

    def _alone(self) -> Networks:
        """Return the networks as this process evaluates them."""
        return Networks(self.architecture, self.tensors)


def divided(function: Callable[..., tuple[torch.Tensor, ...]], *arguments: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """Return ``function(*arguments)``, of which each process computes some of the rows.

    `arguments` have n rows each, and so has every tensor that `function` returns, floating point or bool, row for row.
    """
    n, size = len(arguments[0]), count()
    if n < size:
        return function(*arguments)
    bounds = [i * n // size for i in range(size + 1)]
    rows = slice(bounds[dist.get_rank()], bounds[dist.get_rank() + 1])
    parts = function(*(a[rows] for a in arguments))
    columns = [p.reshape(len(p), -1) for p in parts]
    gathered = _gather(torch.cat([c.to(arguments[0].dtype) for c in columns], 1), bounds)
    whole = [g.reshape(n, *p.shape[1:]) for g, p in zip(
        torch.split(gathered, [c.shape[1] for c in columns], 1), parts, strict=True)]
    return tuple(g > 0.5 if p.dtype is torch.bool else g for g, p in zip(whole, parts, strict=True))


class _Context(Protocol):
    """The part of PyTorch's autograd context that :class:`_Gather` uses."""

    bounds: list[int]


class _Gather(torch.autograd.Function):
    """Concatenation of the rows ``bounds[i]:bounds[i + 1]`` of every process i.

    Every process knows the gradient of the loss at all rows. It passes on that of its rows, times the number of
    processes: the mean that :func:`average_gradients` takes over the processes is then the sum over all rows.
    """

    @staticmethod
    def forward(ctx: _Context, rows: torch.Tensor, bounds: list[int]) -> torch.Tensor:
        ctx.bounds = bounds
        padded = rows.new_zeros(max(b - a for a, b in pairwise(bounds)), rows.shape[1])
        padded[:len(rows)] = rows
        parts = [torch.empty_like(padded) for _ in range(count())]
        dist.all_gather(parts, padded)
        return torch.cat([part[:b - a] for part, (a, b) in zip(parts, pairwise(bounds), strict=True)])

    @staticmethod
    def backward(ctx: _Context, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        rank = dist.get_rank()
        return gradient[ctx.bounds[rank]:ctx.bounds[rank + 1]] * count(), None


_gather: Callable[[torch.Tensor, list[int]], torch.Tensor] = _Gather.apply

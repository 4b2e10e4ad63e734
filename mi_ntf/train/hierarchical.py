"""The paper's recipe (method.md, sections 1 and 5): coarse and fine networks on samples along whole chords.

Nothing of the photographs but their colours is used, no mask, no visual hull. 64 stratified samples a ray go through
the coarse networks, 128 more are drawn where those find matter, and the fine networks see all 192. The coarse networks
have their own colour loss; the field file gets the fine ones alone, since renderers sample by density.
"""

from dataclasses import dataclass
from pathlib import Path

import torch

from ..core.errors import MiNtfError
from . import device, losses, networks, occupancy, parallel
from .config import HierarchicalConfig
from .networks import Networks, density_from_log
from .rays import Rays
from .recipe import FIELD, Recipe, total
from .transmittance_targets import CUT, chords, random_chords
from .volume import Image, render, scatter_sum


def stratified(rays: Rays, count: int, generator: torch.Generator):
    """``(t, width)``, a sample (n, count) in each of `count` equal cells of the rays' pieces; the cells' widths."""
    width = ((rays.t1 - rays.t0) / count)[:, None]
    place = torch.arange(count) + torch.rand(len(rays), count, generator=generator)
    return rays.t0[:, None] + place * width, width.expand(-1, count)


def draw(weight: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Places (n, m) in [0, 1] where the share `u` (n, m) in [0, 1) of the `weight` (n, k) of k equal cells lies before.

    A little weight is added to each cell, so that rays through nothing are sampled evenly.
    """
    k = weight.shape[1]
    share = (weight + 1e-5).cumsum(1)
    share = torch.cat([torch.zeros_like(share[:, :1]), share / share[:, -1:]], 1)
    cell = (torch.searchsorted(share, u.contiguous(), right=True) - 1).clamp(0, k - 1)
    low, high = share.gather(1, cell), share.gather(1, cell + 1)
    return (cell + ((u - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)) / k


def edges(t: torch.Tensor, rays: Rays) -> torch.Tensor:
    """Bounds (n, k + 1) of the cells of ascending samples `t` (n, k): middles between them, and the pieces' ends."""
    middle = (t[:, 1:] + t[:, :-1]) / 2
    return torch.cat([rays.t0[:, None], middle, rays.t1[:, None]], 1)


def composite(nets: Networks, rays: Rays, t: torch.Tensor, width: torch.Tensor) -> Image:
    """The rays' image from samples `t` (n, k) in cells of `width` (n, k)."""
    index = torch.arange(len(rays)).repeat_interleave(t.shape[1])
    return render(nets, rays, (index, t.reshape(-1), width.reshape(-1)))


@dataclass(frozen=True)
class View:
    """Rays rendered by both pairs of networks: `t` (n, k) the fine samples, `tau` (n, k) their marched transmittance
    back to the camera, which is the light; no gradient."""

    coarse: Image
    fine: Image
    t: torch.Tensor
    tau: torch.Tensor


def view(coarse: Networks, fine: Networks, rays: Rays, counts: tuple[int, int], generator: torch.Generator) -> View:
    """Render `rays` with ``counts[0]`` coarse samples and ``counts[1]`` more that follow their weights."""
    t, width = stratified(rays, counts[0], generator)
    first = composite(coarse, rays, t, width)
    weight = torch.zeros(t.numel()).index_copy(0, first.index, first.weight.detach()).view(t.shape)
    u = (torch.arange(counts[1]) + torch.rand(len(rays), counts[1], generator=generator)) / counts[1]
    more = rays.t0[:, None] + draw(weight, u.clamp(max=1 - 1e-6)) * (rays.t1 - rays.t0)[:, None]
    t = torch.cat([t, more], 1).sort(1).values
    bounds = edges(t, rays)
    second = composite(fine, rays, t, bounds.diff(dim=1))
    sigma = density_from_log(second.raw.detach()).view(t.shape)
    depth = sigma * bounds.diff(dim=1)
    tau = torch.exp(-(depth.cumsum(1) - depth + sigma * (t - bounds[:, :-1])))
    return View(first, second, t, tau)


class Hierarchical(Recipe):
    """The paper's step: patches of some photographs train the field, they and random rays its transmittance."""

    config: HierarchicalConfig

    def __init__(self, dataset: Path, config: HierarchicalConfig, minutes: float | None, steps: int | None, seed: int,
                 reading: dict | None = None, estimate: bool = False):
        if config.architecture.transmittance.encoding.kind == "depth":
            raise MiNtfError("the paper's recipe bakes no density, which this --ntf reads; take --ntf ray or none")
        super().__init__(dataset, config, minutes, steps, seed, reading)
        initial = networks.initial(config.architecture, config.log_density, self.generator)
        tensors = {k: v for k, v in initial.tensors.items() if k.split(".")[0] in FIELD}
        self.coarse = parallel.share(Networks(config.architecture, tensors))
        fine = self.nets.tensors.items()
        field = [v for k, v in fine if k.split(".")[0] in FIELD] + list(tensors.values())
        rest = [v for k, v in fine if k.split(".")[0] not in FIELD]
        self.optimizers = {"field": self._adam(field), "ntf": self._adam(rest)}
        camera = self.photographs["train"]
        if estimate or not self.on_lens:
            raise MiNtfError("the preset 'paper' needs a flash at the lens, and these photographs' is elsewhere; take "
                             "the preset 'fast'")
        self.distance, self.power = camera.origin.norm(dim=1).mean().float(), camera.light.mean(0)

    def _adam(self, tensors: list[torch.Tensor]) -> torch.optim.Adam:
        return torch.optim.Adam([{"params": tensors, "base": self.config.lr}], fused=True)

    def parameters(self) -> dict[str, torch.Tensor]:
        return self.nets.tensors | {f"coarse.{k}": v for k, v in self.coarse.tensors.items()}

    def occupied(self) -> occupancy.Occupancy:
        generator = device.generator(3)
        return occupancy.from_networks(self.nets, self.config.cells, CUT, generator)

    def patches(self) -> Rays:
        """The rays of one square patch of each of ``config.images`` random photographs."""
        c, g = self.config, self.generator
        pool = self.photographs["train"]
        count, height, width = pool.views, pool.height, pool.width
        size = min(c.patch, height, width)
        image = torch.randperm(count, generator=g)[:c.images]
        row = torch.randint(height - size + 1, (len(image),), generator=g)
        column = torch.randint(width - size + 1, (len(image),), generator=g)
        step = torch.arange(size)
        pixel = ((image * height + row)[:, None, None] + step[:, None]) * width + column[:, None, None] + step
        return pool[pixel.reshape(-1)]

    def random_rays(self) -> Rays:
        """Chords of two uniform points, seen and lit from as far as the photographs were taken; no pixels."""
        m, toward = random_chords(self.config.random_rays, 1.0, self.generator)
        m, h = chords(m, toward)
        far = torch.maximum(self.distance, h + 0.01)
        n = len(m)
        return Rays(m + far[:, None] * toward, -toward, far - h, far + h, torch.zeros(n, 4), self.power.expand(n, 3),
                    torch.zeros(n, dtype=torch.long))

    def ntf_loss(self, seen: View, rays: Rays, target: torch.Tensor) -> dict[str, torch.Tensor]:
        """L_nt of `rays` whose pixels should be `target` (n, 3): Σ_x (τ_nrf − τ_nt)² + ‖I_nt − I‖², means over rays."""
        toward = -rays.d
        unread = rays.t0[:, None]  # stands for the optical depths, which this recipe's network does not read
        hit, mix = self.nets.ray_mixture(rays.o, toward, unread)
        place = (rays.o * toward).sum(1, keepdim=True) - seen.t
        tau = losses.tau(mix, place)
        terms = {"transmittance": (hit[:, None] * (tau - seen.tau).square()).sum(1).mean()}
        if self.config.colour_loss:
            image = seen.fine
            lit = (tau.reshape(-1)[image.index] * image.weight.detach())[:, None] * image.radiance.detach()
            terms["lit colour"] = self._error(scatter_sum(lit, image.shaded, len(rays)), target)
        if self.config.architecture.visibility is not None:
            x = rays.o[:, None] + seen.t[:, :, None] * rays.d[:, None]
            alone = self.nets.visibility(x.reshape(-1, 3), toward.repeat_interleave(seen.t.shape[1], 0))
            terms["visibility"] = (alone.view(seen.t.shape) - seen.tau).square().sum(1).mean()
        return terms

    def _error(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """‖p − t‖² of linear RGB, in units of the photographs' bright parts."""
        return ((predicted - target) * self.exposure).square().sum(1).mean()

    def advance(self) -> float:
        """One step of the field and one of its transmittance."""
        c = self.config
        counts = (c.coarse, c.fine)
        batch = self.patches()
        seen = view(self.coarse, self.nets, batch, counts, self.generator)
        self.trained[0] += len(batch)
        self.trained[1] += len(batch) * (2 * c.coarse + c.fine)
        target = batch.target[:, :3]
        self.terms = {"coarse colour": self._error(seen.coarse.color, target),
                      "colour": self._error(seen.fine.color, target)}
        loss = total(self.terms)
        self.watch.check("field", float(loss.detach()), self.step)
        value = self._descend("field", loss, 1.0)
        terms = self.ntf_loss(seen, batch, target)
        if c.augmentation:
            rays = self.random_rays()
            with torch.no_grad():
                seen = view(self.coarse, self.nets, rays, counts, self.generator)
            terms |= {f"random {k}": v for k, v in self.ntf_loss(seen, rays, seen.fine.color).items()}
        loss = total(terms)
        self.watch.check("ntf", float(loss.detach()), self.step)
        self.terms |= terms
        return value + self._descend("ntf", loss, 1.0)

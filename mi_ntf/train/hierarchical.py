"""The recipe of Shafiei et al. 2021: coarse and fine networks on samples along whole chords.

It uses nothing of the photographs but their colours: no mask, no visual hull. 64 stratified samples of each ray go
through the coarse networks, 128 more are placed where those find matter, and the fine networks see all 192. The coarse
networks have a colour loss as well. The field file gets the fine ones alone, since renderers sample by density.
"""

from dataclasses import dataclass

import torch

from ..core.errors import MiNtfError
from . import device, losses, networks, occupancy, parallel
from .checkpoint import State
from .config import HierarchicalConfig
from .networks import Networks, Tensors, density_from_log
from .photometry import Gains
from .rays import Rays
from .recipe import FIELD, Run, Snapshot, copy_into, total
from .scoring import Light
from .transmittance_targets import CUT, chords, random_chords
from .volume import Image, Samples, render, scatter_sum


def stratified(rays: Rays, count: int, generator: torch.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a random sample in each of `count` equal cells of the rays' pieces, and the cells' widths (n, count)."""
    width = ((rays.t1 - rays.t0) / count)[:, None]
    place = torch.arange(count) + torch.rand(len(rays), count, generator=generator)
    return rays.t0[:, None] + place * width, width.expand(-1, count)


def inverse_cdf(weight: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Return places (n, m) in [0, 1] with the fraction `u` (n, m) of the `weight` (n, k) of k equal cells before them.

    A little weight is added to each cell, so that rays through empty space are sampled evenly.
    """
    k = weight.shape[1]
    cdf = (weight + 1e-5).cumsum(1)
    cdf = torch.cat([torch.zeros_like(cdf[:, :1]), cdf / cdf[:, -1:]], 1)
    cell = (torch.searchsorted(cdf, u.contiguous(), right=True) - 1).clamp(0, k - 1)
    low, high = cdf.gather(1, cell), cdf.gather(1, cell + 1)
    return (cell + ((u - low) / (high - low).clamp(min=1e-12)).clamp(0, 1)) / k


def edges(t: torch.Tensor, rays: Rays) -> torch.Tensor:
    """Return bounds (n, k + 1) of the cells of ascending samples `t` (n, k): midpoints, and the ends of the pieces."""
    middle = (t[:, 1:] + t[:, :-1]) / 2
    return torch.cat([rays.t0[:, None], middle, rays.t1[:, None]], 1)


def composite(nets: Networks, rays: Rays, t: torch.Tensor, width: torch.Tensor) -> Image:
    """Return the image of `rays` from samples `t` (n, k) in cells of `width` (n, k)."""
    index = torch.arange(len(rays)).repeat_interleave(t.shape[1])
    return render(nets, rays, Samples(index, t.reshape(-1), width.reshape(-1)))


@dataclass(frozen=True)
class View:
    """Rays rendered by both pairs of networks."""

    coarse: Image
    fine: Image
    t: torch.Tensor  # Fine samples (n, k)
    tau: torch.Tensor
    """Marched transmittance (n, k) from the samples to the camera, which is the light; without gradient."""


def view(coarse: Networks, fine: Networks, rays: Rays, counts: tuple[int, int], generator: torch.Generator) -> View:
    """Render `rays` with ``counts[0]`` coarse samples and ``counts[1]`` more that follow their weights."""
    t, width = stratified(rays, counts[0], generator)
    first = composite(coarse, rays, t, width)
    weight = torch.zeros(t.numel()).index_copy(0, first.index, first.weight.detach()).view(t.shape)
    u = (torch.arange(counts[1]) + torch.rand(len(rays), counts[1], generator=generator)) / counts[1]
    more = rays.t0[:, None] + inverse_cdf(weight, u.clamp(max=1 - 1e-6)) * (rays.t1 - rays.t0)[:, None]
    t = torch.cat([t, more], 1).sort(1).values
    bounds = edges(t, rays)
    second = composite(fine, rays, t, bounds.diff(dim=1))
    sigma = density_from_log(second.raw.detach()).view(t.shape)
    depth = sigma * bounds.diff(dim=1)
    tau = torch.exp(-(depth.cumsum(1) - depth + sigma * (t - bounds[:, :-1])))
    return View(first, second, t, tau)


class Hierarchical:
    """The paper's recipe: patches of some photographs train the field; they and random rays, its transmittance."""

    field_until = 1.0  # Field and transmittance learn together to the end
    gains: Gains | None = None
    light = Light()

    def __init__(self, config: HierarchicalConfig, run: Run, estimate: bool = False):
        if config.architecture.transmittance.encoding.kind == "depth":
            raise MiNtfError("the paper's recipe bakes no density, which this --ntf reads; take --ntf ray or none")
        if estimate or not run.data.on_lens:
            raise MiNtfError("the preset 'paper' needs a flash at the lens, and these photographs' is elsewhere; take "
                             "the preset 'fast'")
        self.config, self.data, self.learner, self.generator = config, run.data, run.learner, run.generator
        self.networks = parallel.distributed(networks.initial(config.architecture, config.log_density, self.generator))
        initial = networks.initial(config.architecture, config.log_density, self.generator)
        tensors = {k: v for k, v in initial.tensors.items() if k.split(".")[0] in FIELD}
        self.coarse = parallel.distributed(Networks(config.architecture, tensors))
        fine = self.networks.tensors.items()
        field = [v for k, v in fine if k.split(".")[0] in FIELD] + list(tensors.values())
        rest = [v for k, v in fine if k.split(".")[0] not in FIELD]
        self.learner.optimizers = {"field": self._adam(field), "ntf": self._adam(rest)}
        camera = self.data.train
        self.distance, self.power = camera.origin.norm(dim=1).mean().float(), camera.light.mean(0)

    def _adam(self, tensors: list[torch.Tensor]) -> torch.optim.Adam:
        return torch.optim.Adam([{"params": tensors, "base": self.config.lr}], fused=True)

    def carve(self) -> None:
        """Do nothing: the paper's recipe knows no hull."""

    def parameters(self) -> Tensors:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return self.networks.tensors | {f"coarse.{k}": v for k, v in self.coarse.tensors.items()}

    def occupied(self) -> occupancy.Occupancy:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return occupancy.from_networks(self.networks, self.config.cells, CUT, device.generator(3))

    def snapshot(self) -> Snapshot:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        return {"field": {k: v.detach().clone() for k, v in self.parameters().items()}}

    def adopt(self, snapshot: Snapshot) -> None:
        """See :class:`mi_ntf.train.recipe.Recipe`."""
        copy_into(self.parameters(), snapshot["field"])

    def state(self) -> State:
        """Return nothing: parameters, optimisers and random numbers decide the next step."""
        return {}

    def restore(self, state: State) -> None:
        """Do nothing, see :meth:`state`."""

    def patches(self) -> Rays:
        """Return the rays of one square patch of each of ``config.images`` random photographs."""
        c, g, pool = self.config, self.generator, self.data.train
        count, height, width = pool.views, pool.height, pool.width
        size = min(c.patch, height, width)
        image = torch.randperm(count, generator=g)[:c.images]
        row = torch.randint(height - size + 1, (len(image),), generator=g)
        column = torch.randint(width - size + 1, (len(image),), generator=g)
        step = torch.arange(size)
        pixel = ((image * height + row)[:, None, None] + step[:, None]) * width + column[:, None, None] + step
        return pool[pixel.reshape(-1)]

    def random_rays(self) -> Rays:
        """Return chords of two uniform points, seen and lit from the mean distance of the cameras; without pixels."""
        m, toward = random_chords(self.config.random_rays, 1.0, self.generator)
        m, h = chords(m, toward)
        far = torch.maximum(self.distance, h + 0.01)
        n = len(m)
        return Rays(m + far[:, None] * toward, -toward, far - h, far + h, torch.zeros(n, 4), self.power.expand(n, 3),
                    torch.zeros(n, dtype=torch.long))

    def ntf_loss(self, rendered: View, rays: Rays, target: torch.Tensor) -> Tensors:
        """Return L_nt of `rays` with the pixels `target` (n, 3): Σ_x (τ_nrf − τ_nt)² + ‖I_nt − I‖², means over rays."""
        toward = -rays.d
        unread = rays.t0[:, None]  # stands for the optical depths, which this recipe's network does not read
        hit, mix = self.networks.ray_mixture(rays.o, toward, unread)
        place = (rays.o * toward).sum(1, keepdim=True) - rendered.t
        tau = losses.tau(mix, place)
        terms = {"transmittance": (hit[:, None] * (tau - rendered.tau).square()).sum(1).mean()}
        if self.config.colour_loss:
            image = rendered.fine
            lit = (tau.reshape(-1)[image.index] * image.weight.detach())[:, None] * image.radiance.detach()
            terms["lit colour"] = self._error(scatter_sum(lit, image.shaded, len(rays)), target)
        if self.config.architecture.visibility is not None:
            x = rays.o[:, None] + rendered.t[:, :, None] * rays.d[:, None]
            predicted = self.networks.visibility(x.reshape(-1, 3), toward.repeat_interleave(rendered.t.shape[1], 0))
            terms["visibility"] = (predicted.view(rendered.t.shape) - rendered.tau).square().sum(1).mean()
        return terms

    def _error(self, predicted: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        """Return ‖p − t‖² of linear RGB, relative to the bright parts of the photographs."""
        return ((predicted - target) * self.data.exposure).square().sum(1).mean()

    def advance(self) -> float:
        """Take one step of the field and one of its transmittance."""
        c, learner = self.config, self.learner
        counts = (c.coarse, c.fine)
        batch = self.patches()
        rendered = view(self.coarse, self.networks, batch, counts, self.generator)
        learner.rays += len(batch)
        learner.samples += len(batch) * (2 * c.coarse + c.fine)
        target = batch.target[:, :3]
        learner.terms = {"coarse colour": self._error(rendered.coarse.color, target),
                         "colour": self._error(rendered.fine.color, target)}
        loss = total(learner.terms)
        learner.check("field", loss)
        value = learner.descend("field", loss, 1.0)
        terms = self.ntf_loss(rendered, batch, target)
        if c.augmentation:
            rays = self.random_rays()
            with torch.no_grad():
                rendered = view(self.coarse, self.networks, rays, counts, self.generator)
            terms |= {f"random {k}": v for k, v in self.ntf_loss(rendered, rays, rendered.fine.color).items()}
        loss = total(terms)
        learner.check("ntf", loss)
        learner.terms |= terms
        return value + learner.descend("ntf", loss, 1.0)

"""The networks in PyTorch: the trainable twin of :mod:`mi_ntf.core.reference`, same conventions, same names.

Tensors live in the file's own layout, planes as (3, v, u, channels): seen as (3, channels, v, u) that is PyTorch's
"channels last", the layout in which ``grid_sample`` is three times faster.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F

from ..core import depth_profile, logistic, mixture, spheres
from ..core.architecture import MAX_LOG_DENSITY, MIN_LOG_DENSITY, NO_VISIBILITY, Architecture, Encoding
from ..core.errors import MiNtfError
from ..core.microfacet import MIN_ROUGHNESS
from ..core.reference import PLANES
from . import ops

MATT = -3.0
"""logit of the specular weight at the start: lobes have to show first."""


@dataclass(frozen=True)
class Networks:
    """An architecture and its tensors, name → tensor as in ``architecture.skeleton()``."""

    architecture: Architecture
    tensors: dict[str, torch.Tensor]

    @property
    def fresnel(self) -> bool:
        """Whether the specular weight is the normal reflectance (:mod:`mi_ntf.core.fresnel`)."""
        return self.architecture.fresnel

    def log_density(self, x: torch.Tensor) -> torch.Tensor:
        """ln σ (n,) of the points `x` (n, 3), before it is clipped to the format's range."""
        features = encode(self.architecture.density.encoding, self.tensors, "density", x)
        return perceptron(self.tensors, "density", features)[:, 0]

    def density(self, x: torch.Tensor) -> torch.Tensor:
        """σ (n,), 1/(unit-sphere radius)."""
        return density_from_log(self.log_density(x))

    def reflectance(self, x: torch.Tensor):
        """``(normal (n, 3) unit, albedo (n, 3), roughness (n,), specular (n,))``, ranges as in core.reference."""
        features = encode(self.architecture.reflectance.encoding, self.tensors, "reflectance", x)
        raw = perceptron(self.tensors, "reflectance", features)
        rest = torch.sigmoid(raw[:, 3:])
        roughness = MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * rest[:, 3]
        least = self.architecture.least_specular
        specular = least + (1 - least) * rest[:, 4]
        return F.normalize(raw[:, :3], dim=1, eps=1e-10), rest[:, :3], roughness, specular

    def ray_mixture(self, o: torch.Tensor, d: torch.Tensor, profile: torch.Tensor):
        """``(hit (n,), mixture (n, K, 3))`` of rays through `o` along unit directions `d` towards the light.

        `profile` (n, k): optical depths from equidistant points of the chords, far ends first, to the light-side ends
        (``TransmittanceTargets.march``), read by the encoding ``depth``. The last axis is (w, a, b), see
        :mod:`mi_ntf.core.mixture`.
        """
        net = self.architecture.transmittance
        hit, m, h = spheres.chord(ops, o.unbind(1), d.unbind(1))
        count = 2 * net.components
        if net.encoding.kind == "depth":
            places = crossings(profile, h, profile.new_tensor(depth_profile.LEVELS)).unbind(1)
            total = profile[:, 0]
            features = torch.stack(depth_profile.features(ops, places, total, h), 1)
            raw = perceptron(self.tensors, "transmittance", features).unbind(1)
            pairs = depth_profile.components(ops, raw[:count], places, total, h)
        else:
            ends = torch.cat([torch.stack(p, 1) for p in spheres.end_points(m, d.unbind(1), h)], 1)
            features = encode(net.encoding, self.tensors, "transmittance", ends)
            raw = perceptron(self.tensors, "transmittance", features).unbind(1)
            pairs = [logistic.parameters(ops, raw[i], raw[i + 1], h) for i in range(0, count, 2)]
        mix = mixture.from_outputs(ops, pairs, list(raw[count:]), h)
        return hit, torch.stack([torch.stack(part, 1) for part in mix], 1)

    def visibility(self, x: torch.Tensor, d: torch.Tensor) -> torch.Tensor:
        """τ (n,) from the points `x` (n, 3) along unit directions `d` towards the light, by the baseline's network."""
        net = self.architecture.visibility
        if net is None:
            raise MiNtfError(NO_VISIBILITY)
        features = encode(net.encoding, self.tensors, "visibility", torch.cat([x, d], 1))
        return torch.sigmoid(perceptron(self.tensors, "visibility", features)[:, 0])


def crossings(profile: torch.Tensor, h: torch.Tensor, levels: torch.Tensor) -> torch.Tensor:
    """Where the profiles (n, k) of half chords `h` pass the depths `levels`, (l,) or (n, l): places (n, l), linear
    between their points."""
    steps = profile.shape[1] - 1
    falling = profile.flip(1).contiguous()  # from the light, ascending
    levels = levels.expand(len(profile), -1).contiguous()
    after = torch.searchsorted(falling, levels).clamp(1, steps)
    d0, d1 = falling.gather(1, after - 1), falling.gather(1, after)
    share = ((levels - d0) / (d1 - d0).clamp(min=1e-9)).clamp(0, 1)
    return h[:, None] * (1 - (after - 1 + share) * (2 / steps))


def density_from_log(raw: torch.Tensor) -> torch.Tensor:
    """σ = exp(raw), clipped as in the format. Gradients do not see the clip, so that no point is stuck beyond it."""
    # The difference of two like numbers is 0 for any size: what is added to the clipped value has its slope alone.
    return torch.exp(raw.detach().clamp(MIN_LOG_DENSITY, MAX_LOG_DENSITY) + (raw - raw.detach()))


def encode(encoding: Encoding, tensors: dict, name: str, x: torch.Tensor) -> torch.Tensor:
    """Features (n, ``encoding.width``) of the points `x` (n, 3), or of rays (n, 6). Planes give no gradient to `x`."""
    if encoding.kind == "frequency":
        angles = [math.pi * 2.0**k * x for k in range(encoding.octaves)]
        return torch.cat([x, *(f(a) for a in angles for f in (torch.sin, torch.cos))], dim=1)
    count = len(encoding.resolutions)
    levels = [_PlaneProduct.apply(tensors[f"{name}.planes.{i}"], x.detach()) for i in range(count)]
    return torch.cat(levels, dim=1) if count > 1 else levels[0]


def perceptron(tensors: dict, name: str, x: torch.Tensor) -> torch.Tensor:
    """The layers ``name.layers.*`` applied to `x` (n, inputs), ReLU between them."""
    i = 0
    while f"{name}.layers.{i}.weight" in tensors:
        x = F.linear(F.relu(x) if i else x, tensors[f"{name}.layers.{i}.weight"], tensors[f"{name}.layers.{i}.bias"])
        i += 1
    return x


class _PlaneProduct(torch.autograd.Function):
    """Product over the three planes of their bilinear values at x.

    The backward pass sorts the samples by texel and sums each texel's samples with ``embedding_bag``: several times
    faster on a CPU than the scatter of ``grid_sample``, parallel, and summed in one fixed order.
    """

    @staticmethod
    def forward(ctx, planes, x):
        pairs = torch.stack([x[:, list(p)] for p in PLANES])[:, None]
        value = F.grid_sample(planes.permute(0, 3, 1, 2), pairs, "bilinear", "border", align_corners=False)
        value = value.permute(0, 2, 3, 1).reshape(3, len(x), planes.shape[3])
        ctx.save_for_backward(value, x)
        ctx.resolution = planes.shape[1]
        return value[0] * value[1] * value[2]

    @staticmethod
    def backward(ctx, grad):
        value, x = ctx.saved_tensors
        out = [_scatter(grad * value[(k + 1) % 3] * value[(k + 2) % 3], x[:, a], x[:, b], ctx.resolution)
               for k, (a, b) in enumerate(PLANES)]
        return torch.stack(out), None


def _scatter(grad: torch.Tensor, x: torch.Tensor, y: torch.Tensor, r: int) -> torch.Tensor:
    """Adjoint of the bilinear fetch: gradient (r, r, channels) of one plane from `grad` (n, channels) at x, y (n,)."""
    u, v = (((c + 1) * (r / 2) - 0.5).clamp(0, r - 1) for c in (x, y))
    i, j = u.floor().clamp(max=r - 2), v.floor().clamp(max=r - 2)
    texel = (j * r + i).int()
    order = torch.argsort(texel)
    starts = torch.bincount(texel, minlength=r * r).cumsum(0).roll(1)
    starts[0] = 0
    fx, fy = (u - i)[order], (v - j)[order]
    out = grad.new_zeros(r, r, grad.shape[1])
    for weight, dy, dx in (((1 - fx) * (1 - fy), 0, 0), (fx * (1 - fy), 0, 1), ((1 - fx) * fy, 1, 0), (fx * fy, 1, 1)):
        total = F.embedding_bag(order, grad, starts, mode="sum", per_sample_weights=weight).view(r, r, -1)
        out[dy:, dx:] += total[:r - dy, :r - dx]
    return out


def initial(architecture: Architecture, log_density: float, generator: torch.Generator) -> Networks:
    """Fresh networks: planes near 1 (no factor of the product hides the others), He layers, ln σ near `log_density`."""
    tensors = {}
    for name, shape in architecture.skeleton().items():
        if ".planes." in name:
            value = 1 + 0.02 * torch.randn(shape, generator=generator)
        elif name.endswith("weight"):
            value = torch.randn(shape, generator=generator) * math.sqrt(2 / shape[1])
        else:
            value = torch.zeros(shape)
        tensors[name] = value
    for name, net in architecture.networks().items():
        tensors[f"{name}.layers.{len(net.hidden)}.weight"] *= 0.1
    tensors[f"density.layers.{len(architecture.density.hidden)}.bias"] += log_density
    tensors[f"reflectance.layers.{len(architecture.reflectance.hidden)}.bias"][7] += MATT
    return Networks(architecture, {k: v.requires_grad_() for k, v in tensors.items()})


def from_tensors(architecture: Architecture, tensors: dict[str, np.ndarray], dtype=torch.float32) -> Networks:
    """Networks with the values of a field file; no gradients wanted."""
    return Networks(architecture, {k: torch.tensor(np.asarray(v), dtype=dtype) for k, v in tensors.items()})


def to_tensors(networks: Networks) -> dict[str, np.ndarray]:
    """Arrays for :func:`mi_ntf.core.field_file.save`."""
    return {k: v.detach().cpu().numpy() for k, v in networks.tensors.items()}

"""The networks in PyTorch: the trainable twin of :mod:`mi_ntf.core.reference`, with the same conventions and names.

Tensors keep the layout of the field file. Planes are (3, v, u, channels); seen as (3, channels, v, u) that is PyTorch's
"channels last" layout, in which ``grid_sample`` is fastest.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
import torch.nn.functional as F

from ..core import depth_profile, fresnel, logistic, mixture, spheres
from ..core.architecture import MAX_LOG_DENSITY, MIN_LOG_DENSITY, NO_VISIBILITY, RETRO, TAIL, Architecture, Encoding
from ..core.errors import MiNtfError
from ..core.microfacet import MIN_ROUGHNESS
from ..core.reference import PLANES
from . import ops

Tensors = dict[str, torch.Tensor]
"""Tensors by their names in the field file."""
INITIAL_SPECULAR_LOGIT, INITIAL_ROUGHNESS_LOGIT = -3.0, 1.5
"""Start of the specular weight and of the roughness, 0.86: nearly matt, so that highlights have to appear in the
photographs first. A sharper lobe would be brighter than a black surface, whose normals would turn away from it."""
INITIAL_RETRO_LOGIT = -2.0
"""Start of the retro-reflection, 0.12: small, and its sigmoid has a slope there."""
INITIAL_TAIL_LOGIT = 2.0
"""Start of the tail of the specular lobe, 0.88, near GGX. From a narrower lobe the tail of a metal is learned as a
diffuse part."""
POINTS_PER_PART = 65536
"""Points that :func:`in_parts` evaluates at once, which bounds the memory."""


class Reflectance(NamedTuple):
    """Reflectance of n points; ranges as in :mod:`mi_ntf.core.reference`."""

    normal: torch.Tensor  # Unit normals (n, 3)
    albedo: torch.Tensor  # (n, 3)
    roughness: torch.Tensor  # (n,)
    specular: torch.Tensor  # Specular weights (n, 1) or, linear RGB, (n, 3)

    def diffuse_albedo(self, rim: bool) -> torch.Tensor:
        """Return the albedo (n, 3) of diffuse surfaces that reflect the same fraction of uniform light.

        `rim` is true if the field has a Fresnel term.
        """
        albedo: torch.Tensor = fresnel.diffuse_albedo(ops, self.albedo, self.roughness[:, None], self.specular, rim)
        return albedo


@dataclass(frozen=True)
class Networks:
    """An architecture and its tensors, named as in ``architecture.skeleton()``."""

    architecture: Architecture
    tensors: Tensors

    @property
    def fresnel(self) -> bool:
        """True if the specular weight is the normal reflectance of :mod:`mi_ntf.core.fresnel`."""
        return self.architecture.fresnel

    @property
    def retro(self) -> torch.Tensor | None:
        """Retro-reflection (1,) of :mod:`mi_ntf.core.fresnel`, None without a Fresnel term."""
        if not self.fresnel:
            return None
        raw = self.tensors.get(RETRO)
        return torch.zeros(1) if raw is None else torch.sigmoid(raw)

    @property
    def tail(self) -> torch.Tensor | None:
        """Tail (1,) of the specular lobe (:mod:`mi_ntf.core.microfacet`), None for GGX."""
        raw = self.tensors.get(TAIL)
        return None if raw is None else torch.sigmoid(raw)

    @property
    def phase(self) -> float | None:
        """Asymmetry of the phase function of smoke, see :mod:`mi_ntf.core.henyey_greenstein`; None for surfaces."""
        return self.architecture.phase

    def log_density(self, x: torch.Tensor) -> torch.Tensor:
        """Return ln σ (n,) of the points `x` (n, 3), before it is clipped to the format's range."""
        features = encode(self.architecture.density.encoding, self.tensors, "density", x)
        return perceptron(self.tensors, "density", features)[:, 0]

    def density(self, x: torch.Tensor) -> torch.Tensor:
        """Return σ (n,) of the points `x` (n, 3), in 1/(radius of the unit sphere)."""
        return density_from_log(self.log_density(x))

    def reflectance(self, x: torch.Tensor) -> Reflectance:
        """Return the reflectance of the points `x` (n, 3)."""
        features = encode(self.architecture.reflectance.encoding, self.tensors, "reflectance", x)
        raw = perceptron(self.tensors, "reflectance", features)
        if self.phase is not None:
            zero = raw.new_zeros(len(raw))
            return Reflectance(raw.new_zeros(len(raw), 3), torch.sigmoid(raw[:, 3:6]), zero + 1, 0 * raw[:, 7:])
        rest = torch.sigmoid(raw[:, 3:])
        roughness = MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * rest[:, 3]
        least = self.architecture.least_specular
        specular = least + (1 - least) * rest[:, 4:]
        return Reflectance(F.normalize(raw[:, :3], dim=1, eps=1e-10), rest[:, :3], roughness, specular)

    def ray_mixture(self, o: torch.Tensor, d: torch.Tensor, profile: torch.Tensor
                    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the transmittance of rays as mixtures of logistics, ``(hit (n,), mixture (n, K, 3))``.

        `o`, `d` (n, 3) are a point of each ray and its unit direction towards the light. `profile` (n, k) are optical
        depths from equidistant points of the chords, far ends first, to the light-side ends
        (``TransmittanceTargets.march``), which only the encoding ``depth`` reads. `hit` is false where the ray misses
        the sphere; the last axis of the mixture is (w, a, b), see :mod:`mi_ntf.core.mixture`.
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
        """Return τ (n,) from points `x` (n, 3) along unit directions `d` towards the light, by the baseline's network.

        Raises MiNtfError if the field has no such network.
        """
        net = self.architecture.visibility
        if net is None:
            raise MiNtfError(NO_VISIBILITY)
        features = encode(net.encoding, self.tensors, "visibility", torch.cat([x, d], 1))
        return torch.sigmoid(perceptron(self.tensors, "visibility", features)[:, 0])


def in_parts(function: Callable[[torch.Tensor], torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """Return ``function(x)``, evaluated on at most POINTS_PER_PART rows at a time."""
    return torch.cat([function(part) for part in torch.split(x, POINTS_PER_PART)])


def crossings(profile: torch.Tensor, h: torch.Tensor, levels: torch.Tensor) -> torch.Tensor:
    """Return the places (n, l) where the profiles (n, k) of half chords `h` pass the depths `levels`, (l,) or (n, l).

    Profiles are interpolated linearly.
    """
    steps = profile.shape[1] - 1
    rising = profile.flip(1).contiguous()  # from the light
    levels = levels.expand(len(profile), -1).contiguous()
    after = torch.searchsorted(rising, levels).clamp(1, steps)
    d0, d1 = rising.gather(1, after - 1), rising.gather(1, after)
    fraction = ((levels - d0) / (d1 - d0).clamp(min=1e-9)).clamp(0, 1)
    return h[:, None] * (1 - (after - 1 + fraction) * (2 / steps))


def free_flight(profile: torch.Tensor, h: torch.Tensor, count: int, generator: torch.Generator) -> torch.Tensor:
    """Return `count` random places (n, count) on each chord where free flight from the light ends within the chord."""
    lost = torch.rand(len(profile), count, generator=generator) * -torch.expm1(-profile[:, :1])
    return crossings(profile, h, -torch.log1p(-lost))


def depth_at(profile: torch.Tensor, h: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
    """Return the optical depths (n, l) of the profiles (n, k) at the places `t` (n, l), interpolated linearly."""
    steps = profile.shape[1] - 1
    place = ((t / h[:, None] + 1) * (steps / 2)).clamp(0, steps - 1e-3)
    lower = place.floor().long()
    fraction = place - lower
    return profile.gather(1, lower) * (1 - fraction) + profile.gather(1, lower + 1) * fraction


def density_from_log(raw: torch.Tensor) -> torch.Tensor:
    """Return σ = exp(raw), clipped as in the format. Gradients ignore the clip, so that no point is stuck beyond it."""
    # The difference of two equal numbers is 0: it adds the slope to the clipped value, and nothing else.
    return torch.exp(raw.detach().clamp(MIN_LOG_DENSITY, MAX_LOG_DENSITY) + (raw - raw.detach()))


def encode(encoding: Encoding, tensors: Tensors, name: str, x: torch.Tensor) -> torch.Tensor:
    """Return features (n, ``encoding.width``) of points (n, 3) or rays (n, 6). Planes give no gradient to `x`."""
    if encoding.kind == "frequency":
        angles = [math.pi * 2.0**k * x for k in range(encoding.octaves)]
        return torch.cat([x, *(f(a) for a in angles for f in (torch.sin, torch.cos))], dim=1)
    count = len(encoding.resolutions)
    levels = [_plane_product(tensors[f"{name}.planes.{i}"], x.detach()) for i in range(count)]
    return torch.cat(levels, dim=1) if count > 1 else levels[0]


def perceptron(tensors: Tensors, name: str, x: torch.Tensor) -> torch.Tensor:
    """Apply the layers ``name.layers.*`` to `x` (n, inputs), with ReLU between them."""
    i = 0
    while f"{name}.layers.{i}.weight" in tensors:
        x = F.linear(F.relu(x) if i else x, tensors[f"{name}.layers.{i}.weight"], tensors[f"{name}.layers.{i}.bias"])
        i += 1
    return x


class _Context(Protocol):
    """The part of PyTorch's autograd context that :class:`_PlaneProduct` uses."""

    resolution: int
    saved_tensors: tuple[torch.Tensor, ...]

    def save_for_backward(self, *tensors: torch.Tensor) -> None: ...


class _PlaneProduct(torch.autograd.Function):
    """Product over the three planes of their bilinear values at `x`.

    The backward pass sorts the samples by texel and sums the samples of each texel with ``embedding_bag``. On a CPU
    that is several times faster than the scatter of ``grid_sample``, and the order of the sums is fixed.
    """

    @staticmethod
    def forward(ctx: _Context, planes: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        pairs = torch.stack([x[:, list(p)] for p in PLANES])[:, None]
        value = F.grid_sample(planes.permute(0, 3, 1, 2), pairs, "bilinear", "border", align_corners=False)
        value = value.permute(0, 2, 3, 1).reshape(3, len(x), planes.shape[3])
        ctx.save_for_backward(value, x)
        ctx.resolution = planes.shape[1]
        return value[0] * value[1] * value[2]

    @staticmethod
    def backward(ctx: _Context, grad: torch.Tensor) -> tuple[torch.Tensor, None]:
        value, x = ctx.saved_tensors
        planes = [_scatter(grad * value[(k + 1) % 3] * value[(k + 2) % 3], x[:, a], x[:, b], ctx.resolution)
                  for k, (a, b) in enumerate(PLANES)]
        return torch.stack(planes), None


_plane_product: Callable[[torch.Tensor, torch.Tensor], torch.Tensor] = _PlaneProduct.apply


def _scatter(grad: torch.Tensor, x: torch.Tensor, y: torch.Tensor, r: int) -> torch.Tensor:
    """Return the gradient (r, r, channels) of one plane: the adjoint of the bilinear fetch at `x`, `y` (n,)."""
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
    """Return fresh networks with He layers, planes near 1, and ln σ near `log_density`.

    Planes near 1 let every factor of their product learn.
    """
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
    if RETRO in tensors:
        tensors[RETRO] += INITIAL_RETRO_LOGIT
    if TAIL in tensors:
        tensors[TAIL] += INITIAL_TAIL_LOGIT
    lobe = tensors[f"reflectance.layers.{len(architecture.reflectance.hidden)}.bias"][6:]
    lobe += torch.tensor([INITIAL_ROUGHNESS_LOGIT] + [INITIAL_SPECULAR_LOGIT] * architecture.specular_channels)
    return Networks(architecture, {k: v.requires_grad_() for k, v in tensors.items()})


def from_tensors(architecture: Architecture, tensors: Mapping[str, np.ndarray], dtype: torch.dtype = torch.float32
                 ) -> Networks:
    """Return networks with the values of a field file; they need no gradients."""
    return Networks(architecture, {k: torch.tensor(np.asarray(v), dtype=dtype) for k, v in tensors.items()})


def to_tensors(networks: Networks) -> dict[str, np.ndarray]:
    """Return the arrays for :func:`mi_ntf.core.field_file.save`."""
    return {k: v.detach().cpu().numpy() for k, v in networks.tensors.items()}

"""The field as its networks, in Dr.Jit: the twin of :mod:`mi_ntf.core.reference` (conventions there)."""

import math
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import TypeAlias

import drjit as dr
import numpy as np
from drjit import nn

from ..core import depth_profile, logistic, mixture, spheres
from ..core import ops as numpy_ops
from ..core.architecture import (
    MAX_LOG_DENSITY,
    MIN_LOG_DENSITY,
    NO_VISIBILITY,
    RETRO,
    TAIL,
    Architecture,
    Encoding,
    Header,
)
from ..core.errors import MiNtfError
from ..core.field_file import refinement
from ..core.microfacet import MIN_ROUGHNESS
from ..core.ops import Tensors, normalize
from ..core.reference import PLANES
from . import ops
from .refined import Refinement
from .types import Array, Float, Mask, Reflected, Vector

Profile: TypeAlias = Callable[[Vector, Vector], tuple[list[Float], Float]]
"""``(o, d)`` of rays → places and total of :func:`mi_ntf.core.depth_profile.frame`."""

MIN_DENSITY = 0.1
"""Least σ, 1/(unit-sphere radius); space with less is empty. It is an optical depth of 0.2 across the whole sphere.
Training drives empty space below it, and every renderer of the field (also stock `volpath`) sees the same zero."""
LOG_MIN_DENSITY = math.log(MIN_DENSITY)
CLEAR_DEPTH = 1e-3
"""Optical depth below which a ray counts as clear: τ = 1."""
NOTHING = -60.0
"""ln σ where there is no matter."""


def cut(log_sigma: Float) -> Float:
    """Return `log_sigma`, but ``NOTHING`` below ``MIN_DENSITY``."""
    return dr.select(log_sigma > LOG_MIN_DENSITY, log_sigma, NOTHING)


def inside(log_sigma: Float, p: Vector) -> Float:
    """Return `log_sigma`, but ``NOTHING`` outside the unit sphere."""
    return dr.select(p[0] * p[0] + p[1] * p[1] + p[2] * p[2] < 1, log_sigma, NOTHING)


def density_of(log_sigma: Float) -> Float:
    """Return σ, 0 where ln σ is ``NOTHING``."""
    return dr.select(log_sigma > NOTHING, dr.exp(log_sigma), 0)


def coloured(values: Sequence[Float]) -> Vector:
    """Return one or three channels as linear RGB."""
    return tuple(values) if len(values) == 3 else (values[0],) * 3


class NetworkField:
    """Density, reflectance and ray transmittance of one field, evaluated by its networks.

    `dj`: Dr.Jit module of the back end (:func:`mi_ntf.infer.backend.module`).
    """

    def __init__(self, header: Header, tensors: Tensors, dj: ModuleType):
        arch = header.architecture
        self.components = arch.transmittance.components
        self._density = _Network(arch.density.encoding, "density", tensors, dj)
        self._reflectance = _Network(arch.reflectance.encoding, "reflectance", tensors, dj)
        self._transmittance = _Network(arch.transmittance.encoding, "transmittance", tensors, dj)
        baseline = arch.visibility
        self._visibility = None if baseline is None else _Network(baseline.encoding, "visibility", tensors, dj)
        self.has_visibility = baseline is not None
        self._least_specular, self._smoke = arch.least_specular, arch.phase is not None
        self.retro = _retro(arch, tensors)
        """Retro-reflection of :mod:`mi_ntf.core.fresnel`, None without a Fresnel term."""
        self.tail = _number(tensors, TAIL) if arch.tail else None
        """Tail of the specular lobe (:mod:`mi_ntf.core.microfacet`), None for GGX."""
        self.quick = arch.reflectance.encoding.kind == "planes"
        """True if a reflectance costs no more than a few fetches."""
        self._refined_reflectance, self.refined_density = (
            Refinement(arrays, dj) if (arrays := refinement(tensors, quantity)) else None
            for quantity in ("reflectance", "density"))

    def tensors(self) -> dict[str, Array]:
        """Return the planes and the packed weights of the density and reflectance networks, by name."""
        result: dict[str, Array] = {}
        for name, network in (("density", self._density), ("reflectance", self._reflectance)):
            for level, planes in enumerate(network.planes):
                result |= {f"{name}.planes.{level}.{i}": plane.tensor() for i, plane in enumerate(planes)}
            result |= {f"{name}.{key}": tensor for key, tensor in network.layer_tensors.items()}
        return result

    def log_density(self, p: Vector) -> Float:
        """Return ln σ at `p`, clipped to the legal range, without the cuts of :meth:`density`."""
        value = self.learned_log_density(p)
        if not self.refined_density:
            return value
        return dr.clip(value + self.refined_density.at(p)[0], MIN_LOG_DENSITY, MAX_LOG_DENSITY)

    def learned_log_density(self, p: Vector) -> Float:
        """Return ln σ at `p` by the network alone, without a refinement."""
        (raw,) = self._density.layers(self._density.encode(p))
        return dr.clip(raw, MIN_LOG_DENSITY, MAX_LOG_DENSITY)

    def density(self, p: Vector) -> Float:
        """Return σ at `p`, 1/(unit-sphere radius)."""
        return density_of(inside(cut(self.log_density(p)), p))

    def reflectance(self, p: Vector) -> Reflected:
        """Return normal, albedo, roughness and specular weight at `p`; of smoke 0, its albedo, 1 and 0."""
        reflected = self.learned_reflectance(p)
        return self._refined_reflectance.apply(reflected, p) if self._refined_reflectance else reflected

    def learned_reflectance(self, p: Vector) -> Reflected:
        """Return the reflectance of the networks alone, without a refinement."""
        raw = self._reflectance.layers(self._reflectance.encode(p))
        if self._smoke:
            zero, one = dr.zeros(type(raw[3]), dr.width(raw[3])), dr.ones(type(raw[3]), dr.width(raw[3]))
            return (zero, zero, zero), tuple(logistic.sigmoid(ops, v) for v in raw[3:6]), one, (zero, zero, zero)
        normal = normalize(ops, tuple(raw[:3]))
        r, g, b, rough, *weight = (logistic.sigmoid(ops, v) for v in raw[3:])
        least = self._least_specular
        specular = coloured([least + (1 - least) * value for value in weight])
        return normal, (r, g, b), MIN_ROUGHNESS + (1 - MIN_ROUGHNESS) * rough, specular

    def visibility(self, p: Vector, d: Vector) -> Float:
        """Return τ from `p` along the unit directions `d` towards the light, by a query of the baseline's network."""
        if self._visibility is None:
            raise MiNtfError(NO_VISIBILITY)
        (raw,) = self._visibility.layers(self._visibility.encode((*p, *d)))
        return logistic.sigmoid(ops, raw)

    def ray_mixture(self, o: Vector, d: Vector, profile: Profile) -> tuple[Mask, Float, mixture.Mixture]:
        """Return ``(hit, h, mixture)`` of the rays through `o` along unit directions `d` towards the light.

        `profile`: see :class:`mi_ntf.infer.profile.DepthProfile`; only the encoding ``depth`` reads it.
        """
        hit, m, h = spheres.chord(ops, o, d)
        net, count = self._transmittance, 2 * self.components
        if net.encoding.kind == "depth":
            places, total = profile(o, d)
            raw = net.layers(depth_profile.features(ops, places, total, h))
            pairs = depth_profile.components(ops, raw[:count], places, total, h)
            hit &= total > CLEAR_DEPTH
        else:
            p1, p2 = spheres.end_points(m, d, h)
            raw = net.layers(net.encode((*p1, *p2)))
            pairs = [logistic.parameters(ops, raw[i], raw[i + 1], h) for i in range(0, count, 2)]
        return hit, h, mixture.from_outputs(ops, pairs, raw[count:], h)


def _retro(architecture: Architecture, tensors: Tensors) -> float | None:
    if not architecture.fresnel:
        return None
    return _number(tensors, RETRO) if architecture.retro else 0.0


def _number(tensors: Tensors, name: str) -> float:
    return float(logistic.sigmoid(numpy_ops, tensors[name][0]))


def _half(dj: ModuleType) -> bool:
    """Return True if cooperative vectors are float16, as on CUDA; on LLVM float32 is faster."""
    return dr.backend_v(dj.Float) == dr.JitBackend.CUDA


class _Network:
    """An encoding and its perceptron."""

    def __init__(self, encoding: Encoding, name: str, tensors: Tensors, dj: ModuleType):
        self.encoding = encoding
        self.dj = dj
        levels = [tensors[f"{name}.planes.{i}"] for i in range(len(encoding.resolutions))]
        # No hardware filtering: its weights have 9 bits.
        self.planes = [
            [
                dj.Texture2f(dj.TensorXf(np.ascontiguousarray(plane)), use_accel=False, wrap_mode=dr.WrapMode.Clamp)
                for plane in planes
            ]
            for planes in levels
        ]
        count = sum(k.startswith(f"{name}.layers.") and k.endswith("weight") for k in tensors)
        self._pack(name, tensors, count)

    def _pack(self, name: str, tensors: Tensors, count: int) -> None:
        half = _half(self.dj)
        self.scalar = self.dj.Float16 if half else self.dj.Float
        tensor = self.dj.TensorXf16 if half else self.dj.TensorXf
        shapes = [tensors[f"{name}.layers.{i}.weight"].shape for i in range(count)]
        layers = []
        for i, (n_out, n_in) in enumerate(shapes):
            layers += [nn.Linear(n_in, n_out)] + ([nn.ReLU()] if i + 1 < count else [])
        self.layer_tensors: dict[str, Array] = {}
        net = nn.Sequential(*layers).alloc(tensor, size=shapes[0][1])
        for i in range(count):
            for ours, theirs in (("weight", "weights"), ("bias", "bias")):
                value = np.ascontiguousarray(tensors[f"{name}.layers.{i}.{ours}"], np.float32)
                if half:
                    end = np.finfo(np.float16).max
                    value = np.clip(value, -end, end).astype(np.float16)
                self.layer_tensors[f"layers.{i}.{ours}"] = net[f"layers.{2 * i}.{theirs}"] = tensor(value)
        self.packed: Array = nn.pack(net, layout="inference")

    def encode(self, p: Vector) -> list[Float]:
        """Return the features of the points `p`."""
        if self.encoding.kind == "frequency":
            features = list(p)
            for k in range(self.encoding.octaves):
                angles = [dr.pi * 2.0**k * c for c in p]
                features += [dr.sin(a) for a in angles] + [dr.cos(a) for a in angles]
            return features
        u = [0.5 * c + 0.5 for c in p]
        features = []
        for planes in self.planes:
            values = [plane.eval(self.dj.Array2f(u[a], u[b])) for plane, (a, b) in zip(planes, PLANES, strict=True)]
            features += [x * y * z for x, y, z in zip(*values, strict=True)]
        return features

    def layers(self, features: list[Float]) -> list[Float]:
        """Return the perceptron's outputs, float32."""
        out = self.packed(nn.CoopVec(*(self.scalar(f) for f in features)))
        return [self.dj.Float(v) for v in out]

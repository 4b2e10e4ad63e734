"""Fields with known values, written by hand into the networks: no training, exact up to bilinear interpolation."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from mi_ntf.core.architecture import MIN_LOG_DENSITY, RETRO, TAIL, Architecture, Encoding, Header, Network, Similarity
from mi_ntf.core.microfacet import MIN_ROUGHNESS
from mi_ntf.infer.network import MIN_DENSITY

RESOLUTION = 128


def architecture(components: int = 2, visibility: bool = False) -> Architecture:
    return Architecture(
        Network(Encoding("planes", (RESOLUTION,), 8), (16,)),
        Network(Encoding("planes", (RESOLUTION,), 4), (16,)),
        Network(Encoding("depth"), (16,), components=components),
        Network(Encoding("frequency", octaves=1), (16,)) if visibility else None,
    )


def constant(tensors: dict, name: str, values) -> None:
    """Make network `name` return `values` everywhere."""
    last = max(int(k.split(".")[2]) for k in tensors if k.startswith(f"{name}.layers."))
    tensors[f"{name}.layers.{last}.weight"][:] = 0
    tensors[f"{name}.layers.{last}.bias"][:] = values


def _axes():
    c = (np.arange(RESOLUTION) + 0.5) / RESOLUTION * 2 - 1
    return np.meshgrid(c, c)  # u (columns), v (rows)


def _logit(p):
    return float(np.log(p / (1 - p)))


def blobs(
    centers, radii, *, log_density=5.0, edge=8.0, albedo=(0.6, 0.5, 0.4), roughness=0.5, specular=0.2, similarity=None,
    components=2, visibility=False, fresnel=False, phase=None, retro=None, tail=None
) -> tuple[Header, dict]:
    """Opaque balls: ln σ rises from −12 to `log_density` over about radius/`edge`.. around each radius. Normals point
    away from the origin. At most 8 balls; a ball is the level set of a Gaussian, which the three planes' product holds
    exactly. `visibility`: with the baseline's network, too, whose τ is anything between 0 and 1 and smooth. `fresnel`:
    `specular` is the normal reflectance, a number or three of a colour. `phase`: asymmetry of smoke. `retro`:
    retro-reflection, of fields with a Fresnel term. `tail`: that of the specular lobe; None for GGX."""
    weight = np.atleast_1d(specular)
    arch = replace(architecture(components, visibility), fresnel=fresnel or retro is not None, retro=retro is not None,
                   tail=tail is not None, phase=phase, specular_channels=len(weight))
    t = {k: np.zeros(s) for k, s in arch.skeleton().items()}
    u, v = _axes()
    for i, (c, r) in enumerate(zip(centers, radii, strict=True)):
        k = 1 / r**2
        for plane, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            t["density.planes.0"][plane, :, :, i] = np.exp(-k / 2 * ((u - c[a]) ** 2 + (v - c[b]) ** 2))
        # Gaussian at the radius is e^−1; the hidden unit is relu(edge·(g/e^−1 − 1) + something positive inside).
        t["density.layers.0.weight"][i, i] = edge * np.e * 4
        t["density.layers.0.bias"][i] = -edge * 4 + (log_density - MIN_LOG_DENSITY) / 2
    # ln σ = MIN + min over… ReLU units add; overlapping balls only saturate at the clip.
    t["density.layers.1.weight"][0, : len(radii)] = 1
    t["density.layers.1.bias"][0] = MIN_LOG_DENSITY
    # Clip at log_density by a second unit per ball: relu(x) − relu(x − span).
    span = log_density - MIN_LOG_DENSITY
    for i in range(len(radii)):
        t["density.layers.0.weight"][8 + i] = t["density.layers.0.weight"][i]
        t["density.layers.0.bias"][8 + i] = t["density.layers.0.bias"][i] - span
        t["density.layers.1.weight"][0, 8 + i] = -1
    if retro is not None:
        t[RETRO][0] = _logit(min(max(retro, 1e-9), 1 - 1e-9))
    if tail is not None:
        t[TAIL][0] = _logit(min(max(tail, 1e-9), 1 - 1e-9))
    least = arch.least_specular
    _outward_reflectance(t, albedo, roughness, (weight - least) / (1 - least))
    for name, scale in (("transmittance", 0.5), ("visibility", 0.3)):
        rng = np.random.default_rng(0)
        for k in t:
            if k.startswith(name):
                t[k] = rng.normal(size=t[k].shape) * scale
    return Header(arch, similarity or Similarity()), t


def _outward_reflectance(t, albedo, roughness, specular) -> None:
    u, v = _axes()
    planes = t["reflectance.planes.0"]
    planes[...] = 1
    planes[0, :, :, 0], planes[0, :, :, 1], planes[1, :, :, 2] = u, v, v  # products: x, y, z
    w0, w1, b1 = (t[f"reflectance.layers.{n}"] for n in ("0.weight", "1.weight", "1.bias"))
    for i in range(3):
        w0[2 * i, i], w0[2 * i + 1, i] = 1, -1
        w1[i, 2 * i], w1[i, 2 * i + 1] = 1, -1
    b1[3:6] = [_logit(a) for a in albedo]
    b1[6] = _logit((roughness - MIN_ROUGHNESS) / (1 - MIN_ROUGHNESS))
    b1[7:] = [_logit(s) for s in specular]


def _slopes(t, x, y) -> None:
    """Normals (x, y, 1), normalised, of the points' first two coordinates, in place of outward ones."""
    planes = t["reflectance.planes.0"]
    planes[...] = 1
    planes[0, :, :, 0], planes[0, :, :, 1] = x, y


def empty(**kwargs) -> tuple[Header, dict]:
    """Return a field without density."""
    header, t = blobs([(0, 0, 0)], [0.3], **kwargs)
    constant(t, "density", [MIN_LOG_DENSITY])
    return header, t


def held(sigma: float) -> float:
    """The next σ whose logarithm float16 holds, which networks are of on CUDA."""
    return float(np.exp(np.float64(np.float16(np.log(sigma)))))


def uniform(sigma: float, **kwargs) -> tuple[Header, dict]:
    """σ everywhere in the unit sphere."""
    header, t = blobs([(0, 0, 0)], [0.3], **kwargs)
    constant(t, "density", [np.log(sigma)])
    return header, t


@dataclass(frozen=True)
class Skin:
    """Matter whose surface is known in closed form: ln σ = `log_density` − distance/`scale` outside, `log_density`
    inside. `distance`: of points (n, 3), above 0 outside, of slope 1 at the surface. σ is 0 where the package cuts it:
    below MIN_DENSITY and outside the unit sphere."""

    distance: Callable
    log_density: float
    scale: float
    header: Header
    tensors: dict

    def density(self, x: np.ndarray) -> np.ndarray:
        """σ (n,) in float64."""
        log = np.clip(self.log_density - self.distance(x) / self.scale, MIN_LOG_DENSITY, self.log_density)
        return np.where((np.exp(log) > MIN_DENSITY) & ((x * x).sum(-1) < 1), np.exp(log), 0.0)

    def depth(self, x, d, length, steps: int = 2000) -> np.ndarray:
        """∫ σ from `x` (n, 3) along unit `d` over `length` (n,), midpoint rule with steps that grow from `x` on."""
        edges = np.linspace(0, 1, steps + 1) ** 2
        total = np.zeros(len(x))
        for a, b in pairwise(edges):
            total += self.density(x + (0.5 * (a + b) * length)[:, None] * d) * (b - a)
        return total * length


def skin(kind: str, log_density: float = 5.0, scale: float = 0.01, **options) -> Skin:
    """`plane`: z < 0; `sphere`: radius ½; `bumps`: z < 0.08 cos 9x cos 9y. Normals are the surface's."""
    u, v = _axes()
    header, t = blobs([(0, 0, 0)], [0.3], **options)
    planes = t["density.planes.0"]
    planes[...], weights = 1, np.zeros(8)
    if kind == "sphere":
        planes[0, :, :, 0], planes[0, :, :, 1], planes[1, :, :, 2] = u * u, v * v, v * v
        weights[:3], offset = 1, -0.25

        def distance(x):
            return (x * x).sum(-1) - 0.25
    else:
        height = 0.0 if kind == "plane" else 0.08
        planes[1, :, :, 0], planes[0, :, :, 1] = v, np.cos(9 * u) * np.cos(9 * v)
        weights[0], weights[1], offset = 1, -height, 0.0
        _slopes(t, 9 * height * np.sin(9 * u) * np.cos(9 * v), 9 * height * np.cos(9 * u) * np.sin(9 * v))

        def distance(x):
            return x[:, 2] - height * np.cos(9 * x[:, 0]) * np.cos(9 * x[:, 1])

    span = log_density - MIN_LOG_DENSITY
    w0, b0, w1 = (t[f"density.layers.{n}"] for n in ("0.weight", "0.bias", "1.weight"))
    w0[...], w1[...] = 0, 0
    w0[:2] = -weights / scale
    b0[...] = 0
    b0[:2] = span - offset / scale - np.array([0, span])
    w1[0, :2] = 1, -1
    return Skin(distance, log_density, scale, header, t)


def known_visibility(tensors: dict, tau: float) -> None:
    """The baseline's network that answers `tau` everywhere."""
    constant(tensors, "visibility", [_logit(tau)])


def middle_of_profile(tensors: dict) -> None:
    """The ray network that says nothing: the logistic through the middle of each ray's optical depth."""
    constant(tensors, "transmittance", [0] * len(tensors["transmittance.layers.1.bias"]))


def seen_points(skin: Skin, surface: np.ndarray, view: np.ndarray, rng) -> np.ndarray:
    """Points (n, 3) at which rays that look along −`view` at the points `surface` (n, 3) scatter: free flight."""
    reach, steps = 12 * skin.scale, 600
    t = reach - (np.arange(steps) + 0.5) * 2 * reach / steps
    sigma = np.stack([skin.density(surface + s * view) for s in t], 1)
    passed = np.cumsum(sigma, 1) * 2 * reach / steps
    depth = -np.log(1 - rng.random(len(surface)) * (1 - np.exp(-passed[:, -1])))
    return surface + t[(passed < depth[:, None]).sum(1).clip(max=steps - 1)][:, None] * view

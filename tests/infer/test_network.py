"""The Dr.Jit networks and their baked grid against the NumPy float64 reference."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields
from helpers.jit import arrays
from helpers.variants import VARIANT

from mi_ntf.core import field_file, reference
from mi_ntf.core.architecture import LOG_FLOOR, Architecture, Encoding, Header, Network
from mi_ntf.core.depth_profile import LEVELS
from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer import network as network_module
from mi_ntf.infer.bake import EMPTY, _corners, flat, support_points
from mi_ntf.infer.grid import baked
from mi_ntf.infer.network import CLEAR_DEPTH, MIN_DENSITY, NetworkField

HALF = VARIANT.startswith("cuda")
SCENES = Path(__file__).parents[2] / "scenes"


def random_field(rng, encoding=None, channels=3):
    encoding = encoding or Encoding("planes", (16, 32), 4)
    rays = Encoding("frequency", octaves=3)
    arch = Architecture(*(Network(encoding, (16, 24)) for _ in range(2)), Network(rays, (16, 24), components=2),
                        Network(rays, (24, 16)), fresnel=True, specular_channels=channels)
    return Header(arch), {k: rng.normal(size=s) * 0.4 for k, s in arch.skeleton().items()}


def shipped(name):
    return field_file.load(SCENES / name / "field.safetensors")


CASES = ["random", "frequency", "statue", "globe", "knot"]


@pytest.fixture(params=CASES)
def case(request, rng):
    if request.param == "random":
        return random_field(rng)
    if request.param == "frequency":
        return random_field(rng, Encoding("frequency", octaves=4))
    return shipped(request.param)


def assert_close(ours, truth, tolerance=3e-5, half=HALF):
    """Compare within `tolerance` of the output's range, and of its size if it is constant.

    float32 goes through two layers of sums of some dozen products, and exp. On CUDA layers are float16 (`half`), 2^−11:
    ten times that in the mean (measured 1.9e-3), a hundred times where exp or a normalisation amplifies it (0.040).
    """
    truth = np.asarray(truth)
    span = max(np.ptp(truth), 1e-3)
    if half:
        assert np.sqrt(((np.asarray(ours) - truth) ** 2).mean()) <= 10 * 2**-11 * span
        tolerance = 100 * 2**-11
    assert np.abs(np.asarray(ours) - truth).max() <= tolerance * span + 2.4e-7 * np.abs(truth).max()


def test_density(case, rng):
    header, tensors = case
    x = rng.uniform(-0.57, 0.57, (20000, 3))
    truth = reference.density(header.architecture, tensors, x.astype(np.float32).astype(np.float64))
    field = NetworkField(header, tensors, mi)
    # Trained layers amplify the rounding of texture coordinates (1e-7 · 128 texels · slopes of some ten) to 1e-3 of 18.
    assert_close(field.log_density(arrays(x)), np.log(truth), 1e-4)
    truth[truth <= MIN_DENSITY] = 0
    assert_close(field.density(arrays(x)), truth, 1e-4)


def test_float16_of_cuda(case, rng, monkeypatch):
    """LLVM computes float16, too. Weights beyond its range are clipped, since infinities would become NaN."""
    monkeypatch.setattr(network_module, "_half", lambda dj: True)
    header, tensors = case
    x = rng.uniform(-0.57, 0.57, (20000, 3))
    field = NetworkField(header, tensors, mi)
    assert field._density.scalar is mi.Float16
    truth = reference.density(header.architecture, tensors, x.astype(np.float32).astype(np.float64))
    assert_close(field.log_density(arrays(x)), np.log(truth), half=True)
    reflectance = reference.reflectance(header.architecture, tensors, x.astype(np.float32).astype(np.float64))
    normal, albedo, roughness, specular = field.reflectance(arrays(x))
    for i, value in enumerate([*normal, *albedo, roughness, *specular]):
        assert_close(value, reflectance[:, min(i, reflectance.shape[1] - 1)], half=True)
    header, tensors = fields.blobs([(0, 0, 0)], [0.5])
    for raw, sigma in ((1e30, np.exp(6.5)), (-1e30, np.exp(-12.0))):
        fields.constant(tensors, "density", [raw])
        actual = np.exp(np.array(NetworkField(header, tensors, mi).log_density(arrays(x))))
        np.testing.assert_allclose(actual, sigma, rtol=1e-5)


def test_reflectance(case, rng):
    header, tensors = case
    x = rng.uniform(-0.57, 0.57, (20000, 3))
    truth = reference.reflectance(header.architecture, tensors, x.astype(np.float32).astype(np.float64))
    normal, albedo, roughness, specular = NetworkField(header, tensors, mi).reflectance(arrays(x))
    weights = np.broadcast_to(truth[:, 7:], (len(x), 3))  # shipped fields have one channel
    truth = np.concatenate([truth[:, :7], weights], 1)
    for i, value in enumerate([*normal, *albedo, roughness, *specular]):
        # Normalisation divides by the raw normal's length, which can be small.
        assert_close(value, truth[:, i], 2e-4 if i < 3 else 3e-5)


@pytest.mark.parametrize("name", ["statue", "globe", "knot"])
def test_torch_and_drjit_agree_on_the_shipped_fields(name, rng):
    """Raw outputs of both networks, float32, agree within 1e-5 of their range."""
    torch = pytest.importorskip("torch")
    from mi_ntf.train import networks

    header, tensors = shipped(name)
    twin, ours = networks.from_tensors(header.architecture, tensors), NetworkField(header, tensors, mi)
    x = rng.uniform(-0.57, 0.57, (20000, 3)).astype(np.float32)
    for part in ("density", "reflectance"):
        encoding = getattr(header.architecture, part).encoding
        with torch.no_grad():
            features = networks.encode(encoding, twin.tensors, part, torch.from_numpy(x))
            theirs = networks.perceptron(twin.tensors, part, features).numpy()
        network = getattr(ours, f"_{part}")
        for i, value in enumerate(network.layers(network.encode(arrays(x)))):
            assert_close(value, theirs[:, i], 1e-5)


def test_ray_mixture(case, rng):
    """Mixtures agree on random profiles, for networks that read them."""
    header, tensors = case
    o, d = rng.uniform(-0.5, 0.5, (5000, 3)), rng.normal(size=(5000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, d = (v.astype(np.float32).astype(np.float64) for v in (o, d))
    total = rng.gamma(0.5, 6, 5000).astype(np.float32)
    places = -np.sort(-rng.uniform(-0.6, 0.6, (len(LEVELS), 5000)), 0).astype(np.float32)
    hit, truth = reference.ray_mixture(header.architecture, tensors, o, d, places.astype(np.float64), total)
    ours_hit, _, ours = NetworkField(header, tensors, mi).ray_mixture(
        arrays(o), arrays(d), lambda o, d: ([mi.Float(p) for p in places], mi.Float(total)))
    if header.architecture.transmittance.encoding.kind == "depth":
        hit &= total > CLEAR_DEPTH
    assert (np.array(ours_hit) == hit).all()
    for ours_k, truth_k in zip(ours, truth, strict=True):
        for value, expected in zip(ours_k[:2], truth_k[:2], strict=True):
            assert_close(np.log(value), np.log(expected), 1e-4)
        assert_close(ours_k[2], truth_k[2], 1e-4)


def test_visibility(rng):
    header, tensors = random_field(rng)
    x, d = rng.uniform(-0.57, 0.57, (5000, 3)), rng.normal(size=(5000, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x, d = (v.astype(np.float32).astype(np.float64) for v in (x, d))
    truth = reference.visibility(header.architecture, tensors, x, d)
    assert_close(NetworkField(header, tensors, mi).visibility(arrays(x), arrays(d)), truth)
    assert np.ptp(truth) > 0.1
    with pytest.raises(MiNtfError, match="no visibility network; train it with `mi-ntf train --visibility-mlp`"):
        NetworkField(*fields.uniform(5.0), mi).visibility(arrays(x), arrays(d))


def test_gradient_of_density_reaches_positions(rng):
    header, tensors = random_field(rng)
    x = rng.uniform(-0.5, 0.5, (50, 3)).astype(np.float32).astype(np.float64)
    # Away from texel borders, where bilinear interpolation has kinks that differences would straddle.
    for r in (16, 32):
        cell = (x + 1) / 2 * r - 0.5
        x = x[(np.abs(cell - np.round(cell)) > 0.02).all(axis=1)]
    p = arrays(x)
    dr.enable_grad(p)
    raw = dr.log(NetworkField(header, tensors, mi).density(p))
    dr.backward(raw)
    step = 1e-6
    for axis in range(3):
        e = np.eye(3)[axis] * step
        difference = (
            np.log(reference.density(header.architecture, tensors, x + e))
            - np.log(reference.density(header.architecture, tensors, x - e))
        ) / (2 * step)
        assert_close(dr.grad(p[axis]), difference, 1e-3)  # ReLU kinks inside ±1e-6 and float32 texel positions


def test_density_is_zero_outside_the_sphere():
    held = fields.held(5.0)
    field = NetworkField(*fields.uniform(held), mi)
    sigma = np.array(
        field.density(arrays(np.array([[0.57, 0.57, 0.57], [0.58, 0.58, 0.58], [0.99, 0, 0], [1.01, 0, 0]])))
    )
    np.testing.assert_allclose(sigma, [held, 0, held, 0], rtol=1e-5)


def test_voxels_hold_the_density_that_interpolates_it_and_the_reflectance_at_their_centres(rng):
    network = NetworkField(*fields.blobs([(-0.2, 0.1, 0.0), (0.3, -0.2, 0.1)], [0.4, 0.3]), mi)
    grid = baked(network, 64, mi)
    i = rng.integers(1, 63, (4000, 3))
    value = np.zeros(len(i))
    for offset in np.ndindex(3, 3, 3):
        weight = np.prod([(-1, 14, -1)[k] / 12 for k in offset])
        raw = np.array(network.log_density(arrays((i + np.array(offset) - 0.5) / 32 - 1)))
        value += weight * np.maximum(raw, LOG_FLOOR)
    centres = (np.argwhere(np.ones((64, 64, 64))) + 0.5) / 32 - 1
    value = np.minimum(value, np.array(network.log_density(arrays(centres))).max())
    p = arrays((i + 0.5) / 32 - 1)
    inside = (((i + 0.5) / 32 - 1) ** 2).sum(1) < 1
    expected = np.where(inside & (np.exp(value) > MIN_DENSITY), np.exp(value), 0)
    # ln σ to 2e-3: texture coordinates are float32, and ln σ rises by some hundred per unit.
    np.testing.assert_allclose(np.array(grid.density(p)), expected, rtol=2e-3, atol=1e-6)
    ours, truth = grid.reflectance(p), network.reflectance(p)
    for a, b in zip(flat(ours), flat(truth), strict=True):
        np.testing.assert_allclose(np.array(a), np.array(b), atol=2e-4)


def test_hulls_hold_all_interpolated_density(rng):
    """Along the axes exactly; along others to within what lies between the directions that are asked for, 4° apart:
    the sphere's 1 − cos 2°, a corner's more. A voxel fades out at its neighbours' centres."""
    n = 48
    axis = (np.arange(n) + 0.5) * (2 / n) - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    dense = (x * x + y * y + z * z < 0.3) | ((abs(x - 0.5) < 0.2) & (abs(y) < 0.1) & (abs(z + 0.4) < 0.3))
    hull = support_points(np.argwhere(dense)[:, ::-1], n)
    voxels = np.stack([c[dense] for c in (x, y, z)], 1)
    directions = rng.normal(size=(300, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for d, most in ((np.concatenate([np.eye(3), -np.eye(3)]), 1e-12), (directions, 0.03)):
        reached = (voxels @ d.T).max(0) + abs(d).sum(1) * 2 / n
        missed = reached - (hull @ d.T).max(0)
        assert missed.min() > -1e-12 and missed.max() < most
    assert missed.mean() < 0.002
    assert len(hull) <= 1206
    np.testing.assert_array_equal(support_points(np.zeros((0, 3)), 4), np.zeros((1, 3)))


def test_corners_of_an_outline_reach_as_far_as_all_of_it(rng):
    """Along every direction towards lower heights, with holes, and with one height alone."""
    z, y = np.mgrid[:40, :50]
    for heights in (np.round(30 - np.sqrt(np.maximum(900 - (z - 20) ** 2 - (y - 25) ** 2, 0))).astype(int),
                    rng.integers(0, 30, (40, 50)), np.full((40, 50), 7)):
        heights = np.where(rng.random(heights.shape) < 0.1, EMPTY, heights)
        points = np.stack([heights, y, z], -1)
        corners, known = _corners(heights), heights < EMPTY
        d = rng.normal(size=(500, 3))
        d[:, 0] = -np.abs(d[:, 0])
        np.testing.assert_allclose((points[corners] @ d.T).max(0), (points[known] @ d.T).max(0), rtol=1e-12)
        assert corners.sum() < 0.5 * known.sum()

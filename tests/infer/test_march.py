"""Marches against NumPy float64 quadrature and closed forms."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields
from helpers.jit import arrays
from helpers.variants import VARIANT
from helpers.volumes import Formula, Unskipped

from mi_ntf.infer import bundle, march, tuning
from mi_ntf.infer.bundle import Strand
from mi_ntf.infer.grid import baked
from mi_ntf.infer.network import NOTHING, NetworkField
from mi_ntf.infer.visibility import outside, raymarch

BLOBS = [(-0.3, 0.0, 0.0), (0.35, 0.2, 0.1), (0.0, -0.45, 0.3)], [0.35, 0.25, 0.2]


@pytest.fixture(scope="module")
def grid():
    mi.set_variant(VARIANT)
    return baked(NetworkField(*fields.blobs(*BLOBS, log_density=3.5), mi), 64, mi)


@pytest.fixture(scope="module")
def slab():
    """σ = 1.5 in the whole unit sphere (but for the voxels that its surface cuts)."""
    mi.set_variant(VARIANT)
    return baked(NetworkField(*fields.uniform(1.5), mi), 256, mi)


def rays(rng, n, reach=0.9):
    """Rays from outside through the sphere."""
    target = rng.uniform(-reach / 2, reach / 2, (n, 3))
    d = rng.normal(size=(n, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return target - 3 * d, d


def quadrature(density, o, d, t0, t1, n=20000):
    """∫ σ along each ray, midpoint rule."""
    total = np.zeros(len(o))
    for i in range(n):
        t = t0 + (i + 0.5) / n * (t1 - t0)
        total += np.array(density(arrays(o + t[:, None] * d)), np.float64)
    return total * (t1 - t0) / n


def test_transmittance_and_weights(grid, rng):
    o, d = rays(rng, 300)
    step = 2 / 2048
    samples = march.camera_samples(
        [Strand(grid, arrays(o), arrays(d), mi.Float(step))],
        mi.Float(np.full(300, 1e9)),
        mi.Float(rng.random(300)),
        mi.Float(rng.random(300)),
    )
    index, t, (w,), transmittance = samples.ray, samples.t, samples.weights, samples.transmittance
    depth = quadrature(grid.density, o, d, np.full(300, 2.0), np.full(300, 4.0), 4000)
    # Midpoint rule on trilinear density of slope ~1e3: error per step ~ σ'Δ²/8, below 1e-3 in depth.
    np.testing.assert_allclose(np.array(transmittance), np.exp(-depth), atol=3e-3)
    sums = np.bincount(np.array(index), weights=np.array(w), minlength=300)
    # What MIN_LOSS and MIN_TRANSMITTANCE leave out.
    np.testing.assert_allclose(sums, 1 - np.array(transmittance), atol=1.2e-3)
    assert (np.array(w) > march.MIN_LOSS).all()
    x = np.array(samples.place(0, index, t)[0]).T
    assert np.linalg.norm(x, axis=1).max() < 1


def test_samples_follow_free_flight(slab, rng):
    """In a uniform medium the weighted mean depth is that of an exponential cut off at the far side."""
    n, sigma = 20000, 1.5
    o, d = np.tile([[0.0, 0.0, 3.0]], (n, 1)), np.tile([[0.0, 0.0, -1.0]], (n, 1))
    samples = march.camera_samples(
        [Strand(slab, arrays(o), arrays(d), mi.Float(0.25))],
        mi.Float(np.full(n, 1e9)),
        mi.Float(rng.random(n)),
        mi.Float(rng.random(n)),
    )
    w, t = np.array(samples.weights[0], np.float64), 2 + np.array(samples.t, np.float64)
    np.testing.assert_allclose(np.array(samples.bundle.base), 2)
    assert w.sum() / n == pytest.approx(1 - np.exp(-2 * sigma), rel=4e-3)  # voxels at the surface, 1/128 wide
    mean = 2 + 1 / sigma - 2 * np.exp(-2 * sigma) / (1 - np.exp(-2 * sigma))
    # Coarse steps of an eighth of the chord, yet no bias: that is what the random depth inside a step is for.
    assert (w * t).sum() / w.sum() == pytest.approx(mean, abs=6e-3)


def test_optical_depth(grid, rng):
    x, d = rng.uniform(-0.5, 0.5, (400, 3)), rng.normal(size=(400, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    b = (x * d).sum(1)
    length = -b + np.sqrt(b * b - (x * x).sum(1) + 1)
    truth = quadrature(grid.density, x, d, np.zeros(400), length, 4000)
    steps = tuple(mi.Float(s) for s in raymarch.default_steps(2 / 512))
    ours = raymarch.optical_depth(
        grid,
        arrays(x),
        arrays(d),
        mi.Float(np.full(400, np.inf)),
        steps,
        dr.full(mi.Bool, True, 400),
    )
    # τ is what counts; steps grow to half a voxel far from the point.
    np.testing.assert_allclose(np.exp(-np.array(ours)), np.exp(-truth), atol=0.02)
    assert np.sqrt(np.mean((np.exp(-np.array(ours)) - np.exp(-truth)) ** 2)) < 4e-3


def test_optical_depth_of_a_uniform_sphere(slab):
    """σ × length for lights outside and inside, and for points outside."""
    x = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0, 0], [-3.0, 0, 0], [3.0, 0, 0]])
    d = np.array([[1.0, 0, 0]] * 5)
    length = np.array([np.inf, np.inf, 0.25, np.inf, np.inf])
    steps = tuple(mi.Float(s) for s in raymarch.default_steps(2 / 384))
    ours = raymarch.optical_depth(
        slab,
        arrays(x),
        arrays(d),
        mi.Float(length),
        steps,
        dr.full(mi.Bool, True, 5),
    )
    # The sphere's surface cuts voxels of 1/128: half a voxel of σ 1.5 at each crossing.
    np.testing.assert_allclose(np.array(ours), [1.5, 0.75, 0.375, 3.0, 0.0], atol=0.013)


@pytest.mark.parametrize("far", [np.inf, 0.3])
def test_derivatives_of_optical_depth(grid, rng, far):
    """Derivatives by point, direction and distance agree with central differences of fine marches.

    They are taken within a branch, as in plugins."""
    n = 4000
    x, d, way = rng.uniform(-0.3, 0.3, (n, 3)), rng.normal(size=(n, 3)), rng.normal(size=(7, n))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    steps = tuple(mi.Float(s / 4) for s in raymarch.default_steps(2 / 384, gradients=True))

    def depth(t):
        place = [mi.Float(x[:, i]) + t * mi.Float(way[i]) for i in range(3)]
        along = mi.Vector3f([mi.Float(d[:, i]) + t * mi.Float(way[3 + i]) for i in range(3)])
        length = mi.Float(far) + (t * mi.Float(way[6]) if np.isfinite(far) else 0)
        state = tuple(place), tuple(dr.normalize(along)), length
        lit = mi.Float(x[:, 0]) < 2  # always, which no kernel knows
        return dr.if_stmt(
            state, lit,
            lambda x, d, length: raymarch.optical_depth(grid, x, d, length, steps, mi.Bool(True)),
            lambda x, d, length: mi.Float(0))

    h = 2e-3
    truth = (np.array(depth(mi.Float(h))) - np.array(depth(mi.Float(-h)))) / (2 * h)
    t = dr.zeros(mi.Float, n)
    dr.enable_grad(t)
    result = depth(t)
    dr.forward(t)
    error = np.abs(np.array(dr.grad(result)) - truth)
    scale = np.sqrt((truth**2).mean())
    assert np.quantile(error, 0.8) < 0.05 * scale  # 0.026; of the others, rays cross an edge within h


def test_transmittance_from_outside_ends_at_the_light(slab):
    """Points outside of the uniform sphere; lights before, in and behind it, past it and in the other direction."""
    march = raymarch.RayMarch(slab, tuple(mi.Float(s) for s in raymarch.default_steps(2 / 384)))
    x = np.array([[-3.0, 0, 0]] * 4 + [[-3.0, 1.5, 0], [3.0, 0, 0], [-0.5, 0, 0], [-0.5, 0, 0]])
    distance = mi.Float([1.5, 2.5, 3.5, np.inf, np.inf, np.inf, 0.75, 1.0])
    active = mi.Bool([True] * 7 + [False])
    tau = outside.tau(march, arrays(x), arrays([[1.0, 0, 0]] * 8), distance, mi.UInt32(0), active)
    # Voxels cut by the sphere, as above; rays that are not asked for are free.
    np.testing.assert_allclose(-np.log(np.array(tau)), [0, 0.75, 2.25, 3, 0, 0, 1.125, 0], atol=0.013)


def test_opaque_matter_lets_nothing_through(rng):
    """Rays that end in matter have transmittance 0; other rays keep theirs."""
    for sigma, truth in ((1000.0, 0.0), (1.0, np.exp(-2.0))):
        ball = baked(NetworkField(*fields.uniform(sigma), mi), 64, mi)
        strand = Strand(ball, arrays(np.tile([[0, 0, 3.0]], (64, 1))),
                        arrays(np.tile([[0, 0, -1.0]], (64, 1))), mi.Float(2 / 384))  # fmt: skip
        samples = march.camera_samples([strand], mi.Float(np.inf), mi.Float(rng.random(64)), mi.Float(rng.random(64)))
        # Voxels cut by the sphere lose σ/64.
        np.testing.assert_allclose(np.array(samples.transmittance), truth, rtol=0.02)


@pytest.mark.parametrize("scale", [0.008, 0.012, 0.02])
def test_light_out_of_a_skin_that_thins_out(scale, rng):
    """The mean transmittance of free flight into a skin of density exp(−z/scale)/scale is ½, within 0.07 %."""
    u = (np.arange(4096) + 0.5) / 4096
    x = np.stack([rng.uniform(-0.3, 0.3, 4096), rng.uniform(-0.3, 0.3, 4096), -scale * np.log(-np.log(u) * 0.8)], 1)
    actual = raymarch.RayMarch(Formula(lambda p: dr.exp(-p[2] / scale) / scale),
                              tuple(mi.Float(s) for s in raymarch.default_steps(2 / 384)))
    tau = actual.tau(arrays(x), arrays(np.tile([0.6, 0.0, 0.8], (4096, 1))), mi.Float(np.inf), mi.UInt32(0),
                    dr.full(mi.Bool, True, 4096))
    assert np.array(tau, np.float64).mean() == pytest.approx(0.5, rel=0.001)


def means(log_density) -> np.ndarray:
    """Mean σ of the pieces of a cell from 0 to 1, of ln σ at their ends."""
    logs = [mi.Float(log_density(k / bundle.PIECES)) for k in range(bundle.PIECES + 1)]
    return np.array([np.array(m)[0] for m in bundle._pieces(logs)[0]])


def test_means_of_pieces(slab):
    """Means are exact for exponentials, close for parabolas, half where density sets in at once, and 0 without any."""
    u = (np.arange(6000) + 0.5) / 6000
    for slope in (-4.0, -0.5, 0.0, 2.0, 4.0):
        truth = np.exp(0.3 + slope * u).reshape(bundle.PIECES, -1).mean(1)
        np.testing.assert_allclose(means(lambda t, slope=slope: 0.3 + slope * t), truth, rtol=1e-4)
    for arch in (-2.0, 2.0):
        truth = np.exp(1 + u + arch * u * (1 - u)).reshape(bundle.PIECES, -1).mean(1)
        np.testing.assert_allclose(means(lambda t, arch=arch: 1 + t + arch * t * (1 - t)), truth, rtol=2e-3)
    np.testing.assert_allclose(means(lambda t: 2.0 if t == 1 else NOTHING)[:-1], 0)
    arch = 1 / 12  # of the parabola that a jump is taken for
    np.testing.assert_allclose(means(lambda t: 2.0 if t == 1 else NOTHING)[-1], 0.5 * np.exp(2 - arch), rtol=1e-3)
    assert (means(lambda t: NOTHING) == 0).all()


@pytest.mark.parametrize("bend", [-1.5, -0.021, -0.019, 0.0, 0.019, 0.021, 1.5])
def test_places_in_a_cell(variant, bend):
    """The inverse of the optical depth of densities that are exponential across each piece, by the formulas
    for small and for other slopes: 1e-5 of a piece, float32's grain and the third power of a small slope."""
    fraction = (np.arange(60) + 0.5) / 60 * bundle.PIECES
    piece, u = np.floor(fraction), fraction % 1
    part, sigmas = 0.1, 2.0 + np.arange(bundle.PIECES)
    rise = np.expm1(bend * u) / np.expm1(bend) if bend else u
    depth = part * (np.concatenate([[0], np.cumsum(sigmas)])[piece.astype(int)] + sigmas[piece.astype(int)] * rise)
    cell = bundle.Cell(mi.Float(0.3), mi.Float(part), tuple((mi.Float(s),) for s in sigmas),
                       (mi.Float(bend),) * bundle.PIECES, None, ())
    np.testing.assert_allclose(np.array(cell.place(mi.Float(depth))), 0.3 + fraction * part, atol=1e-5 * part + 1e-7)


def test_skipping_changes_nothing(grid, rng):
    """The same rays with an occupancy that never lets a march skip: equal weights, sample by sample."""
    o, d = rays(rng, 200)
    arguments = (
        mi.Float(np.full(200, 1e9)),
        mi.Float(rng.random(200)),
        mi.Float(rng.random(200)),
    )
    strands = [[Strand(g, arrays(o), arrays(d), mi.Float(2 / 300))] for g in (grid, Unskipped(grid))]
    fast, slow = ((s.ray, s.t, *s.weights) for s in (march.camera_samples(k, *arguments) for k in strands))
    order = [np.lexsort((np.array(r[1]), np.array(r[0]))) for r in (fast, slow)]
    for a, b in zip(fast, slow, strict=True):
        np.testing.assert_allclose(np.array(a)[order[0]], np.array(b)[order[1]], atol=2e-5)


def test_skipping_changes_no_flight(grid, rng):
    """Rays end where rays that never skip do, within float32, with cells so long that a lost one would show."""
    o, d = (arrays(v) for v in rays(rng, 2000))
    offset, depth = (mi.Float(rng.random(2000)) for _ in range(2))
    strands = (Strand(g, o, d, mi.Float(1 / 16)) for g in (grid, Unskipped(grid)))
    (hit, t, _), (all_hit, all_t, _) = (
        [np.array(a) for a in march.free_flight([s], mi.Float(1e9), offset, [-dr.log(1 - depth)])] for s in strands)
    assert hit.any() and not hit.all()
    np.testing.assert_array_equal(hit, all_hit)
    np.testing.assert_allclose(t[hit], all_t[hit], atol=1e-4)


def test_samples_of_several_portions_are_unbiased(grid, rng, monkeypatch):
    """The mean over many random numbers of sums over samples is that of finer portions.

    A ray has no more samples than portions of light."""
    lines, numbers = 20, 16384
    o, d = (np.repeat(v, numbers, axis=0) for v in rays(rng, lines))
    offset, u = np.repeat(rng.random(lines), numbers), rng.random(lines * numbers)
    actual, noise = [], []
    for fraction in (tuning.SAMPLE_FRACTION, 1e-2):
        monkeypatch.setattr(tuning, "SAMPLE_FRACTION", fraction)
        samples = march.camera_samples([Strand(grid, arrays(o), arrays(d), mi.Float(2 / 200))],
                                       mi.Float(np.inf), mi.Float(offset), mi.Float(u))
        assert np.array(samples.count).max() <= 1 / fraction + 1
        ray, t, w = (np.array(a, np.float64) for a in (samples.ray, samples.t, samples.weights[0]))
        sums = np.stack([np.bincount(ray.astype(int), w * f, lines * numbers).reshape(lines, numbers)
                         for f in (np.ones_like(t), t, np.cos(20 * t))])
        actual.append(sums.mean(2))
        noise.append(sums.var(2) / numbers)
    np.testing.assert_allclose(actual[0][0], actual[1][0], atol=march.MIN_LOSS)
    z = (actual[0] - actual[1])[1:, actual[0][0] > 0] / np.sqrt(noise[0] + noise[1])[1:, actual[0][0] > 0]
    assert np.abs(z).max() < 4.5  # of 40 numbers, by chance one time in 4000


def test_rays_that_miss():
    mi.set_variant(VARIANT)
    empty = baked(NetworkField(*fields.empty(), mi), 32, mi)
    o, d = np.array([[0, 0, 3.0], [5.0, 0, 3.0]]), np.array([[0, 0, -1.0], [0, 0, -1.0]])
    samples = march.camera_samples(
        [Strand(empty, arrays(o), arrays(d), mi.Float(0.01))],
        mi.Float([1e9, 1e9]),
        mi.Float([0.3, 0.3]),
        mi.Float([0.5, 0.5]),
    )
    assert len(samples.ray) == 0
    np.testing.assert_array_equal(np.array(samples.transmittance), [1, 1])


def test_overlapping_fields_add(rng):
    """Two uniform balls that overlap, along one line: weights and free flight in closed form."""
    dense, thin = (baked(NetworkField(*fields.uniform(s), mi), 128, mi) for s in (0.5, 0.6))
    n = 4000
    axis = np.tile([[0.0, 0.0, -1.0]], (n, 1))
    # Scene units are those of the dense ball; the thin one is twice its size, its centre 1.2 behind the other's.
    strands = [
        Strand(f, arrays(np.tile([[0, 0, z]], (n, 1))), arrays(axis), mi.Float(0.01), mi.Float(rate))
        for f, z, rate in ((dense, 3.0, 1.0), (thin, 2.1, 0.5))
    ]
    far = mi.Float(np.full(n, 1e9))
    u = [mi.Float(rng.random(n)) for _ in range(4)]
    samples = march.camera_samples(strands, far, u[0], u[1])
    # The dense ball fills t in [2, 4], the thin one [2.2, 6.2] at density 0.3.
    t = np.linspace(2, 6.2, 42001)
    sigma = np.stack([np.where(t < 4, 0.5, 0), np.where(t > 2.2, 0.3, 0)])
    passed = np.concatenate([[0], np.cumsum(0.5 * (sigma.sum(0)[1:] + sigma.sum(0)[:-1]) * 1e-4)])
    truth = (sigma * np.exp(-passed)).sum(1) * 1e-4
    got = [np.array(w, np.float64).sum() / n for w in samples.weights]
    np.testing.assert_allclose(got, truth, rtol=0.01)  # voxels at the spheres' surfaces, 1/64 wide
    np.testing.assert_allclose(np.array(samples.transmittance), np.exp(-passed[-1]), rtol=0.02)
    hit, where, index = march.free_flight(strands, far, u[0], [-dr.log(1 - u[2]), -dr.log(1 - u[3])])
    hit, where, index = (np.array(a) for a in (hit, where, index))
    noise = 4 * np.sqrt(0.25 / n)
    assert [(hit & (index == i)).mean() for i in (0, 1)] == pytest.approx(list(truth), abs=noise)
    assert where[hit].mean() == pytest.approx((sigma.sum(0) * np.exp(-passed) * t).sum() / (
        sigma.sum(0) * np.exp(-passed)).sum(), abs=4 * where[hit].std() / np.sqrt(n))
    cut = mi.Float(np.full(n, 3.0))
    assert np.array(march.camera_samples(strands, cut, u[0], u[1]).t).max() <= 1.0


def test_rays_have_the_samples_of_the_finest_field_that_they_meet():
    """Two balls side by side, one of smoke, which lose 1 − e⁻² of the light of rays through their middles."""
    ball = baked(NetworkField(*fields.uniform(1.0), mi), 64, mi)
    o = np.tile([[0.0, 0.0, 3.0], [4.0, 0.0, 3.0], [8.0, 0.0, 3.0]], (500, 1))
    d = arrays(np.tile([[0, 0, -1.0]], (1500, 1)))
    strands = [Strand(ball, arrays(o - [x, 0, 0]), d, mi.Float(0.01), mi.Float(1)) for x in (0, 4)]
    u = [mi.Float((np.arange(1500) * g) % 1) for g in (0.618034, 0.7548777)]
    lost = 1 - np.exp(-2)
    for shares in ((1 / 8, 1 / 64), ()):
        samples = march.camera_samples(strands, mi.Float(1e9), *u, fractions=shares)
        solid, smoke, none = np.array(samples.count).reshape(-1, 3).T
        for count, fraction in zip((solid, smoke), shares or (tuning.SAMPLE_FRACTION,) * 2, strict=True):
            assert count.min() >= np.floor(lost / fraction) and count.max() <= np.ceil(lost / fraction) + 1
        assert not none.any()
        for weight in samples.weights:
            assert np.array(weight, np.float64).sum() / 500 == pytest.approx(lost, rel=0.01)  # voxels at the surface


@pytest.mark.parametrize("distance", [3.0, 300.0, 2e4, 1e6])
def test_rays_from_afar(slab, distance):
    """Light and view keep their digits at large distances: closed form along two chords, and both marches end."""
    across = np.array([0.0, 0.6])
    x = np.stack([across, np.zeros(2), np.full(2, distance)], 1)
    d = np.tile([[0.0, 0.0, -1.0]], (2, 1))
    truth = 2 * 1.5 * np.sqrt(1 - across**2)
    steps = tuple(mi.Float(s) for s in raymarch.default_steps(2 / 384))
    depth = raymarch.optical_depth(
        slab, arrays(x), arrays(d), mi.Float(np.inf), steps, dr.full(mi.Bool, True, 2)
    )
    np.testing.assert_allclose(np.array(depth), truth, atol=0.013)  # as above: voxels cut by the sphere
    samples = march.camera_samples(
        [Strand(slab, arrays(x), arrays(d), mi.Float(2 / 384))],
        mi.Float(np.inf),
        mi.Float([0.3, 0.7]),
        mi.Float([0.5, 0.5]),
    )
    np.testing.assert_allclose(-np.log(np.array(samples.transmittance)), truth, atol=0.013)
    # Entry to the sphere, to float32's grain at this distance.
    np.testing.assert_allclose(np.array(samples.bundle.base), distance - np.sqrt(1 - across**2), rtol=2e-7, atol=1e-6)
    place = np.array(samples.place(0, samples.ray, samples.t)[0]).T
    assert np.linalg.norm(place, axis=1).max() < 1 + 1e-5


@pytest.mark.parametrize("step", [2 / 16, 2 / 400])
def test_each_portion_of_the_light_has_a_sample_at_its_place(rng, step):
    """The samples lie at the same depths whether one cell takes all of the light or many cells share it."""
    sigma, n, fraction = 30.0, 2000, 1 / 6
    dense = baked(NetworkField(*fields.uniform(sigma), mi), 64, mi)
    o, d = np.tile([[0.1, 0.2, 3.0]], (n, 1)), np.tile([[0, 0, -1.0]], (n, 1))
    depth = rng.random(n)
    samples = march.camera_samples([Strand(dense, arrays(o), arrays(d), mi.Float(step))], mi.Float(np.inf),
                                   mi.Float(rng.random(n)), mi.Float(depth), view=True, fractions=(fraction,))
    weights, view, ray = (np.array(v) for v in (samples.weights[0], samples.view, samples.ray))
    np.testing.assert_array_equal(np.bincount(ray, minlength=n), np.full(n, 6))
    np.testing.assert_allclose(weights, fraction, atol=march.MIN_TRANSMITTANCE)  # where rays end
    k = np.arange(6)
    lost = (k + (depth[:, None] + k * march.GOLDEN) % 1) * fraction
    # In the last portion, which the end of the ray cuts, a sample may lie elsewhere.
    np.testing.assert_allclose(1 - view.reshape(n, 6)[:, :5], lost[:, :5], atol=1e-4)


def test_no_ray_has_more_samples_than_portions(rng):
    """Rounding may end the first cell before the ray begins; one sample too many would overwrite another ray's."""
    dense = baked(NetworkField(*fields.uniform(60.0), mi), 32, mi)
    o, d = rays(rng, 50_000)
    offset = mi.Float(np.full(len(o), np.nextafter(np.float32(1), np.float32(0))))
    strands = [Strand(dense, arrays(o - [x, 0, 0]), arrays(d), mi.Float(2 / 256), mi.Float(1)) for x in (0, 4)]
    samples = march.camera_samples(strands, mi.Float(np.inf), offset, mi.Float(rng.random(len(o))),
                                   fractions=(tuning.SMOKE_SAMPLE_FRACTION,) * 2)
    assert sum(np.array(w) for w in samples.weights).min() > 0.9 * march.MIN_LOSS
    assert np.array(samples.count).max() <= 1 / tuning.SMOKE_SAMPLE_FRACTION

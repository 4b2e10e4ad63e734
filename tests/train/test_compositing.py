"""Compositing against double loops and closed forms."""

import dataclasses
import math

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

import torch.nn.functional as F  # noqa: E402
from train import shots  # noqa: E402

from mi_ntf.core import fresnel, microfacet  # noqa: E402
from mi_ntf.core import ops as numpy_ops  # noqa: E402
from mi_ntf.core.architecture import RETRO, Encoding, Network  # noqa: E402
from mi_ntf.train import held_out, losses, networks, ops, scoring, volume  # noqa: E402
from mi_ntf.train.config import PRESETS  # noqa: E402
from mi_ntf.train.normal_targets import NormalTargets  # noqa: E402
from mi_ntf.train.occupancy import Occupancy, neighbour_maximum  # noqa: E402
from mi_ntf.train.optical import Optical  # noqa: E402
from mi_ntf.train.rays import Rays, sphere_span  # noqa: E402
from mi_ntf.train.transmittance_targets import TransmittanceTargets, chords, uniform_directions  # noqa: E402

SIGMA = 3.0
ALBEDO, LIGHT = 0.5, 7.0


def rays(n=4):
    """Rays along +z from 3 units away through the ball, hitting it near its axis."""
    o = torch.zeros(n, 3)
    o[:, 0] = torch.linspace(0.0, 0.4, n)
    o[:, 2] = -3.0
    d = torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    t0, t1 = sphere_span(o, d)
    return Rays(o, d, t0, t1, torch.zeros(n, 4), torch.full((n, 3), LIGHT),
                torch.zeros(n, dtype=torch.long))


class Slab:
    """Uniform density, Lambert reflectance, normals towards the camera."""

    fresnel = False
    retro = tail = phase = None

    def log_density(self, x):
        return torch.full((len(x),), float(np.log(SIGMA)))

    def density(self, x):
        return torch.exp(self.log_density(x))

    def reflectance(self, x):
        one = torch.ones(len(x))
        normal = torch.tensor([0.0, 0.0, -1.0]).expand(len(x), 3)
        return networks.Reflectance(normal, ALBEDO * torch.ones(len(x), 3), one, 0 * one[:, None])


def test_packed_weights_equal_a_double_loop():
    rng = np.random.default_rng(0)
    counts, step = [3, 0, 5, 1], 0.05
    ray = np.repeat(np.arange(4), counts)
    sigma = rng.uniform(0, 40, len(ray)).astype(np.float32)
    w, v = Optical.of(torch.tensor(sigma), torch.tensor(ray), step).weights()
    for r in range(4):
        front = 1.0
        for j in np.nonzero(ray == r)[0]:
            through = np.exp(-np.float64(sigma[j]) * step)
            # float32 exponentials of depths up to 10: relative error some 1e-6
            np.testing.assert_allclose(w[j], front * (1 - through), rtol=1e-5, atol=1e-7)
            np.testing.assert_allclose(v[j], front**2 * (1 - through**2) / 2, rtol=1e-5, atol=1e-7)
            front *= through


def test_uniform_ball_has_the_closed_form():
    """alpha = 1 − e^{−2σh}; colour = SURFACE ∫ T²σ (k/π) I/t² dt, the ball crossed along its chord of half length h."""
    batch = rays()
    grid = Occupancy(torch.ones((16,) * 3, dtype=torch.bool))
    grid.sigma[:] = 0.0  # occupied everywhere, nothing hidden
    step = 1 / 400
    generator = torch.Generator().manual_seed(0)
    cells = grid.visible(batch, step, generator)
    image = volume.render(Slab(), batch, volume.unspent(Slab(), batch, cells, step, generator))
    h = ((batch.t1 - batch.t0) / 2).numpy().astype(float)
    # A jittered first and last cell each miss or add up to one cell: 2σ·step = 1.5 % of the depth at that end.
    np.testing.assert_allclose(image.alpha, 1 - np.exp(-2 * SIGMA * h), rtol=0.004)
    for i, t0 in enumerate(batch.t0.numpy().astype(float)):
        t = t0 + (np.arange(4000) + 0.5) * (2 * h[i] / 4000)
        integral = np.sum(np.exp(-2 * SIGMA * (t - t0)) * SIGMA / t**2) * (2 * h[i] / 4000)
        expected = volume.SURFACE * integral * ALBEDO / np.pi * LIGHT
        np.testing.assert_allclose(image.color[i], expected, rtol=0.02)


def test_rays_end_where_they_are_spent_and_steep_cells_are_split():
    """Cells of each ray in front of the depth SPENT remain, in their order. Cells of optical depth STEEP and their
    neighbours are split in PARTS, with a sample in each part."""
    counts, step = np.array([60, 0, 100, 1, 40]), 0.05
    ray = torch.as_tensor(np.repeat(np.arange(5), counts))
    near = torch.as_tensor(np.concatenate([np.arange(n) * step + 1 for n in counts])).float()
    sigma = torch.tensor([2.0, 0.0, 0.3, 500.0, 30.0])

    class Rows:
        def density(self, x):
            row = x[:, 1].round().long()
            return sigma[row] * ((row != 4) | (x[:, 0] > 1.5))  # row 4 is empty up to its tenth cell

    batch = rays(5)
    o, d = torch.tensor([[0.0, k, 0.0] for k in range(5)]), torch.tensor([[1.0, 0.0, 0.0]] * 5)
    batch = dataclasses.replace(batch, o=o, d=d)
    order, places, widths = volume.unspent(Rows(), batch, (ray, near), step, torch.Generator().manual_seed(0))
    # Row 3's one cell has neighbours in the rows beside it.
    expected = [1] * 60, [], [1] * 99 + [4], [4], [4] + [1] * 8 + [4] * 6
    for k, parts in enumerate(expected):
        width = np.repeat(step / np.array(parts), parts)
        start = 1 + np.cumsum(width) - width
        np.testing.assert_allclose(widths[order == k], width, rtol=1e-6)
        inside = (places[order == k].numpy() - start) / width
        assert ((inside > -1e-4) & (inside < 1 + 1e-4)).all(), k
    assert (order.diff() >= 0).all()


@pytest.mark.parametrize("shape", [(5, 5, 5), (1, 1, 1)])
def test_the_most_of_the_neighbours(shape):
    grid = torch.rand(shape, generator=torch.Generator().manual_seed(0))
    assert (neighbour_maximum(grid) == F.max_pool3d(grid[None, None], 3, 1, 1)[0, 0]).all()


def test_an_opaque_plane_looks_like_its_surface():
    """The reason of SURFACE: v sums to 1/2 behind an opaque front, however coarse the cells are."""
    for step in (0.2, 0.01):
        w, v = Optical.of(torch.full((400,), 600.0), torch.zeros(400, dtype=torch.long), step).weights()
        assert abs(float(w.sum()) - 1) < 1e-6
        assert abs(volume.SURFACE * float(v.sum()) - 1) < 1e-6


def test_a_ray_outside_the_occupied_cells_is_dropped_and_others_are_tightened():
    hull = torch.zeros((32,) * 3, dtype=torch.bool)
    hull[14:18, 14:18, 14:18] = True  # |x| ≤ 1/8
    grid = Occupancy(hull)
    index, remaining = grid.tighten(rays(5))
    assert index.tolist() == [0, 1]  # x = 0 and 0.1; the next is at 0.2
    # A cell (1/16) more at most at either end than the cube itself, 3 ± 1/8
    assert (remaining.t0 <= 3 - 1 / 8).all() and (remaining.t0 >= 3 - 1 / 8 - 1 / 8).all()
    assert (remaining.t1 >= 3 + 1 / 8).all() and (remaining.t1 <= 3 + 1 / 8 + 1 / 8).all()


def test_a_field_without_matter_is_black():
    """Rays meet no cell, not even a block of cells."""
    grid = Occupancy(torch.zeros((32,) * 3, dtype=torch.bool))
    index, remaining = grid.tighten(rays(5))
    assert len(index) == len(remaining) == 0
    result = scoring.FieldView(Slab(), grid, 0.01).render(rays(5), torch.Generator().manual_seed(0))
    assert [v.shape for v in result] == [(5, 3), (5,), (5, 3), (5, 3)] and not any(v.any() for v in result)


def ball(cells=48, radius=0.5, sigma=40.0):
    baked = NormalTargets(cells)

    class Field:
        def density(self, x):
            return torch.where(x.norm(dim=1) < radius, sigma, 0.0)

    grid = Occupancy(torch.ones((16,) * 3, dtype=torch.bool))
    baked.update(Field(), grid)
    return baked


def test_normals_of_a_ball_point_outwards():
    baked = ball()
    x = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    normal, certain = baked.normals(0.5 * x)
    assert certain.all()
    # Steps of 1/24 blurred over 1.25 cells: a few degrees remain
    assert float((normal * x).sum(1).clamp(-1, 1).acos().rad2deg().mean()) < 4


def marched_ball(sigma=40.0):
    class Field:
        def log_density(self, x):
            return torch.where(x.norm(dim=1) < 0.5, math.log(sigma), -12.0)

    marched = TransmittanceTargets()
    marched.update(Field(), Occupancy(torch.ones((64,) * 3, dtype=torch.bool)))
    return marched


def test_marched_depth_of_a_ball_is_its_chord():
    marched = marched_ball(sigma=4.0)
    assert 0.5 < marched.reach < 0.55
    m, d, h = torch.tensor([[0.0, 0.3, 0.0]]), torch.tensor([[1.0, 0.0, 0.0]]), torch.tensor([0.9539])
    depth = marched.march(m, d, h, 400)
    assert float(depth[0, -1]) == 0.0
    assert (depth[0, :-1] >= depth[0, 1:]).all()
    # chord 2·0.4 of σ 4; ln σ, not σ, rises across two voxels of 1/64: either end loses at most one and a half
    assert 3.2 - 3 * 4 / 64 < float(depth[0, 0]) < 3.2


@pytest.mark.parametrize("augment", [True, False])
def test_training_rays(augment):
    """Shading points of camera rays lie where free flight ends: on average 1/σ behind the surface."""
    sigma, n = 40.0, 4000
    batch = rays()[torch.zeros(50, dtype=torch.long)]
    o, d = losses.training_rays(marched_ball(sigma), batch, n, augment, torch.Generator().manual_seed(0))
    assert o.shape == d.shape == (n, 3)
    np.testing.assert_allclose(d.norm(dim=1), 1, rtol=1e-5)
    x, toward = o[-n // 2:], -batch.d[0]
    m, _ = chords(batch.o[:1], batch.d[:1])
    front = (0.25 - (m[0] @ m[0])).sqrt()  # the ball's half chord
    depth = front - (x - m) @ toward
    assert float((x - m - ((x - m) @ toward)[:, None] * toward).norm(dim=1).max()) < 1e-4
    # Exponential flight of mean and deviation 1/σ; the grid (1/64) smears the surface by a voxel.
    assert abs(float(depth.mean()) - 1 / sigma) < 1 / 64 and float(depth.std()) < 1.5 / sigma
    assert torch.equal(d[-1], toward) is not augment


@pytest.mark.parametrize("kind", ["depth", "frequency"])
def test_transmittance_loss_leaves_the_field_alone(kind):
    ray = Network(Encoding(kind, octaves=2 if kind == "frequency" else 0), (16,), components=2)
    arch = dataclasses.replace(PRESETS["fast"].architecture, transmittance=ray,
                               visibility=Network(Encoding("frequency", octaves=1), (8,)))
    nets = networks.initial(arch, 1.0, torch.Generator().manual_seed(0))
    generator = torch.Generator().manual_seed(0)
    marched = marched_ball()
    targets = losses.targets(marched, torch.rand(64, 3) - 0.5, uniform_directions(64, generator), generator)
    loss = losses.transmittance(nets, targets) + losses.visibility(nets, targets)
    batch = rays()
    samples = torch.arange(4).repeat_interleave(5), torch.linspace(2.8, 3.2, 5).repeat(4), torch.full((20,), 0.1)
    image = volume.render(nets, batch, samples)
    (loss + losses.transmittance_color(nets, marched, image, batch, 1.0, 4)).backward()
    for name, value in nets.tensors.items():
        if name.startswith(("transmittance", "visibility")):
            assert value.grad is not None and value.grad.abs().sum() > 0, name
        else:
            assert value.grad is None, name


@pytest.mark.parametrize("rim", [False, True])
def test_lobes_wait_for_normals(rim):
    """Roughness, specular weight (rows 6, 7) and retro-reflection learn nothing without lobes, and no normal turns
    from the light.

    Colours that are too dark still turn normals (rows 0 to 2) towards it, and the albedo learns.
    """
    arch = dataclasses.replace(PRESETS["fast"].architecture, fresnel=rim, retro=rim)
    samples = torch.arange(4).repeat_interleave(5), torch.linspace(2.8, 3.2, 5).repeat(4), torch.full((20,), 0.1)
    grads, pictures, back = [], [], []
    for lobes, sign in ((True, 1.0), (False, 1.0), (False, -1.0)):
        nets = networks.initial(arch, 1.0, torch.Generator().manual_seed(0))
        nets.tensors["reflectance.layers.1.bias"].data[:3] = -rays().d[0]  # seen from the front
        image = volume.render(nets, rays(), samples, lobes=lobes)
        (sign * image.color.square().sum()).backward()
        grads.append(nets.tensors["reflectance.layers.1.weight"].grad.abs().sum(1))
        back.append(rim and nets.tensors[RETRO].grad is not None)
        pictures.append(image.color.detach())
    whole, darker, brighter = grads
    assert (whole > 0).all() and (darker[3:6] > 0).all() and (darker[6:] == 0).all()
    assert darker[:3].sum() < 1e-3 * brighter[:3].sum()
    assert not rim or back == [True, False, False]
    assert torch.equal(pictures[0], pictures[1]) and image.reflectance.normal.requires_grad


def test_a_new_field_is_matt():
    """The lobes of a field before its first step are darker than a black surface, so that none has to turn away."""
    generator = torch.Generator().manual_seed(0)
    nets = networks.initial(PRESETS["fast"].architecture, 1.0, generator)
    learned = nets.reflectance(torch.rand(100, 3, generator=generator) - 0.5)
    facing = torch.ones(100)
    _, gloss = microfacet.lobes_collocated(ops, facing, learned.roughness)
    _, weight = fresnel.weights_collocated(ops, facing, learned.roughness, learned.specular.T, 0.0)
    assert float((math.pi * weight * gloss).max().detach()) < 0.03


def test_evenness_sees_slopes_along_the_surface_alone():
    """ln σ = 8z does not change along surfaces of normal −z; for normals x it differs by 16·offset·cos, ⟨cos²⟩ = ½."""
    class Ramp:
        phase = None

        def log_density(self, x):
            return 8 * x[:, 2]

    def image(normal):
        n = 500
        surface = networks.Reflectance(torch.tensor(normal).expand(n, 3), None, None, None)
        return volume.Image(color=None, alpha=None, x=torch.zeros(n, 3), shaded=None, index=None, weight=torch.ones(n),
                            reflectance=surface, radiance=None, raw=None, bounced=0.0)

    generator = torch.Generator().manual_seed(0)
    # float32 rounding of offsets of 0.02
    assert float(losses.evenness(Ramp(), image([0.0, 0.0, -1.0]), 0.02, 4000, generator)) < 1e-10
    offset = np.mean(np.linspace(0.005, 0.02, 1000) ** 2)
    # 4000 random directions and lengths: 2 % standard error
    value = float(losses.evenness(Ramp(), image([1.0, 0.0, 0.0]), 0.02, 4000, generator))
    assert value == pytest.approx(128 * offset, rel=0.1)


def test_psnr_of_a_known_error(monkeypatch):
    """Two photographs of 0.6, of which the second has matter in one pixel alone, where the prediction is right."""
    pictures = np.full((2, 1, 4, 4), 0.6, np.float32)
    pictures[..., 3] = [[[1, 1, 1, 1]], [[1, 0, 0, 0]]]
    pictures[1, 0, 0, :3] = 0.5
    pool = shots.photographs(pictures)

    def constant(view, rays, *_):
        return scoring.Pixels(torch.full((len(rays), 3), 0.5), torch.full((len(rays),), 0.75), None, None)

    monkeypatch.setattr(scoring.FieldView, "render", constant)
    field = scoring.FieldView(None, None, 0.01)
    result = scoring.score(field, pool, views=1)
    assert result.linear == pytest.approx(20.0, abs=1e-3)
    # sRGB of 0.5 and 0.6: 0.73536 and 0.79774 → −20 lg 0.06238
    assert result.srgb == result.object == result.each[0] == pytest.approx(24.10, abs=0.01)
    assert result.alpha_rmse == pytest.approx(0.25)
    result = scoring.score(field, pool)
    assert result.each == pytest.approx([24.10, 24.10 + 10 * math.log10(4 / 3)], abs=0.01)
    assert result.srgb == pytest.approx(np.mean(result.each)) and result.linear == pytest.approx(20.625, abs=1e-3)
    assert result.object == pytest.approx((24.10 + 120) / 2, abs=0.01)  # no error counts as 1e-12
    assert result.alpha_rmse == pytest.approx(math.sqrt((0.25**2 + (0.25**2 + 3 * 0.75**2) / 4) / 2))
    # Three pixels of each at most, the same ones in every call; with gains of their own, constants are met exactly.
    assert scoring.score(field, pool, most=6) == scoring.score(field, pool, most=6)
    fit = scoring.score(dataclasses.replace(field, light=scoring.Light(fit=True)), pool, views=1)
    assert fit.srgb == pytest.approx(120, abs=20)  # float32


@pytest.mark.parametrize("retro", [None, 0.0, 0.7])
def test_training_shades_by_the_phase_function_seen_from_the_light(retro):
    """Photographs are compared with the value of the renderers' phase function for ω_i = ω_o."""
    cos, roughness = np.linspace(0.05, 1, 20), np.linspace(0.2, 1, 20)
    specular = np.stack([np.linspace(0, 0.9, 20), np.linspace(0.9, 0, 20), np.full(20, 0.5)])
    w, n = (np.sqrt(1 - cos**2), 0 * cos, cos), (0 * cos, 0 * cos, 1 + 0 * cos)
    diffuse, gloss = microfacet.scattering(numpy_ops, w, w, n, roughness)
    weights = fresnel.weights(numpy_ops, w, w, n, roughness, specular, retro)
    rows = [torch.as_tensor(np.stack(v, 1)) for v in (n, [0.6 + 0 * cos] * 3, w)]
    reflectance = *rows[:2], *map(torch.as_tensor, (roughness, specular.T))
    actual = volume.shade(reflectance, -rows[2], torch.full((20,), 2.0), torch.full((20, 3), 4.0), retro)
    expected = weights[0] * 0.6 * diffuse + weights[1] * gloss
    np.testing.assert_allclose(actual.T, expected, rtol=1e-9)  # float64 rounding of sines


def test_held_out_score_of_a_network_that_knows_no_shadow():
    """Seen head-on, a dense half space shades at points of which light at cosine μ reaches μ/(μ + 1): over all
    directions (1 − ln 2)/2 of it."""
    class Field:
        def log_density(self, x):
            return torch.where(x.norm(dim=1) < 0.5, math.log(200.0), -12.0)

        def density(self, x):
            return self.log_density(x).exp()

        def ray_mixture(self, o, d, profile):
            return torch.ones(len(o), dtype=torch.bool), torch.tensor([1.0, 1.0, -100.0]).expand(len(o), 1, 3)

    # A lens so long that all of its pixels see the same point.
    pool = shots.photographs(np.ones((1, 5, 10, 4), np.float32), focal=1e6, c2w=shots.facing((0, 0, -3.0))[None])
    field = Field()
    marched = TransmittanceTargets()
    marched.update(field, scoring.occupied(field))
    result = held_out.score(field, marched, pool)
    # 4096 pairs of deviation 0.3, and voxels of 1/128 that smear the surface
    assert result["bias"] == pytest.approx(1 - (1 - math.log(2)) / 2, abs=0.03)
    assert result["bias"] < result["rms"] < 1


def test_rough_lobes_cost_more():
    """Σ w ((fading + 60 α⁴) s + (−5 − ln s)²/10) per ray, the square where s lies below e^−5; s above the least.

    Of colours it is the mean over the channels.
    """
    gloss = torch.tensor([1.0, 0.5, 1.0]), torch.tensor([[0.1, 0.2, 0.3], [0.4] * 3, [math.exp(-7)] * 3])
    image = volume.Image(color=None, alpha=None, x=None, shaded=None, index=None,
                         weight=torch.tensor([0.5, 0.25, 0.25]), reflectance=networks.Reflectance(None, None, *gloss),
                         radiance=None, raw=None, bounced=0.0)
    target = 0.5 * 0.2 * 60.5 + 0.25 * 0.4 * (0.5 + 60 / 256) + 0.25 * (math.exp(-7) * 60.5 + 0.4)
    assert float(losses.gloss(image, 0.0, 0.5, 4)) == pytest.approx(target / 4)
    above = dataclasses.replace(image, reflectance=networks.Reflectance(None, None, gloss[0], 0.04 + 0.96 * gloss[1]))
    assert float(losses.gloss(above, 0.04, 0.5, 4)) == pytest.approx(target / 4, rel=1e-5)

"""Light of a flash beside the lens: against the collocated formula, closed forms, quadrature and analytic shadows."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

import torch.nn.functional as F  # noqa: E402
from train import shots  # noqa: E402

from mi_ntf.core import fresnel, microfacet  # noqa: E402
from mi_ntf.core import ops as numpy_ops  # noqa: E402
from mi_ntf.train import flash, rays, volume  # noqa: E402
from mi_ntf.train.networks import Reflectance  # noqa: E402
from mi_ntf.train.optical import Optical  # noqa: E402
from mi_ntf.train.transmittance_targets import TransmittanceTargets, walk  # noqa: E402

ANGLES = [(0, 0), (0, 50), (40, -40), (40, 20), (65, 10), (20, 75), (-60, 60)]
"""Degrees of viewer and light from the normal, in one plane."""


def directions(n: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return F.normalize(torch.randn(n, 3, generator=generator, dtype=torch.float64), dim=1)


def materials(n: int, seed: int = 1):
    """``(albedo (n, 3), roughness (n,), specular (n, 3))`` of all kinds."""
    u = torch.rand(n, 7, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return u[:, :3], 0.15 + 0.85 * u[:, 3], 0.04 + 0.9 * u[:, 4:]


@pytest.mark.parametrize("retro", [None, 0.0, 0.7])
def test_light_at_the_camera_is_the_collocated_formula(retro):
    """Term by term: light weight times what points scatter back, whatever the sample's normal and depth."""
    n = 2000
    u = torch.rand(n, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    d, t, light = directions(n), 2 + 2 * u[:, 0], torch.tensor([[30.0, 20.0, 10.0]]).double().expand(n, 3)
    camera = torch.tensor([[0.4, -0.3, 3.0]]).double()
    x, optical = camera + t[:, None] * d, Optical(0.01 + 3 * u[:, 1], 5 * u[:, 2])
    reflectance = directions(n, 3), *materials(n)
    lamp = shots.flash(camera, TransmittanceTargets())
    actual = lamp.send(optical, reflectance, d, x, torch.zeros(n).long(), light, retro)
    _, v = optical.weights()
    expected = v[:, None] * volume.shade(reflectance, d, t, light, retro)
    assert 0.4 < float((expected > 0).any(1).double().mean()) < 0.6, "what faces the camera, and what does not"
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-15)


class Skin:
    """A half space below z = 0, of a density that goes up and down, and one reflectance."""

    def __init__(self, roughness: float, specular: float, retro: float | None):
        self.gloss, self.retro, self.fresnel = (roughness, specular), retro, retro is not None
        self.tail = None
        self.phase = None

    def log_density(self, x):
        return torch.where(x[:, 2] < 0, 6 + torch.sin(900 * x[:, 2]) - 200 * x[:, 2].abs() * (x[:, 2] < -0.01), -12.0)

    def reflectance(self, x):
        roughness, specular = (torch.full((len(x),), v) for v in self.gloss)
        normal, albedo = (torch.tensor(v).expand(len(x), 3) for v in ([0.0, 0.0, 1.0], [0.7, 0.5, 0.2]))
        return Reflectance(normal, albedo, roughness, specular[:, None])


def toward(degrees: float) -> np.ndarray:
    return np.array([np.sin(np.radians(degrees)), 0.0, np.cos(np.radians(degrees))])


def surface(wi, wo, roughness, specular, retro) -> np.ndarray:
    """ρ ⟨n,ω_i⟩ (3,) of the surface z = 0 of that reflectance, as the renderers have it, float64."""
    n = np.array([0.0, 0.0, 1.0])
    diffuse, gloss = microfacet.lobes(numpy_ops, wi, wo, n, roughness)
    a, b = fresnel.weights(numpy_ops, wi, wo, n, roughness, specular, retro)
    return np.float32([0.7, 0.5, 0.2]) * a * diffuse + b * gloss


@pytest.mark.parametrize("retro", [None, 0.0, 0.7])
@pytest.mark.parametrize(("roughness", "specular"), [(0.9, 0.0), (0.3, 0.6), (0.5, 1.0)])
def test_an_opaque_skin_lit_from_aside_is_its_surface(roughness, specular, retro):
    """ρ ⟨n,ω_i⟩ I/d², from all sides and of any profile (Lommel and Seeliger), however coarse the cells are."""
    power = torch.tensor([30.0, 20.0, 10.0])
    for viewer, light in ANGLES:
        wi, wo = toward(light), toward(viewer)
        place = torch.as_tensor(3 * wi[None], dtype=torch.float32)
        for cells in (20, 3000):
            o, d = (torch.as_tensor(s * wo[None], dtype=torch.float32) for s in (4, -1))
            # The skin is 0.05 deep; no cell begins before it, so that none of them is in it in part.
            width = 0.05 / cells / wo[2]
            t = 4 + width * (torch.arange(cells) + 0.5)
            batch = rays.Rays(o, d, torch.tensor([3.0]), torch.tensor([5.0]), torch.zeros(1, 4), power[None],
                              torch.zeros(1).long())
            image = volume.render(Skin(roughness, specular, retro), batch, (torch.zeros(cells).long(), t, torch.full(
                (cells,), width)), flash=shots.flash(place, TransmittanceTargets()))
            expected = surface(wi, wo, roughness, specular, retro) * power.numpy() / 9
            # Light that comes back from down to 0.02 sees other angles and distances: sharp lobes most.
            np.testing.assert_allclose(image.color[0], expected, rtol=0.03, err_msg=f"{viewer}, {light}, {cells}")


@pytest.mark.parametrize("retro", [None, 0.0, 0.7])
def test_a_thin_skin_is_the_integral_over_its_depth(retro):
    """L = ∫ e^{−τ/c_o − τ/c_i} f dτ/c_o · I/d² with the renderer's phase function f, by quadrature."""
    edges = np.linspace(0, 0.8, 20001)  # optical depth along the normal
    tau = (edges[1:] + edges[:-1]) / 2
    for viewer, light in ANGLES:
        wi, wo = toward(light), toward(viewer)
        n, albedo, roughness, specular = np.array([0.0, 0, 1]), 0.4, 0.4, 0.3
        diffuse, gloss = microfacet.scattering(numpy_ops, wi, wo, n, roughness)
        a, b = fresnel.weights(numpy_ops, wi, wo, n, roughness, specular, retro)
        lost = np.exp(-tau / wo[2] - tau / wi[2]).sum() * edges[1] / wo[2]
        expected = (a * albedo * diffuse + b * gloss) * lost * 5 / 2**2
        # Cells of unequal depths.
        places = np.sort(np.random.default_rng(0).uniform(0, 0.8, 30))
        places = np.concatenate([[0], places, [0.8]]) / wo[2]
        optical = Optical(*(torch.as_tensor(v) for v in (np.diff(places), places[:-1])))
        one = torch.ones(31).double()
        row = {"n": n, "wo": wo, "wi": wi}
        row = {k: torch.as_tensor(v).expand(31, 3) for k, v in row.items()}
        reflectance = row["n"], albedo * one[:, None].expand(31, 3), roughness * one, specular * one[:, None]
        actual = shots.flash(torch.as_tensor(2 * wi[None]), TransmittanceTargets()).send(
            optical, reflectance, -row["wo"], torch.zeros(31, 3).double(), torch.zeros(31).long(),
            5 * one[:, None].expand(31, 3), retro)
        np.testing.assert_allclose(actual.sum(0), expected, rtol=1e-6)  # of the quadrature


def test_nothing_is_sent_from_below():
    """Light under the horizon, and skins that are seen from behind."""
    n = 300
    d, normal = directions(n, 5), directions(n, 6)
    lamp = shots.flash(directions(1, 7) * 3, TransmittanceTargets())
    optical = Optical(torch.full((n,), 0.5).double(), torch.zeros(n).double())
    wi, _ = lamp.toward(torch.zeros(n).long(), torch.zeros(n, 3).double())
    actual = lamp.send(optical, (normal, *materials(n)), d, torch.zeros(n, 3).double(), torch.zeros(n).long(),
                      torch.ones(n, 3).double(), None)
    both = ((normal * wi).sum(1) > 0) & ((normal * -d).sum(1) > 0)
    assert (actual[both] > 0).all() and (actual[~both] == 0).all() and 30 < int(both.sum()) < n - 30


def test_gradients():
    """A matt point gets brighter as its normal turns to the light, by albedo/π · I/d² times its own weight; not as what
    its skin has for depths changes with the normal. Matter itself shines more, and hides what is behind."""
    n = 50
    normal = F.normalize(directions(n, 8) + torch.tensor([0.0, 0, 2]), dim=1).requires_grad_()
    depth, front = (torch.full((n,), v, dtype=torch.float64, requires_grad=True) for v in (0.3, 0.4))
    lamp = shots.flash(torch.tensor([[1.0, 0.5, 3.0]]).double(), TransmittanceTargets())
    wi, distance = lamp.toward(torch.zeros(n).long(), torch.zeros(n, 3).double())
    albedo, one = torch.full((n, 3), 0.6, dtype=torch.float64), torch.ones(n).double()
    d = torch.tensor([[0.0, 0, -1]]).double().expand(n, 3)
    sent = lamp.send(Optical(depth, front), (normal, albedo, one, 0 * one[:, None]), d, torch.zeros(n, 3).double(),
                     torch.zeros(n).long(), 7 * one[:, None].expand(n, 3), None)
    sent[:, 0].sum().backward()
    cos_i, cos_o = ((normal.detach() * v).sum(1) for v in (wi, -d))
    assert float(cos_i.min()) > flash.LEAST_COSINE < float(cos_o.min())
    r = 1 + cos_o / cos_i
    weight = torch.exp(-r * 0.4) * -torch.expm1(-r * 0.3)
    np.testing.assert_allclose(normal.grad, (weight * 0.6 / np.pi * 7)[:, None] * wi / distance**2, rtol=1e-9)
    size = 0.6 / np.pi * 7 * cos_i / distance[:, 0] ** 2
    np.testing.assert_allclose(depth.grad, size * r * torch.exp(-r * 0.7), rtol=1e-6)
    np.testing.assert_allclose(front.grad, -size * r * weight, rtol=1e-6)
    # A highlight: brighter towards the half vector.
    normal = F.normalize(wi - d + 0.1 * directions(n, 9), dim=1).requires_grad_()
    lamp.send(Optical(depth, front), (normal, 0 * albedo, 0.5 * one, one[:, None]), d,
              torch.zeros(n, 3).double(), torch.zeros(n).long(), one[:, None].expand(n, 3), None).sum().backward()
    half = F.normalize(wi - d, dim=1)
    across = half - (half * normal.detach()).sum(1, keepdim=True) * normal.detach()
    assert ((normal.grad * across).sum(1) > 0).all()


def test_places_are_right_up_and_forward_of_the_lenses():
    """Positions are those of all splits, in field coordinates, also where these are not the world's."""
    offset, center, radius = (0.3, -0.2, 0.5), np.array([1.0, -2.0, 0.5]), 1.7
    c2w = shots.around(5, 6.0)
    c2w[:, :3, 3] += center
    blank = np.zeros((5, 2, 2, 4), np.uint8)
    options = {"center": center, "radius": radius}
    first = shots.photographs(blank[:3], c2w=c2w[:3], offset=offset, **options)
    second = shots.photographs(blank[3:], c2w=c2w[3:], first=3, **options)
    lamp = flash.Flash([first, second], True, TransmittanceTargets())
    truth = ((c2w @ (0.3, -0.2, -0.5, 1.0))[:, :3] - center) / radius
    lenses = (c2w[:, :3, 3] - center) / radius
    np.testing.assert_allclose(lamp.place, np.concatenate([truth[:3], lenses[3:]]), atol=1e-6)
    assert not first.on_lens and second.on_lens
    actual = lamp.places(torch.tensor(offset) / radius)
    np.testing.assert_allclose(actual, truth, atol=1e-6)
    np.testing.assert_allclose(lamp.places(torch.zeros(3)), lenses, atol=1e-6)
    np.testing.assert_allclose(lamp.place[3:], lenses[3:], atol=1e-6)  # nothing moved so far
    lamp.move(torch.tensor(offset) / radius)
    assert torch.equal(lamp.place, actual)
    x = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.0, 0.0]])
    wi, distance = lamp.toward(torch.tensor([4, 1]), x)
    np.testing.assert_allclose(x.numpy() + (distance * wi).numpy(), truth[[4, 1]], atol=1e-6)


CENTRE, RADIUS = np.array([0.2, -0.1, 0.15]), 0.3
LAMPS = torch.tensor([[0.5, 0.3, 3.0], [-0.4, 0.0, -0.5]])
"""A far lamp, and one within the unit sphere."""


def ball(log_sigma: float) -> TransmittanceTargets:
    """A ball of that density, in a grid [z, y, x] as it is baked."""
    k = 128
    axis = (np.arange(k) + 0.5) * (2 / k) - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    inside = ((np.stack([x, y, z], -1) - CENTRE) ** 2).sum(-1) < RADIUS**2
    actual = TransmittanceTargets()
    actual.log_sigma = torch.as_tensor(np.where(inside, log_sigma, -12.0)[None, None], dtype=torch.float32)
    actual.reach = 1.0
    return actual


def way(x: np.ndarray, lamp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(nearest, through)``: how near the ways from `x` (n, 3) to `lamp` (3,) come to the ball's centre, and how much
    of them is in it."""
    path = lamp - x
    length = np.linalg.norm(path, axis=1)
    path /= length[:, None]
    middle = ((CENTRE - x) * path).sum(1)
    at = middle.clip(0, length)
    nearest = np.linalg.norm(x + at[:, None] * path - CENTRE, axis=1)
    half = np.sqrt((RADIUS**2 - ((x + middle[:, None] * path - CENTRE) ** 2).sum(1)).clip(0))
    return nearest, ((middle + half).clip(0, length) - (middle - half).clip(0, length)).clip(0)


def test_shadow_and_light_are_where_an_opaque_ball_puts_them():
    rng = np.random.default_rng(0)
    x = rng.uniform(-0.55, 0.55, (4000, 3))
    x = x[np.linalg.norm(x - CENTRE, axis=1) > RADIUS + 0.04]
    lamp = shots.flash(LAMPS, ball(6.0))
    for number in (0, 1):
        actual = lamp.reaching(torch.full((len(x),), number), torch.as_tensor(x, dtype=torch.float32)).numpy()
        nearest, _ = way(x, LAMPS[number].numpy().astype(float))
        # Voxels of 1/64 smear the ball's retro.
        shadow, light = nearest < RADIUS - 0.025, nearest > RADIUS + 0.025
        assert shadow.sum() > 100 and light.sum() > 1000
        assert (actual[shadow] < 0.01).all(), actual[shadow].max()
        assert (actual[light] > 0.999).all(), actual[light].min()
    unknown = shots.flash(LAMPS, TransmittanceTargets())
    assert (unknown.reaching(torch.zeros(9).long(), torch.zeros(9, 3)) == 1).all()


def test_a_skin_is_lit_from_outside_of_its_own_matter():
    """On the ball itself light comes to the side that faces it, and is lost in its matter."""
    normal = directions(2000, 4).float()
    x = torch.as_tensor(CENTRE).float() + (RADIUS - 0.005) * normal
    lamp, view = shots.flash(LAMPS, ball(6.0)), torch.zeros(2000).long()
    actual = lamp.lit(view, x, 0.3 * normal)  # mean normals are shorter than 1
    cos = (normal * lamp.toward(view, x)[0]).sum(1)
    # At grazing angles the lift of 0.02 is not out of voxels of 1/64, and on the other side goes past them.
    assert (actual[cos > 0.45] > 0.99).all(), actual[cos > 0.45].min()
    assert (actual[cos < -0.5] < 0.01).all(), actual[cos < -0.5].max()
    assert float(lamp.reaching(view, x - 0.015 * normal)[cos > 0.45].mean()) < 0.5
    assert (shots.flash(LAMPS, ball(6.0), solid=False).lit(view, x, normal) == 1).all()


@pytest.mark.parametrize("thick", [0.002, 0.01, 0.03])
def test_thick_skins_do_not_shade_themselves(thick):
    """ln σ of early fields rises slowly: from 0 to 4 over some 0.01 to 0.1 here. What the camera sees of such a ball,
    at the optical depth 0.7, is lit all the same where light falls in steeply, and dark on the other side."""
    k = 128
    axis = (torch.arange(k) + 0.5) * (2 / k) - 1
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    radius = (torch.stack([x, y, z], -1) - torch.as_tensor(CENTRE).float()).norm(dim=-1)
    marched = TransmittanceTargets()
    marched.log_sigma = ((RADIUS - radius) / thick).clamp(-12, 4)[None, None]
    normal = directions(500, 12).float()
    o = torch.as_tensor(CENTRE).float() + 2 * normal
    t, _ = walk(marched, o, -normal, 0.7)
    at = o - t[:, None] * normal
    lamp, view = shots.flash(LAMPS, marched), torch.zeros(500).long()
    cos = (normal * lamp.toward(view, at)[0]).sum(1)
    actual = lamp.lit(view, at, normal)
    # What is left above the place where the ray begins: σ over its logarithm's slope, of the highest lift if need be.
    rest = max(flash.CLEAR * thick, 0.7 * np.exp(-flash.LIFTS[-1] / thick)) / 0.6
    assert float(actual[cos > 0.6].min()) > np.exp(-1.1 * rest) > 0.83 and float(actual[cos < -0.6].max()) < 0.03
    places = flash.above(marched, at, normal)
    height = ((places - at) * normal).sum(1)
    np.testing.assert_allclose(places, at + height[:, None] * normal, atol=1e-6)
    levels = torch.tensor(flash.LIFTS)
    nearest = (height[:, None] - levels).abs().min(1)
    assert float(nearest.values.max()) < 1e-5
    # The first that is out of matter: the one before is in it.
    depth = ((RADIUS - (at - torch.as_tensor(CENTRE).float()).norm(dim=1))[:, None] - levels) / thick
    clear = depth < np.log(flash.CLEAR)
    target = torch.where(clear.any(1), clear.to(torch.uint8).argmax(1), len(levels) - 1)
    # ln σ between voxels of 1/64 is not that of the radius.
    assert float((nearest.indices == target).float().mean()) > 0.8
    assert float((nearest.indices - target).abs().max()) <= 1


def test_points_in_smoke_are_lit_one_by_one():
    """Each behind its own depth towards the light, of e^−σ·length, times the renderer's phase function."""
    sigma, n = 3.0, 500
    rng = np.random.default_rng(1)
    x = CENTRE + 0.9 * RADIUS * rng.uniform(-0.55, 0.55, (n, 3))
    lamp = shots.flash(LAMPS, ball(np.log(sigma)), solid=False)
    view = torch.as_tensor(rng.integers(2, size=n))
    length = np.where(view, way(x, LAMPS[1].numpy().astype(float))[1], way(x, LAMPS[0].numpy().astype(float))[1])
    tx = torch.as_tensor(x, dtype=torch.float32)
    # At the end of the way ln σ falls to nothing over a voxel of 1/64, of which the most is lost, and half a step.
    np.testing.assert_allclose(lamp.reaching(view, tx), np.exp(-sigma * length), rtol=0.06)
    normal, d = directions(n, 10).float(), directions(n, 11).float()
    albedo, roughness, specular = (v.float() for v in materials(n))
    optical = Optical(torch.full((n,), 0.2), torch.full((n,), 0.7))
    light = torch.full((n, 3), 6.0)
    actual = lamp.send(optical, (normal, albedo, roughness, specular), d, tx, view, light, None)
    path = LAMPS[view].numpy() - x
    distance = np.linalg.norm(path, axis=1)
    wi, wo, m = ((v / np.linalg.norm(v, axis=1, keepdims=True)).T for v in (path, -d.numpy(), normal.numpy()))
    diffuse, gloss = microfacet.scattering(numpy_ops, tuple(wi), tuple(wo), tuple(m), roughness.numpy())
    lobe = (1 - specular.numpy()) * diffuse[:, None] * albedo.numpy() + specular.numpy() * gloss[:, None]
    weight = np.exp(-0.7) * (1 - np.exp(-0.2)) * np.exp(-sigma * length) * 6 / distance**2
    np.testing.assert_allclose(actual, weight[:, None] * lobe, rtol=0.06, atol=1e-6)

"""The paper's recipe: its sampler against known weights, its losses, and whole runs of a shrunken one."""

import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import two_spheres  # noqa: E402

from mi_ntf.core import field_file  # noqa: E402
from mi_ntf.core.architecture import FAST, PAPER, VISIBILITY, Architecture, Encoding, Network  # noqa: E402
from mi_ntf.core.errors import MiNtfError  # noqa: E402
from mi_ntf.train import config, hierarchical, losses, scoring, train, trainer  # noqa: E402
from mi_ntf.train.networks import Reflectance  # noqa: E402
from mi_ntf.train.rays import Rays, sphere_span  # noqa: E402

NETWORK = Network(Encoding("frequency", octaves=3), (32, 32))
SMALL = dataclasses.replace(config.PRESETS["paper"], architecture=Architecture(NETWORK, NETWORK, NETWORK), coarse=16,
                            fine=16, images=4, patch=8, random_rays=32, lr=3e-3, cells=16, step=1 / 20)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return two_spheres.write(tmp_path_factory.mktemp("spheres"), {"train": 8, "val": 1, "test": 1}, size=16)


def run(photographs, out, steps=40, settings=SMALL):
    torch.set_num_threads(1)
    return trainer.Trainer(photographs, out, settings, "paper", steps=steps, seed=3)


def test_the_preset_is_the_papers():
    paper = config.PRESETS["paper"]
    assert paper.architecture is PAPER and config.PRESETS["fast"].architecture is FAST
    assert (paper.coarse, paper.fine, paper.images, paper.patch, paper.random_rays, paper.lr) == (64, 128, 4, 16, 128,
                                                                                                 2e-5)
    shapes = PAPER.skeleton()
    assert len(shapes) == 3 * 2 * 9, "eight hidden layers each, and the outputs"
    for name, inputs, outputs in (("density", 63, 1), ("reflectance", 63, 8), ("transmittance", 126, 2)):
        weights = [shapes[f"{name}.layers.{i}.weight"] for i in range(9)]
        assert weights == [(256, inputs), *[(256, 256)] * 7, (outputs, 256)]


def test_draw_at_known_places():
    """Weights 0, 1, 3, 0 on quarters of [0, 1]: a quarter of the samples in the second, the rest in the third."""
    u = torch.tensor([[0.0, 0.125, 0.25, 0.625, 0.9985]])
    actual = hierarchical.inverse_cdf(torch.tensor([[0.0, 1.0, 3.0, 0.0]]), u)
    # Every cell gets a weight of 1e-5 besides, which moves shares by as much.
    np.testing.assert_allclose(actual[0, 1:], [0.375, 0.5, 0.625, 0.7495], atol=1e-4)
    even = hierarchical.inverse_cdf(torch.zeros(1, 4), u)
    np.testing.assert_allclose(even, u, atol=1e-6)  # float32


def test_draw_follows_the_weights():
    """χ² of uniform u in 8 cells: 7 degrees of freedom, 24.3 is exceeded once in a thousand (the seed is fixed)."""
    weight = torch.tensor([0.5, 2.0, 0.1, 1.0, 4.0, 0.3, 0.02, 1.5])
    n = 20000
    u = torch.rand(1, n, generator=torch.Generator().manual_seed(0))
    counts = torch.histc(hierarchical.inverse_cdf(weight[None], u)[0], 8, 0, 1)
    expected = n * weight / weight.sum()
    assert float(((counts - expected) ** 2 / expected).sum()) < 24.3


class Slab:
    """σ = 8 where z > 0, else 0; Lambertian, facing −z."""

    fresnel = False
    retro = tail = None
    phase = None

    def log_density(self, x):
        return torch.where(x[:, 2] > 0, float(np.log(8.0)), -12.0)

    def reflectance(self, x):
        one = torch.ones(len(x))
        normal = torch.tensor([0.0, 0.0, -1.0]).expand(len(x), 3)
        return Reflectance(normal, one[:, None].expand(-1, 3) / 2, one, 0 * one[:, None])


def test_view_of_a_half_space():
    """Fine samples lie where light is lost; τ back to the camera is e^{−8 z}, alpha 1 − e^{−8 h}."""
    n = 50
    o, d = torch.tensor([0.2, 0.0, -3.0]).expand(n, 3), torch.tensor([0.0, 0.0, 1.0]).expand(n, 3)
    t0, t1 = sphere_span(o, d)
    rays = Rays(o, d, t0, t1, torch.zeros(n, 4), torch.ones(n, 3), torch.zeros(n, dtype=torch.long))
    rendered = hierarchical.view(Slab(), Slab(), rays, (64, 128), torch.Generator().manual_seed(0))
    assert rendered.t.shape == (n, 192) and (rendered.t.diff(dim=1) >= 0).all()
    assert (rendered.t >= t0[:, None]).all() and (rendered.t <= t1[:, None] + 1e-5).all()
    z = rendered.t - 3
    expected = torch.exp(-8 * z.clamp(min=0))
    # The front is an edge of the coarse cells (of 1/32): in the middle between a fine sample right behind it and the
    # coarse one before it, σ begins up to 1/64 too early.
    assert float((rendered.tau - expected).abs().max()) < 1 - np.exp(-8 / 64)
    # 64 coarse samples, 31 of them in front; of the fine ones, all but the first coarse cell's lie behind.
    assert 31 <= float((z < 0).float().sum(1).mean()) < 31 + 128 * 8 / 32
    np.testing.assert_allclose(rendered.fine.alpha, 1 - np.exp(-8 * np.sqrt(1 - 0.04)), rtol=1e-3)
    # ∫ e^{−16 z} 8 dz = 1/2 at t ≈ 3: SURFACE · 1/2 · albedo/π / t², within the front's error and the spread of t
    np.testing.assert_allclose(rendered.fine.color.mean(0), 0.5 / np.pi / 3.06**2, rtol=0.03)


def test_gradients_of_the_transmittance_loss_stay_in_its_network(photographs, tmp_path):
    recipe = run(photographs, tmp_path / "f").recipe
    batch = recipe.patches()
    rendered = hierarchical.view(recipe.coarse, recipe.networks, batch, (16, 16), recipe.generator)
    terms = recipe.ntf_loss(rendered, batch, batch.target[:, :3])
    assert set(terms) == {"transmittance", "lit colour"}
    for term in terms.values():
        grown = torch.autograd.grad(term, list(recipe.parameters().values()), retain_graph=True, allow_unused=True)
        for name, gradient in zip(recipe.parameters(), grown, strict=True):
            if name.startswith("transmittance"):
                assert gradient.abs().sum() > 0, name
            else:
                assert gradient is None, name


def test_transmittance_learns_from_a_field(photographs, tmp_path):
    """The loss falls to less than half if the same batch is repeated."""
    recipe = run(photographs, tmp_path / "f").recipe
    rays = recipe.random_rays()
    with torch.no_grad():
        rendered = hierarchical.view(recipe.coarse, recipe.networks, rays, (16, 16), recipe.generator)
    values = [recipe.learner.descend("ntf", recipe.ntf_loss(rendered, rays, rendered.fine.color)["transmittance"], 1.0)
              for _ in range(60)]
    assert values[-1] < 0.5 * values[0]


def test_patches_and_random_rays(photographs, tmp_path):
    recipe = run(photographs, tmp_path / "f").recipe
    batch = recipe.patches()
    assert len(batch) == 4 * 8 * 8
    origins = batch.o.view(4, 64, 3)
    assert (origins == origins[:, :1]).all() and len(origins[:, 0].unique(dim=0)) == 4, "four photographs"
    neighbours = batch.d.view(4, 8, 8, 3)
    assert float(neighbours.diff(dim=1).norm(dim=-1).max()) < 2 * 0.62 / 16, "squares of adjacent pixels"
    rays = recipe.random_rays()
    assert len(rays) == 32
    for t in (rays.t0, rays.t1):
        np.testing.assert_allclose((rays.o + t[:, None] * rays.d).norm(dim=1), 1, atol=1e-5)  # float32 at distance 3


def test_a_short_run_learns_and_is_written(photographs, tmp_path, monkeypatch):
    monkeypatch.setitem(config.PRESETS, "paper", SMALL)
    history = []
    advance = hierarchical.Hierarchical.advance

    def recorded(recipe):
        value = advance(recipe)
        history.append({k: float(v.detach()) for k, v in recipe.learner.terms.items()})
        return value

    monkeypatch.setattr(hierarchical.Hierarchical, "advance", recorded)
    monkeypatch.setattr(scoring, "CELLS", 32)  # of 128³: seconds
    report = train(photographs, tmp_path / "f", preset="paper", steps=120)
    terms = ("coarse colour", "colour", "transmittance", "lit colour", "random transmittance", "random lit colour")
    assert set(history[0]) == set(terms)
    for name in terms:
        first, last = (np.mean([h[name] for h in part]) for part in (history[:15], history[-15:]))
        if name in terms[:2]:  # the others chase the field, which begins as a mist that is easy to learn
            assert last < 0.6 * first, (name, first, last)
    header, tensors = field_file.load(tmp_path / "f")
    assert header.architecture == SMALL.architecture and not any("coarse" in name for name in tensors)
    assert report["kept"] in report["history"] and report["test"]["srgb"] > 8, report
    json.dumps(report)
    assert {p.name for p in tmp_path.iterdir()} == {"f", "f.html"}


def test_a_checkpoint_continues_the_run(photographs, tmp_path):
    """Coarse networks and their moments included: the same losses after it as without it."""
    first = run(photographs, tmp_path / "f", 8)
    for _ in range(3):
        step(first)
    first.keep()
    first.save()
    expected = [step(first) for _ in range(3)]
    second = run(photographs, tmp_path / "f", 8)
    second.resume()
    assert second.clock.step == 3 and [step(second) for _ in range(3)] == expected


def step(run):
    value = run.recipe.advance()
    run.clock.step += 1
    return value


def test_a_network_that_reads_baked_densities_is_refused(photographs, tmp_path):
    with pytest.raises(MiNtfError, match="the paper's recipe bakes no density, which this --ntf reads"):
        train(photographs, tmp_path / "f", preset="paper", ntf="mixture2", steps=1)


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_the_baselines_network_learns_beside_and_is_stored(photographs, tmp_path, monkeypatch, preset):
    """Its error falls in some steps."""
    two_spheres.coarsen(monkeypatch)
    monkeypatch.setitem(config.PRESETS, "paper", SMALL)
    torch.set_num_threads(1)
    settings = config.configured(preset, visibility_mlp=True)
    if preset == "fast":
        settings = dataclasses.replace(settings, ntf_from=0.2, ntf_alone=0.5)
    run = trainer.Trainer(photographs, tmp_path / "f", settings, preset, steps=20, seed=3)
    recipe, learner = run.recipe, run.learner
    values = []
    recipe.carve()
    while run.clock.progress < 0.8:
        step(run)
        if "visibility" in learner.terms:
            values.append(float(learner.terms["visibility"].detach()))
    if preset == "fast":  # its steps see other rays each: the same ones, then
        o, d = losses.training_rays(recipe.marched, recipe.sample_rays(2000, run.generator), 128, True, run.generator)
        rays = losses.targets(recipe.marched, o, d, run.generator)
        assert values
        values = [learner.descend("ntf", losses.visibility(recipe.networks, rays), 1.0) for _ in range(80)]
    assert values[-1] < 0.8 * values[0], values
    two_spheres.glance(monkeypatch)
    run.finish()
    header, tensors = field_file.load(tmp_path / "f")
    assert header.architecture.visibility == VISIBILITY
    np.testing.assert_array_equal(tensors["visibility.layers.0.weight"],
                                  recipe.networks.tensors["visibility.layers.0.weight"].detach().numpy())

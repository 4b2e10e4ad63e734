"""Exposure and white balance of photographs: gains that are known, and pixels that must not count."""

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import shots  # noqa: E402

from mi_ntf.data.images import LINEAR, levels  # noqa: E402
from mi_ntf.train import photometry  # noqa: E402
from mi_ntf.train.photometry import Gains, fitted, trust  # noqa: E402

VIEWS, SIDE = 6, 12
FACTORS = 2 ** np.random.default_rng(3).uniform(-1, 1, (VIEWS, 3))
RELATIVE = FACTORS / np.exp(np.log(FACTORS).mean(0))
"""The same of geometric mean 1."""


def toy(albedo, rows=slice(3, 9), kind="float32", **options):
    """An object of that `albedo` (…, 3) in some rows of photographs with those factors, before a bright background that
    belongs to nothing."""
    pictures = np.zeros((VIEWS, SIDE, SIDE, 4))
    pictures[..., 3], pictures[..., :3] = 0.4 * ("masked" not in options), 0.9
    pictures[:, rows] = 1
    pictures[:, rows, :, :3] = albedo * FACTORS[:, None, None]
    return shots.photographs(levels(pictures) if kind == "uint8" else pictures.astype(kind), **options)


@pytest.mark.parametrize(("kind", "tolerance"), [("float32", 1e-5), ("float16", 2e-3), ("uint8", 0.05)])
def test_gains_start_at_the_brightness_of_the_object(kind, tolerance):
    """Which is right where all photographs see the same; the background does not count. Levels of 0.05 are 3 %
    apart."""
    for options in ({}, {"masked": False}):
        actual = Gains(toy((0.3, 0.2, 0.1), kind=kind, first=4, **options))
        np.testing.assert_allclose(actual.all().detach(), RELATIVE, rtol=tolerance)
        subset = torch.tensor([9, 4, 4])
        assert torch.equal(actual(subset), actual.all()[[5, 0, 0]])


def test_gains_have_the_geometric_mean_1_whatever_their_parameters():
    actual = Gains(toy((0.3, 0.2, 0.1)))
    generator = torch.Generator().manual_seed(0)
    for _ in range(5):
        with torch.no_grad():
            actual.logs.copy_(5 * torch.randn(VIEWS, 3, generator=generator) + 2)
        np.testing.assert_allclose(actual.all().detach().log().mean(0), 0, atol=1e-6)
    before = actual.all().detach()
    with torch.no_grad():
        actual.logs += torch.tensor([3.0, -1.0, 0.5])
    torch.testing.assert_close(actual.all().detach(), before, rtol=1e-5, atol=0)
    assert actual.logs.requires_grad and actual.all().requires_grad


def test_a_photograph_without_the_object_starts_at_1():
    pool = toy((1.0, 1.0, 1.0))
    pool.stored.view(VIEWS, SIDE, SIDE, 4)[2] = 0
    logs = np.log(FACTORS)
    logs[2] = 0
    np.testing.assert_allclose(Gains(pool).all().detach(), np.exp(logs - logs.mean(0)), rtol=1e-5)


def test_gains_are_learned_where_photographs_show_other_parts():
    """Each shows 6 of 12 rows whose albedos differ tenfold: their means are wrong, and descent finds the factors, up to
    the one that photographs do not know."""
    generator = torch.Generator().manual_seed(0)
    albedo = 0.05 * 10 ** torch.rand(SIDE, 3, generator=generator)
    pictures = np.zeros((VIEWS, SIDE, SIDE, 4), np.float32)
    for number, picture in enumerate(pictures):
        rows = (2 * number + np.arange(6)) % SIDE
        picture[rows] = 1
        picture[rows, :, :3] = albedo[rows, None] * torch.as_tensor(FACTORS[number]).float()
    pool = shots.photographs(pictures)
    gains, learned = Gains(pool), torch.nn.Parameter(torch.full((SIDE, 3), -1.0))
    assert np.abs(gains.all().detach().numpy() / RELATIVE - 1).max() > 0.3
    index = (pool.stored[:, 3] > 0).nonzero()[:, 0]
    rays = pool[index]
    row = index % SIDE**2 // SIDE
    descent = torch.optim.LBFGS([gains.logs, learned], max_iter=200, line_search_fn="strong_wolfe")

    def loss():
        descent.zero_grad()
        value = (gains(rays.view) * learned[row].exp() / rays.target[:, :3] - 1).square().mean()
        value.backward()
        return value.detach()

    descent.step(loss)
    np.testing.assert_allclose(gains.all().detach().numpy(), RELATIVE, rtol=0.01)


def test_factors_of_held_back_photographs_are_least_squares():
    generator = torch.Generator().manual_seed(0)
    predicted, factors = torch.rand(500, 3, generator=generator), torch.tensor([0.5, 1.3, 2.0])
    noisy = 0.4 * predicted * factors + 0.05 * torch.randn(500, 3, generator=generator)
    expected = [np.linalg.lstsq(p[:, None], t, rcond=None)[0][0] for p, t in zip(predicted.T.numpy(), noisy.T.numpy(),
                                                                                 strict=True)]
    np.testing.assert_allclose(fitted(predicted, noisy), expected, rtol=1e-5)
    # What is cut at white tells nothing; with it the factors come out too small.
    target = (predicted * factors).clamp(max=1.0)
    assert 0.4 < float((target[:, 2] == 1).float().mean()) < 0.6
    target = torch.where(target > photometry.SATURATED, 1.0, target)
    torch.testing.assert_close(fitted(predicted, target), factors)
    assert float((predicted * target)[:, 2].sum() / predicted[:, 2].square().sum()) < 1.5
    # By channel: red stays exact where only blue is saturated.
    target[:, 2] = 1
    actual = fitted(predicted, target)
    torch.testing.assert_close(actual[:2], factors[:2])
    assert actual.isfinite().all()


def test_what_levels_count():
    """Channels one by one: white nothing where the prediction is brighter still, nearly black on the object a quarter.
    """
    white, nearly, black, dim = (float(LINEAR[v]) for v in (250, 249, 2, 3))
    cases = [  # predicted, target, alpha, counts
        (1.5, 1.0, 1, 0.0), (white + 1e-3, white, 1, 0.0), (white, white, 1, 1.0), (0.5, 1.0, 1, 1.0),
        (1.5, nearly, 1, 1.0), (1.5, 1.0, 0, 0.0),
        (0.5, black, 1, 0.25), (0.0, 0.0, 1, 0.25), (0.5, black, 0.6, 0.25), (0.5, black, 0.4, 1.0), (0.5, 0.0, 0, 1.0),
        (0.5, dim, 1, 1.0),
    ]
    for place in range(3):
        predicted, target = torch.full((len(cases), 3), 0.5), torch.full((len(cases), 4), 0.5)
        expected = np.ones((len(cases), 3))
        for row, (have, want, alpha, counts) in enumerate(cases):
            predicted[row, place], target[row, place], target[row, 3], expected[row, place] = have, want, alpha, counts
        predicted.requires_grad_()
        actual = trust(predicted, target)
        np.testing.assert_array_equal(actual, expected)
        assert not actual.requires_grad

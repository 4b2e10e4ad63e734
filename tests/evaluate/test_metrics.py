"""Metrics against hand-computed values and slow loops."""

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import metrics


@pytest.fixture
def reference():
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 1.5, (32, 24, 3))
    image[:12] = 0
    return image


def test_srgb_curve_at_known_points_and_back():
    # IEC 61966-2-1: 18 % grey is 0.4613561, the linear part has slope 12.92.
    np.testing.assert_allclose(metrics.srgb(np.array([-1, 0, 0.001, 0.18, 1, 9])), [0, 0, 0.01292, 0.4613561, 1, 1],
                               atol=1e-7)
    x = np.linspace(0, 1, 101)
    np.testing.assert_allclose(metrics.linear(metrics.srgb(x)), x, atol=1e-7)  # the standard's rounded constants


def test_relative_rmse_by_hand(reference):
    assert metrics.relative_rmse(1.05 * reference, reference) == pytest.approx(0.05)
    a, b = np.zeros((2, 2, 3)), np.full((2, 2, 3), 2.0)
    b[0, 0] = 0
    assert metrics.relative_rmse(a, b) == pytest.approx(1)
    with pytest.raises(MiNtfError, match="reference is black everywhere"):
        metrics.relative_rmse(b, a)


def test_psnr_and_max_abs_by_hand(reference):
    assert metrics.psnr(reference, reference) == np.inf
    grey = metrics.linear(np.full((4, 4, 3), 0.5))
    assert metrics.psnr(metrics.linear(np.full((4, 4, 3), 0.6)), grey) == pytest.approx(20, abs=1e-5)
    assert metrics.psnr(grey + 10, np.ones_like(grey)) == np.inf  # clipped alike
    spot = reference.copy()
    spot[20, 3, 1] -= 0.7
    assert metrics.max_abs(spot, reference) == pytest.approx(0.7)


def test_ssim_equals_the_definition_of_wang_2004(reference):
    image = np.clip(reference + np.random.default_rng(1).normal(0, 0.1, reference.shape), 0, None)
    a, b = metrics.srgb(image), metrics.srgb(reference)
    g = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(g, g) / np.outer(g, g).sum()
    values = []
    for y in range(5, 32 - 5):
        for x in range(5, 24 - 5):
            for c in range(3):
                p, q = (i[y - 5:y + 6, x - 5:x + 6, c] for i in (a, b))
                mp, mq = (window * p).sum(), (window * q).sum()
                vp, vq = (window * (p - mp) ** 2).sum(), (window * (q - mq) ** 2).sum()
                cov = (window * (p - mp) * (q - mq)).sum()
                values.append((2 * mp * mq + 1e-4) * (2 * cov + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    assert metrics.ssim(image, reference) == pytest.approx(np.mean(values), abs=1e-9)  # borders are left out there too
    assert metrics.ssim(reference, reference) == pytest.approx(1)
    with pytest.raises(MiNtfError, match=r"image of 24×8 pixels: SSIM's window needs at least 11×11"):
        metrics.ssim(image[:8], reference[:8])


def test_flip_orders_images_and_ignores_how_much_black_surrounds_them(reference):
    errors = [metrics.flip(reference * f, reference) for f in (1, 1.02, 1.1, 2)]
    assert errors[0] == 0
    assert errors == sorted(errors) and errors[3] > 10 * errors[1]
    # More black: the error per lit pixel stays. With FLIP's own exposures it would double (median 0).
    wide = np.zeros((128, 24, 3))
    wide[48:80] = reference
    ratio = metrics.flip(wide * 1.1, wide) * 4 / errors[2]
    assert ratio == pytest.approx(1, abs=0.2)  # the filters spill over the crop's border, 8 of 32 rows are near it


def test_exposures_follow_flips_own_rule_where_nothing_is_black():
    flip_evaluator = pytest.importorskip("flip_evaluator")
    image = np.random.default_rng(2).uniform(0.1, 4, (33, 33, 3)).astype(np.float32)
    found = flip_evaluator.evaluate(image, image, "HDR", applyMagma=False)[2]
    assert metrics._exposures(image) == pytest.approx((found["startExposure"], found["stopExposure"]), abs=1e-5)


def test_flip_survives_uniform_and_refuses_black_references():
    grey = np.full((16, 16, 3), 0.4)
    assert metrics.flip(grey, grey) == 0
    assert metrics.flip(grey - 0.5, grey) > 0.1  # negative pixels
    with pytest.raises(MiNtfError, match="no exposure suits it"):
        metrics.flip(grey, 0 * grey)

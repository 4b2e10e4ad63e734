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
    with pytest.raises(MiNtfError, match=r"needs 11×11 pixels, the image has 24×8; render larger"):
        metrics.ssim(image[:8], reference[:8])


def _ms_ssim_of_wang(a, b):
    """Wang et al. 2003 for one channel, by sums over whole windows."""
    g = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window = np.outer(g, g) / g.sum() ** 2
    result = 1
    for scale, exponent in enumerate((0.0448, 0.2856, 0.3001, 0.2363, 0.1333)):
        pa, pb = (np.lib.stride_tricks.sliding_window_view(i, (11, 11)) for i in (a, b))
        ma, mb = (np.einsum("yxij,ij->yx", p, window) for p in (pa, pb))
        da, db = pa - ma[..., None, None], pb - mb[..., None, None]
        va, vb, cov = (np.einsum("yxij,yxij,ij->yx", p, q, window) for p, q in ((da, da), (db, db), (da, db)))
        term = (2 * cov + 9e-4) / (va + vb + 9e-4)
        if scale == 4:
            term = term * (2 * ma * mb + 1e-4) / (ma**2 + mb**2 + 1e-4)
        result *= term.mean() ** exponent
        if scale < 4:
            a, b = ((i[::2, ::2] + i[1::2, ::2] + i[::2, 1::2] + i[1::2, 1::2]) / 4 for i in (a, b))
    return result


def test_ms_ssim_equals_the_definition_of_wang_2003():
    rng = np.random.default_rng(4)
    y, x = np.mgrid[:176, :192] / 30
    reference = 0.5 + 0.4 * np.stack([np.sin(x + y), np.cos(x * y / 3), np.sin(7 * x)], -1)
    image = reference * 1.1 + rng.normal(0, 0.1, reference.shape)
    a, b = metrics.srgb(image), metrics.srgb(reference)
    expected = np.mean([_ms_ssim_of_wang(a[..., c], b[..., c]) for c in range(3)])
    assert 0.5 < expected < 0.95
    assert metrics.ms_ssim(image, reference) == pytest.approx(expected, abs=1e-9)
    assert metrics.ms_ssim(reference, reference) == pytest.approx(1)
    with pytest.raises(metrics.NotMeasured, match=r"needs 176×176 pixels, the image has 192×175; render larger"):
        metrics.ms_ssim(image[:175], reference[:175])


def test_ms_ssim_of_flat_pictures_is_their_luminance_term():
    a, b = (metrics.linear(np.full((177, 181, 3), v)) for v in (0.3, 0.6))  # odd sizes, too
    luminance = (2 * 0.3 * 0.6 + 1e-4) / (0.3**2 + 0.6**2 + 1e-4)
    assert metrics.ms_ssim(a, b) == pytest.approx(luminance**0.1333, abs=1e-6)
    mask = np.zeros((177, 181), bool)
    mask[-1, -1] = True  # one pixel that every scale repeats
    assert metrics.ms_ssim(a, b, mask) == pytest.approx(luminance**0.1333, abs=1e-6)


def test_ms_ssim_of_an_object_does_not_see_far_errors():
    rng = np.random.default_rng(5)
    reference = rng.uniform(0, 1, (352, 352, 3))
    image = reference.copy()
    image[:, :40] = 1 - image[:, :40]
    mask = np.zeros((352, 352), bool)
    mask[:, 300:] = True  # at the coarsest scale 10 pixels from the fault, the window reaches 5
    assert metrics.ms_ssim(image, reference, mask) == pytest.approx(1)
    assert metrics.ms_ssim(image, reference, ~mask) < metrics.ms_ssim(image, reference) < 0.95


def test_rmse_is_root_mean_squared_error_in_linear_light(reference):
    assert metrics.rmse(reference + 0.25, reference) == pytest.approx(0.25)
    power = np.sqrt(np.mean(reference**2))
    assert metrics.rmse(3 * reference, reference) == pytest.approx(2 * power)
    mask = np.zeros(reference.shape[:2], bool)
    mask[15:, 3] = True
    image = np.where(mask[..., None], reference - 0.5, reference + 9)
    assert metrics.rmse(image, reference, mask) == pytest.approx(0.5)


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


def test_ldr_flip_is_that_of_the_encoded_clipped_pictures(reference):
    flip_evaluator = pytest.importorskip("flip_evaluator")
    image = reference * 1.2 - 0.02
    encoded = [np.float32(metrics.srgb(i)) for i in (reference, image)]
    each, mean, _ = flip_evaluator.evaluate(*encoded, "LDR", applyMagma=False)
    assert 0.01 < mean < 1 and metrics.ldr_flip(image, reference) == pytest.approx(mean, rel=1e-5)
    mask = np.zeros(reference.shape[:2], bool)
    mask[20:, :9] = True
    assert metrics.ldr_flip(image, reference, mask) == pytest.approx(each[20:, :9].mean(), rel=1e-5)
    # The greatest difference that it knows: white for black is near 1, a pixel beyond white is white.
    white = np.ones((16, 16, 3))
    assert metrics.ldr_flip(white, 0 * white) > 0.9 and metrics.ldr_flip(white, 7 * white) == 0


def test_flip_is_the_mean_of_its_map(reference):
    each = metrics.flip_map(reference * 1.1, reference)
    assert each.shape == reference.shape[:2] and 0 <= each.min() < each.max() <= 1
    assert metrics.flip(reference * 1.1, reference) == pytest.approx(each.mean(dtype=float))
    mask = np.zeros(each.shape, bool)
    mask[14:20] = True
    assert metrics.flip(reference * 1.1, reference, mask) == pytest.approx(each[14:20].mean(dtype=float))


def test_flip_survives_uniform_and_refuses_black_references():
    grey = np.full((16, 16, 3), 0.4)
    assert metrics.flip(grey, grey) == 0
    assert metrics.flip(grey - 0.5, grey) > 0.1  # negative pixels
    with pytest.raises(MiNtfError, match="no exposure suits it"):
        metrics.flip(grey, 0 * grey)

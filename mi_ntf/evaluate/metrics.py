"""Image metrics for float arrays (h, w, 3), linear RGB, premultiplied by alpha, that is, composited on black.

All metrics take ``(image, reference, mask)``, the first two of equal shape, and return one float. `mask` (h, w), bool,
is true for the pixels that count; None stands for all of them. The windows of `ssim`, `ms_ssim` and the two FLIPs also
cover pixels beside the mask; these four need the extra ``eval``. LPIPS, which needs PyTorch, is in :mod:`.perceptual`.
"""

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from mi_ntf.core import ops
from mi_ntf.core import srgb as curve
from mi_ntf.core.errors import MiNtfError

Function: TypeAlias = Callable[[np.ndarray, np.ndarray, np.ndarray | None], float]
"""A metric of image, reference and mask."""
SSIM_WINDOW = 11
"""Pixels along a side of the window of SSIM."""
SCALES = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
"""Exponents of MS-SSIM from full to 1/16 resolution (Wang, Simoncelli, Bovik 2003, section 3.2)."""


class NotMeasured(MiNtfError):
    """Error of a metric that this picture or this machine does not allow; other metrics are not affected.

    ``reason`` has no full stop; ``remedy`` is empty if there is none.
    """

    def __init__(self, reason: str, remedy: str = ""):
        super().__init__("; ".join(filter(None, [reason, remedy])))
        self.reason, self.remedy = reason, remedy


def srgb(linear: np.ndarray) -> np.ndarray:
    """Return linear values, clipped to [0, 1], encoded by the sRGB curve."""
    encoded: np.ndarray = curve.encode(ops, linear)
    return encoded


def linear(encoded: np.ndarray) -> np.ndarray:
    """Return the inverse of :func:`srgb`, for values in [0, 1]."""
    decoded: np.ndarray = curve.decode(ops, encoded)
    return decoded


def relative_rmse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return √(mean (a − b)² / mean b²) over all pixels and channels, linear, without clipping; 0 is perfect.

    Raises :class:`MiNtfError` for a black reference.
    """
    image, reference = _masked(image, mask), _masked(reference, mask)
    power = float(np.mean(np.square(reference)))
    if power == 0:
        raise MiNtfError("the reference is black everywhere, no relative error exists; was it rendered with a light?")
    return float(np.sqrt(np.mean(np.square(image - reference)) / power))


def rmse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return √(mean (a − b)²) over all pixels and channels, linear, without clipping; 0 is perfect.

    It is the *rMSE* (root mean squared error) of Shafiei et al. 2021, table 2, which does not say whether its pixels
    are linear.
    """
    return float(np.sqrt(np.mean(np.square(_masked(image, mask) - _masked(reference, mask)))))


def max_abs(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the largest |a − b| of any pixel and channel, linear, without clipping."""
    return float(np.abs(_masked(image, mask) - _masked(reference, mask)).max())


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return 10 log₁₀(1/MSE) of the sRGB-encoded, clipped images in dB; infinite for equal images."""
    mse = float(np.mean(np.square(_masked(srgb(image), mask) - _masked(srgb(reference), mask))))
    return float("inf") if mse == 0 else -10 * float(np.log10(mse))


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the structural similarity (Wang et al. 2004) of the sRGB-encoded, clipped images; 1 is perfect.

    It is the mean of the channels, with Gaussian weights of σ = 1.5 over 11×11 pixels. As in the paper, K = (0.01,
    0.03), the data range is 1, and the covariance is that of the population. Raises :class:`NotMeasured` below 11×11
    pixels.
    """
    from skimage.metrics import structural_similarity

    need_pixels(image, SSIM_WINDOW)
    mean, each = structural_similarity(srgb(image), srgb(reference), data_range=1, channel_axis=2, full=True,
                                       gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    return float(mean if mask is None else each[mask].mean())  # the mean leaves out a border of half a window


def ms_ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the multi-scale SSIM (Wang, Simoncelli, Bovik 2003) of the encoded, clipped images; 1 is perfect.

    Each of five scales has half the size of the one before (means of 2×2 pixels; the last row or column of an odd size
    counts twice). It contributes its mean contrast-structure term, the coarsest one the whole SSIM, to the power of its
    entry of `SCALES`. The result is their product, averaged over channels. Windows and constants are those of
    :func:`ssim`. Mean terms below 0 count as 0. With a mask, means are weighted by the part of a pixel in the mask.

    Raises :class:`NotMeasured` below 176×176 pixels: the window must fit into the coarsest scale.
    """
    need_pixels(image, SSIM_WINDOW << (len(SCALES) - 1))
    a, b = (srgb(np.asarray(i, np.float64)) for i in (image, reference))
    weight = None if mask is None else np.asarray(mask, np.float64)[..., None]
    product = np.ones(a.shape[-1])
    for scale, exponent in enumerate(SCALES, 1):
        luminance, structure = _ssim_terms(a, b)
        term = luminance * structure if scale == len(SCALES) else structure
        if weight is None:
            border = SSIM_WINDOW // 2
            mean = term[border:-border, border:-border].mean((0, 1))  # as in `ssim`, only whole windows
        else:
            mean = (term * weight).sum((0, 1)) / weight.sum()
            weight = _halved(weight)
        product *= np.maximum(mean, 0) ** exponent
        a, b = _halved(a), _halved(b)
    return float(product.mean())


def flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean HDR-FLIP (Andersson et al. 2021), 67 pixels a degree, in [0, 1]; 0 is perfect."""
    return float(_masked(flip_map(image, reference), mask).mean())


def ldr_flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean LDR-FLIP (Andersson et al. 2020) of the encoded, clipped images, in [0, 1]; 0 is perfect.

    There are 67 pixels a degree.
    """
    import flip_evaluator

    encoded = [np.ascontiguousarray(srgb(i), np.float32) for i in (reference, image)]
    each = flip_evaluator.evaluate(*encoded, "LDR", applyMagma=False)[0]
    return float(_masked(np.asarray(each), mask).mean())


def flip_map(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Return the HDR-FLIP of each pixel, (h, w), in [0, 1].

    Negative values (of a reconstruction filter) are clipped. Exposures are chosen from the reference's lit pixels,
    since a black background would otherwise determine them. Raises :class:`MiNtfError` for a black reference.
    """
    import flip_evaluator

    start, stop = _exposures(reference)
    clean = [np.ascontiguousarray(np.maximum(i, 0), np.float32) for i in (reference, image)]
    parameters = {"startExposure": start, "stopExposure": stop}
    each = flip_evaluator.evaluate(*clean, "HDR", applyMagma=False, parameters=parameters)[0]
    return np.asarray(each)[..., 0]


def alignment(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Return the factor of each channel (3,) that brings `image` closest to `reference` by least squares.

    It removes a wrong scale of the albedo. The factor of a black channel is 1.
    """
    a, b = _masked(image, mask).reshape(-1, 3), _masked(reference, mask).reshape(-1, 3)
    power = (a * a).sum(0)
    factors: np.ndarray = np.where(power > 0, (a * b).sum(0) / np.where(power > 0, power, 1), 1.0)
    return factors


def need_pixels(image: np.ndarray, side: int) -> None:
    """Raise :class:`NotMeasured` for an image narrower or lower than `side` pixels."""
    height, width = image.shape[:2]
    if min(height, width) < side:
        raise NotMeasured(f"needs {side}×{side} pixels, the image has {width}×{height}", "render larger")


def _ssim_terms(a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the luminance and contrast-structure terms of SSIM of encoded images, (h, w, 3) each."""
    from skimage.filters import gaussian

    def mean(x: np.ndarray) -> np.ndarray:  # over the window of `ssim`: five pixels to each side
        smooth: np.ndarray = gaussian(x, sigma=1.5, truncate=3.5, mode="reflect", channel_axis=2, preserve_range=True)
        return smooth

    ma, mb = mean(a), mean(b)
    va, vb, covariance = mean(a * a) - ma * ma, mean(b * b) - mb * mb, mean(a * b) - ma * mb
    c1, c2 = 0.01**2, 0.03**2
    return (2 * ma * mb + c1) / (ma * ma + mb * mb + c1), (2 * covariance + c2) / (va + vb + c2)


def _halved(image: np.ndarray) -> np.ndarray:
    """Return the means of 2×2 pixels; the last row or column of an odd size is repeated."""
    height, width = image.shape[:2]
    padded = np.pad(image, ((0, height % 2), (0, width % 2), (0, 0)), mode="edge")
    half: np.ndarray = padded.reshape((height + 1) // 2, 2, (width + 1) // 2, 2, -1).mean((1, 3))
    return half


def _masked(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return the pixels that count, float64."""
    image = np.asarray(image, np.float64)
    return image if mask is None else image[mask]


def _exposures(reference: np.ndarray) -> tuple[float, float]:
    """Return the first and last exposure (stops) of HDR-FLIP, by its own rule but from the pixels that are not black.

    They map the brightest and the median pixel to 0.85 by the ACES curve (Andersson et al. 2021, section 3.1, with the
    constants of their program). With a black background, that program takes the median as 0.
    """
    luminance = np.maximum(reference, 0) @ np.array([0.2126, 0.7152, 0.0722])
    lit = luminance[luminance > 0]
    if not lit.size:
        raise MiNtfError("the reference is black everywhere, so no exposure suits it; was it rendered with a light?")
    # ACES: (0.36·2.51 x² + 0.6·0.03 x)/(0.36·2.43 x² + 0.6·0.59 x + 0.14) = 0.85, solved for x.
    x = np.roots([0.36 * (2.51 - 0.85 * 2.43), 0.6 * (0.03 - 0.85 * 0.59), -0.85 * 0.14]).max()
    start, stop = (float(np.log2(x / v)) for v in (lit.max(), np.median(lit)))
    return start, max(stop, start + 1e-3)  # FLIP ends the process unless start < stop

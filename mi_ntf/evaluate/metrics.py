"""Image metrics. Images are float arrays (h, w, 3), linear RGB, premultiplied by alpha: that is, composited on black.

All metrics take ``(image, reference, mask)``, the first two of equal shape, and return one float. `mask` (h, w), bool:
the pixels that count, None: all of them; what lies beside them is still seen by the windows of `ssim` and `flip`, which
need the extra ``eval``.
"""

import numpy as np

from mi_ntf.core import ops
from mi_ntf.core import srgb as curve
from mi_ntf.core.errors import MiNtfError

SSIM_WINDOW = 11


def srgb(linear: np.ndarray) -> np.ndarray:
    """Linear values, clipped to [0, 1], encoded by the sRGB curve."""
    return curve.encode(ops, linear)


def linear(encoded: np.ndarray) -> np.ndarray:
    """Inverse of :func:`srgb`, for values in [0, 1]."""
    return curve.decode(ops, encoded)


def relative_rmse(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """√(mean (a − b)² / mean b²) over all pixels and channels, linear, without clipping. 0 is perfect.

    Raises :class:`MiNtfError` for a black reference.
    """
    image, reference = _masked(image, mask), _masked(reference, mask)
    power = float(np.mean(np.square(reference)))
    if power == 0:
        raise MiNtfError("the reference is black everywhere, no relative error exists; was it rendered with a light?")
    return float(np.sqrt(np.mean(np.square(image - reference)) / power))


def max_abs(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Largest |a − b| of any pixel and channel, linear, without clipping."""
    return float(np.abs(_masked(image, mask) - _masked(reference, mask)).max())


def psnr(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """10 log₁₀(1/MSE) of the sRGB-encoded, clipped images, dB; infinite for equal images."""
    mse = float(np.mean(np.square(_masked(srgb(image), mask) - _masked(srgb(reference), mask))))
    return float("inf") if mse == 0 else -10 * float(np.log10(mse))


def ssim(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of the sRGB-encoded, clipped images, mean of channels. 1 is perfect.

    Gaussian weights of σ = 1.5 over 11×11 pixels, K = (0.01, 0.03), data range 1, population covariance, as in the
    paper.
    """
    from skimage.metrics import structural_similarity

    if min(image.shape[:2]) < SSIM_WINDOW:
        raise MiNtfError(f"image of {image.shape[1]}×{image.shape[0]} pixels: SSIM's window needs at least "
                         f"{SSIM_WINDOW}×{SSIM_WINDOW}; render larger")
    mean, each = structural_similarity(srgb(image), srgb(reference), data_range=1, channel_axis=2, full=True,
                                       gaussian_weights=True, sigma=1.5, use_sample_covariance=False)
    return float(mean if mask is None else each[mask].mean())  # the mean leaves out a border of half a window


def flip(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Mean HDR-FLIP (Andersson et al. 2021), 67 pixels a degree, 0 is perfect and 1 the worst.

    Negative values (of a reconstruction filter) are clipped. Exposures are chosen from the reference's lit pixels: a
    black background would otherwise set them.
    """
    import flip_evaluator

    start, stop = _exposures(reference)
    clean = [np.ascontiguousarray(np.maximum(i, 0), np.float32) for i in (reference, image)]
    parameters = {"startExposure": start, "stopExposure": stop}
    each, mean, _ = flip_evaluator.evaluate(*clean, "HDR", applyMagma=False, parameters=parameters)
    return float(mean if mask is None else np.asarray(each)[mask].mean())


def alignment(image: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """One factor a channel, (3,), that brings `image` nearest to `reference` by least squares, linear: what a wrong
    scale of the albedo alone is to blame for. 1 for a channel that is black."""
    a, b = _masked(image, mask).reshape(-1, 3), _masked(reference, mask).reshape(-1, 3)
    power = (a * a).sum(0)
    return np.where(power > 0, (a * b).sum(0) / np.where(power > 0, power, 1), 1.0)


def _masked(image: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """The pixels that count, float64."""
    image = np.asarray(image, np.float64)
    return image if mask is None else image[mask]


def _exposures(reference: np.ndarray) -> tuple[float, float]:
    """First and last exposure (stops) of HDR-FLIP, by its own rule but from the pixels that are not black.

    They map the brightest and the median pixel to 0.85 by the ACES curve (Andersson et al. 2021, section 3.1, constants
    of their program). Over a black background the program itself takes the median as 0 and adds 20 stops of noise.
    """
    luminance = np.maximum(reference, 0) @ np.array([0.2126, 0.7152, 0.0722])
    lit = luminance[luminance > 0]
    if not lit.size:
        raise MiNtfError("the reference is black everywhere, so no exposure suits it; was it rendered with a light?")
    # ACES: (0.36·2.51 x² + 0.6·0.03 x)/(0.36·2.43 x² + 0.6·0.59 x + 0.14) = 0.85, solved for x.
    x = np.roots([0.36 * (2.51 - 0.85 * 2.43), 0.6 * (0.03 - 0.85 * 0.59), -0.85 * 0.14]).max()
    start, stop = (float(np.log2(x / v)) for v in (lit.max(), np.median(lit)))
    return start, max(stop, start + 1e-3)  # FLIP ends the process unless start < stop

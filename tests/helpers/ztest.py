"""Are two unbiased image estimators equal? A z-test over independent renders, with evidence left behind on failure.

Use: ``ztest.check([render(seed=i) for i in range(n)], [other(seed=i) for i in range(n)], "point light")``.
"""

import tempfile
from pathlib import Path

import numpy as np
import OpenEXR
from scipy.stats import t as student

SIGNIFICANCE = 0.01
"""Chance that equal estimators fail, were all pixels exactly normal; Šidák shares it out among the pixels."""
PASS_SHARE = 0.9975
"""Share of pixels that must pass, as in Mitsuba's own render tests: heavy tails make single pixels fail."""

NEGLIGIBLE = 1e-3
"""Differences below this share of the reference's mean brightness count as equal."""


def block_means(image: np.ndarray, size: int = 8) -> np.ndarray:
    """Means over size × size blocks of an (h, w, c) image: (h // size, w // size, c); a remainder at the far edges is
    dropped. Averages are nearer to normal than pixels are."""
    h, w, c = image.shape[0] // size, image.shape[1] // size, image.shape[2]
    return image[: h * size, : w * size].reshape(h, size, w, size, c).mean(axis=(1, 3))


def block_difference(image: np.ndarray, reference: np.ndarray, size: int = 8, floor: float = 0.05) -> np.ndarray:
    """|difference| of block means over the reference's, per block (h, w), colours summed first.

    Blocks darker than `floor` times the brightest are compared with that floor: a relative error of black means
    nothing.
    """
    a, b = block_means(image, size).sum(-1), block_means(reference, size).sum(-1)
    return np.abs(a - b) / np.maximum(b, floor * b.max())


def p_values(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Two-sided p of "equal means", per entry, from `a` (n, …) and `b` (m, …): Welch's t with its degrees of freedom.

    Where neither varies p is 1 for equal values (to float32 rounding, 1e-5 of the size) and 0 otherwise.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    ma, mb = a.mean(0), b.mean(0)
    va, vb = a.var(0, ddof=1) / len(a), b.var(0, ddof=1) / len(b)
    rounding = 1e-5 * np.maximum(np.abs(ma), np.abs(mb))
    variance = va + vb
    still = variance <= rounding**2
    safe = np.where(still, 1, variance)
    dof = safe**2 / np.maximum(va**2 / (len(a) - 1) + vb**2 / (len(b) - 1), 1e-300)
    p = 2 * student.sf(np.abs(ma - mb) / np.sqrt(safe), np.clip(dof, 1, len(a) + len(b) - 2))
    return np.where(still, np.abs(ma - mb) <= rounding, p)


def check(images, references, label: str, block: int = 1) -> None:
    """Fail unless the estimators agree in ≥ 99.75 % of pixels (of `block` × `block` means when `block` > 1).

    `images`, `references`: at least four independent renders each, (h, w, c) linear. On failure their means and the
    map of p-values are written as EXR and the path stands in the error.
    """
    if min(len(images), len(references)) < 4:
        raise ValueError(f"{label}: {len(images)} and {len(references)} renders; a variance needs at least 4 of each")
    a, b = (np.stack([np.asarray(i, np.float64) for i in group]) for group in (images, references))
    if a.shape[1:] != b.shape[1:]:
        raise ValueError(f"{label}: shapes {a.shape[1:]} and {b.shape[1:]}; render both at one size")
    if not (np.isfinite(a).all() and np.isfinite(b).all()):
        _fail(label, a, b, np.zeros(a.shape[1:]), "NaN or infinite pixels")
    if block > 1:
        a, b = (np.stack([block_means(i, block) for i in group]) for group in (a, b))
    p = p_values(a, b)
    # In deep shadow a path tracer sees nothing in almost every render, and its variance comes out as 0: a difference of
    # a thousandth of the mean brightness is no evidence there.
    p = np.where(np.abs(a.mean(0) - b.mean(0)) < NEGLIGIBLE * b.mean(), 1, p)
    threshold = 1 - (1 - SIGNIFICANCE) ** (1 / p.size)  # Šidák
    share = float((p >= threshold).mean())
    if share < PASS_SHARE:
        _fail(
            label,
            a,
            b,
            p,
            f"{share:.2%} of {p.size} values pass at p ≥ {threshold:.1e}, {PASS_SHARE:.2%} must; "
            f"means {a.mean():.5g} and {b.mean():.5g}",
        )
    # A bias too small for any single pixel shows in the mean of all of them.
    total = float(p_values(a.mean(axis=(1, 2, 3)), b.mean(axis=(1, 2, 3))))
    if total < SIGNIFICANCE / 10:
        _fail(label, a, b, p, f"the whole images' means differ, {a.mean():.6g} and {b.mean():.6g} (p = {total:.1e})")


def _fail(label: str, a: np.ndarray, b: np.ndarray, p: np.ndarray, why: str) -> None:
    folder = Path(tempfile.mkdtemp(prefix=f"ztest_{label.replace(' ', '_').replace('/', '_')}_"))
    for name, image in [("image", a.mean(0)), ("reference", b.mean(0)), ("log10_p", np.log10(np.maximum(p, 1e-30)))]:
        channels = {
            c: np.ascontiguousarray(image[..., i], np.float32)
            for i, c in zip(range(image.shape[-1]), "RGBA", strict=False)
        }
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(str(folder / f"{name}.exr"))
    raise AssertionError(f"{label}: {why}; see {folder}")

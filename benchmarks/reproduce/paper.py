"""The paper's figures: Shafiei et al. 2021, tables 1 and 2, the complexity table, and what its text says of figures.

Its figures themselves hold no numbers that could be read off the source; the runtime and the map-build figure are lines
through the two measurements of table 1.
"""

SIDE = 600
"""Pixels along a side of its synthetic scenes' pictures, and texels along a side of its maps."""
SAMPLES = 192
LIGHTS = {"point": 1, "environment": 500}
"""Lights of the rows of table 1; the environment has 50 × 10 pixels."""
IMAGES = {"point": 400, "environment": 18}
"""Pictures that the means of table 2 are of."""
STAGES = (6000, 12000, 30000, 670000)
"""Steps of the panels of the transmittance-curve figure; field and network learn together in it."""
LARGE_HOURS = (2.7, 251.0)
"""64 × 128 environment: with its maps, and with NRF, which takes more than that."""

TABLE1 = {
    "point": {"transmittance": (0.25, 96.73, 384.10), "overall": (65.49, 162.88, 2.48)},
    "environment": {"transmittance": (122.38, 47806.81, 390.62), "overall": (522.45, 48151.80, 92.16)},
}
"""Seconds of TM and of NRF, and how many times faster."""

METHODS = ("NRF", "TM", "AG", "No AG")
"""Columns of table 2. NeRV is in the ablation figure alone, without a number."""

TABLE2 = {
    ("Happy Buddha", "point"): {
        "ms_ssim": (0.963, 0.954, 0.954, 0.948), "lpips": (0.049, 0.055, 0.055, 0.058),
        "rmse": (0.051, 0.060, 0.059, 0.058), "ssim": (0.955, 0.945, 0.945, 0.939)},
    ("Sitting Buddha", "point"): {
        "ms_ssim": (0.985, 0.973, 0.973, 0.965), "lpips": (0.066, 0.049, 0.049, 0.042),
        "rmse": (0.011, 0.022, 0.022, 0.026), "ssim": (0.976, 0.967, 0.967, 0.959)},
    ("Globe", "point"): {
        "ms_ssim": (0.681, 0.666, 0.666, 0.668), "lpips": (0.219, 0.229, 0.229, 0.228),
        "rmse": (0.107, 0.126, 0.126, 0.127), "ssim": (0.739, 0.732, 0.732, 0.732)},
    ("Happy Buddha", "environment"): {
        "ms_ssim": (0.958, 0.937, 0.938, 0.940), "lpips": (0.071, 0.077, 0.077, 0.076),
        "rmse": (0.148, 0.201, 0.201, 0.190), "ssim": (0.937, 0.914, 0.914, 0.916)},
    ("Sitting Buddha", "environment"): {
        "ms_ssim": (0.952, 0.903, 0.890, 0.870), "lpips": (0.095, 0.085, 0.090, 0.075),
        "rmse": (0.041, 0.081, 0.085, 0.097), "ssim": (0.939, 0.895, 0.880, 0.864)},
    ("Globe", "environment"): {
        "ms_ssim": (0.911, 0.859, 0.837, 0.840), "lpips": (0.086, 0.107, 0.114, 0.117),
        "rmse": (0.159, 0.240, 0.281, 0.281), "ssim": (0.899, 0.851, 0.831, 0.835)},
}
"""(scene, ``point`` or ``environment``) → metric → means by METHODS."""


def mean(scene: str, light: str, metric: str, method: str) -> float | None:
    """An entry of table 2; None where it has none."""
    found = TABLE2.get((scene, light))
    return found[metric][METHODS.index(method)] if found and method in METHODS else None


COMPLEXITY = {"Naive": "l·n²·c", "NRF": "l·m·n", "AG": "l·m·n", "TM": "l·m"}
"""Queries of the transmittance of an environment: l its pixels, m those of a light's virtual camera, n samples on a
ray, c the camera's pixels. For AG the network is asked at every sample of a camera ray, which is l·c·n; the paper has
m, since its camera and its maps are of one size."""


def ideal_speed_up(lights: int, samples: int = SAMPLES) -> float:
    """NRF's queries over TM's, with the n·m of reflectance that both need (section 5): 2n/(n + 1) for one light, n for
    many."""
    return (lights * samples + samples) / (lights + samples)

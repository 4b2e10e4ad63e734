"""The paper's figures (Shafiei et al. 2021), and the tables that show ours beside them.

Numbers of the paper stand in brackets. The source of the paper holds its tables 1 and 2 and its complexity table, but
no numbers of its figures.
"""

from typing import Any

import numpy as np

from . import networks
from .networks import IMAGE_SAMPLES, MAP, OURS, SIDE

LIGHTS = {"point": 1, "environment": 500}
"""Lights of the rows of table 1; the environment has 50 × 10 pixels."""
KINDS = {"point": "point light", "environment": "environment map"}
TABLE1 = {
    "point": {"transmittance": (0.25, 96.73, 384.10), "overall": (65.49, 162.88, 2.48)},
    "environment": {"transmittance": (122.38, 47806.81, 390.62), "overall": (522.45, 48151.80, 92.16)},
}
"""Seconds of TM and of NRF, and how many times faster."""

METHODS = ("NRF", "TM", "AG", "No AG")
"""Columns of table 2."""
BASE = "NRF"
METRICS = {"ms_ssim": "MS-SSIM", "lpips": "LPIPS", "rmse": "rMSE", "ssim": "SSIM"}
"""Metrics of table 2: functions of :mod:`mi_ntf.evaluate.metrics` and :mod:`mi_ntf.evaluate.perceptual`."""

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


COMPLEXITY = {"Naive": "l·n²·c", "NRF": "l·m·n", "AG": "l·m·n", "TM": "l·m"}
"""Queries of the transmittance of an environment.

l are the pixels of the environment, m those of a light's virtual camera, n the samples of a ray, c the pixels of the
camera. AG queries its network at every sample of a camera ray, which is l·c·n; the paper writes m, since both cameras
have the same size.
"""
PICTURES = {"the paper's synthetic scenes": (600, 600), "the paper's Girl": (592, 478), "the paper's Pony": (763, 544)}
"""Pixels of the paper's pictures, and texels of its maps."""
Values = dict[str, Any]


def mean(scene: str, kind: str, metric: str, method: str) -> float | None:
    """Return an entry of table 2, or None where it has none."""
    block = TABLE2.get((scene, kind))
    return block[metric][METHODS.index(method)] if block and method in METHODS else None


def drop(metric: str, value: float, base: float) -> float:
    """Return how much worse a value is than that of NRF; negative values are better.

    It is the loss of SSIM and MS-SSIM, the gain of LPIPS, and the gain of rMSE as a fraction of that of NRF.
    """
    if metric == "rmse":
        return value / base - 1 if base else float("nan")
    return base - value if metric.endswith("ssim") else value - base


def mean_over_scenes(kind: str, metric: str, method: str, dropped: bool = False) -> float | None:
    """Return the mean of the paper's three scenes, of the values or of the drops, or None for methods it has not."""
    if method not in METHODS:
        return None
    k, base = METHODS.index(method), METHODS.index(BASE)
    blocks = [block[metric] for (_, light), block in TABLE2.items() if light == kind]
    return float(np.mean([drop(metric, b[k], b[base]) if dropped else b[k] for b in blocks]))


def ideal_speed_up(lights: int, samples: int = IMAGE_SAMPLES) -> float:
    """Return the queries of NRF over those of TM, reflectance included (section 5).

    It is 2n/(n + 1) for one light, and n for many.
    """
    return (lights * samples + samples) / (lights + samples)


def costs_of(values: Values) -> networks.Costs:
    """Return the median costs of the results of `benchmarks.speed`."""
    rounds = values["costs"]["rounds"]
    return {name: float(np.median([costs[name] for costs in rounds])) for name in rounds[0]}


def _cell(ours: float | None, form: str, theirs: float | None = None, their_form: str = "") -> str:
    """Return ``ours [the paper's]``."""
    text = "–" if ours is None or not np.isfinite(ours) else f"{ours:{form}}"
    return text if theirs is None else f"{text} [{theirs:{their_form or form}}]"


def _times(ours: float, theirs: float | None = None) -> str:
    return _cell(ours, ".2f" if ours < 100 else ".0f", theirs, ".2f")


def _table(header: list[str], rows: list[list[str]]) -> str:
    from .tables import table

    return table(header, rows)


def times_table(values: Values) -> str:
    """Return table 1 from the results of `benchmarks.speed`: seconds by TM and NRF, the paper's settings first.

    The rays of a volume have 192 samples. Costs of a query and of a lookup are measured; the times are composed of
    them.
    """
    costs, rows = costs_of(values), []
    for table, culled, title in ((MAP, False, ""), (OURS, True, ", our network, culled on both sides")):
        for kind, words in KINDS.items():
            lights = LIGHTS[kind]
            parts = {"transmittance": networks.stage(costs, lights, table, culled, IMAGE_SAMPLES),
                     "overall": networks.whole(costs, lights, table, culled)}
            for name, (ours, base) in parts.items():
                theirs = (None,) * 3 if culled else TABLE1[kind][name]
                rows.append([f"{name}, {words}{title}", *(
                    _times(value, other) for value, other in zip((ours, base, base / ours), theirs, strict=True))])
    return _table(["seconds", "TM", "NRF", "times faster"], rows)


def queries(lights: int, texels: int, samples: int, pixels: int) -> dict[str, int]:
    """Return the queries of the transmittance by `COMPLEXITY`; those of AG by the pixels of the camera."""
    return {"Naive": lights * samples**2 * pixels, "NRF": lights * texels * samples,
            "AG": lights * pixels * samples, "TM": lights * texels}


def complexity_table(values: Values) -> str:
    """Return the formulas, and their values at the paper's sizes with the costs of `benchmarks.speed`."""
    costs = costs_of(values)
    density = costs[f"volume/{IMAGE_SAMPLES}"] / IMAGE_SAMPLES
    each = {"Naive": density, "NRF": density, "AG": costs[MAP], "TM": costs[MAP]}
    counts = queries(LIGHTS["environment"], SIDE**2, IMAGE_SAMPLES, SIDE**2)
    rows = [["formula", *COMPLEXITY.values()],
            ["queries, l = 500, m = c = 600², n = 192", *(f"{counts[k]:.2e}" for k in COMPLEXITY)],
            ["microseconds a query", *(f"{1e6 * each[k]:.2f}" for k in COMPLEXITY)],
            ["hours of queries", *(f"{counts[k] * each[k] / 3600:.3g}" for k in COMPLEXITY)]]
    return _table(["", *COMPLEXITY], rows)


def build_table(values: Values) -> str:
    """Return the seconds to make a light's map and volume of our fields: slopes through the times of several lights."""
    rows = []
    for scene, row in values["build"].items():
        ours, base = (np.polyfit(row["lights"], row[kind], 1)[0] for kind in ("map", "volume"))
        rows.append([scene, f"{row['resolution']}²", f"{ours:.3f}", f"{base:.3f}", _cell(base / ours, ".1f")])
    return _table(["seconds a light", "texels", "TM", "NRF", "times faster"], rows)


def _accuracy(values: Values, kind: str, metric: str, method: str, key: str) -> float | None:
    """Return the mean over scenes of ``mean`` or ``drop``."""
    rows = [scene.get(kind, {}).get(method, {}).get(metric, {}).get(key) for scene in values["accuracy"].values()]
    numbers = [row for row in rows if row is not None]
    return float(np.mean(numbers)) if numbers else None


def accuracy_table(values: Values) -> str:
    """Return table 2: means over scenes of all metrics."""
    rows = []
    for kind, words in KINDS.items():
        for metric, title in METRICS.items():
            cells = [_cell(_accuracy(values, kind, metric, m, "mean"), ".3f", mean_over_scenes(kind, metric, m))
                     for m in values["methods"]]
            if any(not cell.startswith("–") for cell in cells):
                rows.append([f"{words}, {title}", *cells])
    for kind, words in KINDS.items():
        rows.append([f"{words}, seconds a picture", *(
            _cell(values["seconds"].get(kind, {}).get(m, {}).get("median"), ".1f") for m in values["methods"])])
    return _table(["mean over scenes", *values["methods"]], rows)


def drops_table(values: Values) -> str:
    """Return how much worse each method is than NRF, over the pictures that both have."""
    rows, methods = [], [m for m in values["methods"] if m != BASE]
    for kind, words in KINDS.items():
        for metric, title in METRICS.items():
            form = "+.1%" if metric == "rmse" else "+.4f"
            cells = [_cell(_accuracy(values, kind, metric, m, "drop"), form, mean_over_scenes(kind, metric, m, True),
                           "+.1%" if metric == "rmse" else "+.3f") for m in methods]
            if any(not cell.startswith("–") for cell in cells):
                rows.append([f"{words}, {title}", *cells])
    return _table(["drop against NRF", *methods], rows)


def ablation_table(values: Values) -> str:
    """Return relative RMSE under many directional lights, against a march through the same field."""
    names = list(dict.fromkeys(name for row in values["ablation"].values() for name in row))
    rows = [[scene, *(_cell(row.get(name, {}).get("ray_network"), ".1%") for name in names)]
            for scene, row in values["ablation"].items()]
    return _table(["relative RMSE", *names], rows)

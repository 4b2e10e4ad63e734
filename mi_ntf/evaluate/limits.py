"""The metrics of `mi-ntf compare` by name, and limits on them, so that scripts can judge a picture.

Light to import: the command line makes its options from this table.
"""

from dataclasses import asdict, dataclass, field, make_dataclass
from typing import Annotated, Any

from tyro.conf import arg


@dataclass(frozen=True)
class Metric:
    """What the table says of a metric, and which way it is better."""

    title: str
    definition: str
    more_is_better: bool = False
    unit: str = ""


METRICS = {
    "relative_rmse": Metric("relative RMSE", "√(mean (a−b)² / mean b²), linear"),
    "rmse": Metric("RMSE", "√(mean (a−b)²), linear"),
    "psnr": Metric("PSNR", "sRGB, clipped to [0, 1]", True, "dB"),
    "ssim": Metric("SSIM", "sRGB, clipped, Gaussian 11×11", True),
    "ms_ssim": Metric("MS-SSIM", "the same, five scales", True),
    "flip": Metric("HDR-FLIP", "mean, 67 pixels a degree"),
    "ldr_flip": Metric("LDR-FLIP", "the same, sRGB, clipped"),
    "lpips": Metric("LPIPS", "sRGB, clipped, AlexNet, version 0.1"),
    "max_abs": Metric("largest error", "linear, any channel"),
}
"""Functions of :mod:`.metrics` and :mod:`.perceptual`, in the order of the table."""


def _option(name: str) -> str:
    """Name of the limit on a metric: max_flip, min_psnr, max_abs."""
    return ("min_" if METRICS[name].more_is_better else "max_") + name.removeprefix("max_")


def _field(name: str, metric: Metric) -> tuple[str, Any, Any]:
    says = f"Fail where the {metric.title} is {'less' if metric.more_is_better else 'more'}."
    return _option(name), Annotated[float | None, arg(metavar="VALUE", help=says)], field(default=None)


Limits = make_dataclass("Limits", [_field(name, metric) for name, metric in METRICS.items()])
"""One optional number a metric; tyro makes an option of each."""


def broken(result: dict[str, Any], limits: Any, masked: bool = False) -> list[dict[str, Any]]:
    """The `Limits` that a result of :func:`.compare.compare` does not keep: `metric`, `value`, `limit`, and `says`, a
    line that names all three.

    `masked`: the object's own pixels are judged, not the whole picture. NaN keeps no limit. A metric that could not be
    measured keeps none, either: its `value` is None and the line says why.
    """
    figures = result.get("masked", {}) if masked else result
    found = []
    for name, metric in METRICS.items():
        limit, value = getattr(limits, _option(name)), figures.get(name)
        if limit is None or (value is not None and (value >= limit if metric.more_is_better else value <= limit)):
            continue
        option = f"--{_option(name).replace('_', '-')} {limit:g}"
        if value is None:
            says = f"{metric.title} was not measured, so {option} cannot be judged: {_reason(result, name, masked)}"
        else:
            measured = f"{value:.6g} {metric.unit}".rstrip()
            says = (f"{metric.title}{' of the object' if masked else ''} is {measured}, "
                    f"{'less' if metric.more_is_better else 'more'} than {option} allows")
        found.append({"metric": name, "value": value, "limit": limit, "says": says})
    return found


def given(limits: Any) -> bool:
    """Whether any of the `Limits` is set."""
    return any(value is not None for value in asdict(limits).values())


def _reason(result: dict[str, Any], name: str, masked: bool) -> str:
    if masked and "masked" not in result:
        return "the reference has no alpha that tells an object from a background; leave --masked out"
    why = result.get("not_measured", {}).get(name, {"reason": "it is not among the figures", "remedy": ""})
    return "; ".join(filter(None, [why["reason"], why["remedy"]]))

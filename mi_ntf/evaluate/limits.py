"""The metrics of `mi-ntf compare` by name, and limits on them, so that scripts can judge a picture.

This module imports little, since the command line makes its options from the table of metrics.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, make_dataclass
from typing import Annotated, Any, TypeAlias

from tyro.conf import arg

Json: TypeAlias = dict[str, Any]
"""A mapping that is written as JSON."""


@dataclass(frozen=True)
class Metric:
    """Title, definition and unit of a metric for tables, and its direction."""

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
    """Return the name of the limit on a metric, such as max_flip, min_psnr or max_abs."""
    return ("min_" if METRICS[name].more_is_better else "max_") + name.removeprefix("max_")


def _field(name: str, metric: Metric) -> tuple[str, object, float | None]:
    text = f"Fail where the {metric.title} is {'less' if metric.more_is_better else 'more'}."
    option = arg(metavar="VALUE", help=text, help_behavior_hint="")
    return _option(name), Annotated[float | None, option], field(default=None)


Limits = make_dataclass("Limits", [_field(name, metric) for name, metric in METRICS.items()])
"""One optional number for each metric; tyro makes an option of each."""


def broken(result: Json, limits: object, masked: bool = False) -> list[Json]:
    """Return the `Limits` that a result of :func:`.compare.compare` exceeds.

    Each entry has ``metric``, ``value``, ``limit`` and ``says``, a line that names all three. NaN exceeds every limit.
    So does a metric that could not be measured: its value is None, and the line gives the reason.

    With `masked`, the object's own pixels are judged, not the whole picture.
    """
    figures = result.get("masked", {}) if masked else result
    failures: list[Json] = []
    for name, metric in METRICS.items():
        limit, value = getattr(limits, _option(name)), figures.get(name)
        if limit is None or (value is not None and (value >= limit if metric.more_is_better else value <= limit)):
            continue
        option = f"--{_option(name).replace('_', '-')} {limit:g}"
        if value is None:
            text = f"{metric.title} was not measured, so {option} cannot be judged: {_reason(result, name, masked)}"
        else:
            measured = f"{value:.6g} {metric.unit}".rstrip()
            text = (f"{metric.title}{' of the object' if masked else ''} is {measured}, "
                    f"{'less' if metric.more_is_better else 'more'} than {option} allows")
        failures.append({"metric": name, "value": value, "limit": limit, "says": text})
    return failures


def given(limits: object) -> bool:
    """Return True if any of the `Limits` is set."""
    return any(value is not None for value in vars(limits).values())


def _reason(result: Mapping[str, Json], name: str, masked: bool) -> str:
    """Return the reason why a metric was not measured."""
    if masked and "masked" not in result:
        return "the reference has no alpha that tells an object from a background; leave --masked out"
    entry = result.get("not_measured", {}).get(name, {"reason": "it is not among the figures", "remedy": ""})
    return "; ".join(filter(None, [entry["reason"], entry["remedy"]]))

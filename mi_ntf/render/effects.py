"""What a scene calls for: one look at it, a frozen description, and everything after it branches on that."""

from dataclasses import dataclass

import numpy as np

from ..core.errors import MiNtfError
from ..infer.visibility import AVAILABLE, METHODS
from . import lights

SAMPLES_IN_MATTER = 5
"""Shaded samples of a camera ray that hits the object, and the share of rays that do: for predicting cost only."""
COVERAGE = 0.3


@dataclass(frozen=True)
class Effects:
    """`emitters`: their kinds; `background`: the environment is seen directly; `exhaustive`: every light at every
    shading point, rather than random ones; `visibility`: the method that runs, never ``auto``; `reason`: why that
    one."""

    emitters: tuple[str, ...]
    background: bool
    exhaustive: bool
    visibility: str
    reason: str


def find_medium(scene):
    """The scene's one ``nrf`` medium. Raises MiNtfError where there is none, several, or its bounding shape is
    wrong."""
    found = {}
    for shape in scene.shapes():
        medium = shape.interior_medium() if shape.is_medium_transition() else None
        if getattr(medium, "is_nrf", False):
            found.setdefault(medium.id() or medium.path, (medium, []))[1].append(shape)
    if not found:
        raise MiNtfError(
            'nrf integrator: the scene has no nrf medium; put one inside a bounding shape: <shape type="sphere"> '
            '… <bsdf type="null"/> <medium type="nrf" name="interior"> … </medium> </shape>, '
            "or let `mi-ntf swap` write the scene"
        )
    if len(found) > 1:
        raise MiNtfError(
            f"nrf integrator: the scene has {len(found)} nrf media ({', '.join(found)}), this version renders "
            "one; merge them or render them with stock volpath"
        )
    ((medium, shapes),) = found.values()
    _check_bounds(medium, shapes)
    return medium


def _check_bounds(medium, shapes) -> None:
    """The medium knows its own place; its one bounding shape must enclose the object there."""
    corners = np.stack(np.meshgrid(*zip(*medium.field.grid.bounds, strict=True), indexing="ij"), -1).reshape(-1, 3)
    world = np.array(medium.frame.point_to_world(corners.T.astype(np.float32)), dtype=np.float64).T
    low, high, slack = world.min(0), world.max(0), 0.01 * medium.frame.length
    for shape in shapes:
        box = shape.bbox()
        if (np.array(box.min).ravel() > low + slack).any() or (np.array(box.max).ravel() < high - slack).any():
            raise MiNtfError(
                f"bounding shape {shape.id()} spans {_text(box.min)} to {_text(box.max)}, but the nrf medium inside it "
                f"({medium.path}) has its object from {_text(low)} to {_text(high)}; give shape and medium the same "
                f"placement (a sphere of centre {_text(medium.frame.origin)} and radius {medium.frame.length:.4g} fits)"
            )
    if len(shapes) > 1:
        raise MiNtfError(
            f"{len(shapes)} bounding shapes ({', '.join(s.id() for s in shapes)}) share one nrf medium, which can "
            "agree with one placement only; give each shape a medium of its own with its own to_world"
        )


def _text(v) -> str:
    return "(" + ", ".join(f"{float(c):.4g}" for c in np.array(v).ravel()) + ")"


def describe(scene, integrator, pixels: int, spp: int) -> Effects:
    """The effects of rendering `scene` by an ``nrf`` integrator: `pixels` × `spp` camera rays."""
    kinds = lights.kinds(scene)
    exhaustive = integrator.light_samples == 0
    method, reason = integrator.visibility, "chosen by name"
    if method not in AVAILABLE:
        raise MiNtfError(
            f"visibility {method} is not part of this version; choose one of {', '.join(AVAILABLE)}"
            if method in METHODS
            else f'visibility is "{method}", expected one of {", ".join(METHODS)}'
        )
    if method == "transmittance_map" and not exhaustive:
        raise MiNtfError(
            f"light_samples is {integrator.light_samples}, but visibility=transmittance_map holds one map for every "
            "light and sums all of them; remove light_samples or choose raymarch or neural_transmittance"
        )
    if method == "auto":
        points = pixels * spp * COVERAGE * SAMPLES_IN_MATTER
        break_even = 12 * integrator.map_resolution**2
        use_map = exhaustive and points > break_even
        method = "transmittance_map" if use_map else "raymarch"
        reason = (
            f"about {points:.0f} shading points, maps pay from {break_even}"
            if exhaustive
            else "random lights have no maps"
        )
    background = scene.environment() is not None and not integrator.hide_emitters
    return Effects(tuple(kinds), background, exhaustive, method, reason)

"""Fields with the visibility of their lights, and shadows of fields and surfaces on each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import drjit as dr

from ...infer.grid import Density
from ...infer.lights import LightTable
from ...infer.types import Array, Float, Mask, UInt32, Vector, Vector3, Visibility
from ...infer.visibility import outside
from ...infer.visibility.attached_shadow import AttachedDepth
from ..scene.frame import Frame
from ..scene.media import NRFMedium
from .surfaces import Surfaces


@dataclass(frozen=True)
class Part:
    """An ``nrf`` medium prepared for a render. Where a visibility is None, light casts no shadows.

    all_lights   the light table in the medium's field coordinates
    table        its rows of the present run
    for_run      visibility of the lights of the present run
    for_sampled  visibility of sampled lights, and of any other rays
    for_all      visibility of all lights of the table
    depth        optical depths with the gradients of the density; None where it has none
    """

    medium: NRFMedium
    all_lights: LightTable
    table: LightTable
    for_run: Visibility | None = None
    for_sampled: Visibility | None = None
    for_all: Visibility | None = None
    depth: AttachedDepth | None = None

    @property
    def frame(self) -> Frame:
        """Placement of the medium in the scene."""
        return self.medium.frame

    @property
    def finest(self) -> float:
        """Radius of the smallest field, field units; 1 but for many instances."""
        return float(getattr(self.medium, "finest", 1.0))

    @property
    def source(self) -> Density:
        """Density of the medium."""
        return self.medium.source

    def visibility(self, sampled: bool) -> Visibility | None:
        """Return the visibility of sampled lights, or of the lights of the present run."""
        return self.for_sampled if sampled else self.for_run


class FieldVisibility(NamedTuple):
    """A visibility method in the field coordinates of `frame`."""

    frame: Frame
    method: Visibility


class Shadow:
    """Visibility of lights through a field, other fields and surfaces.

    far  the light lies outside of the field's sphere, where the field needs no distance to it
    """

    def __init__(self, field: FieldVisibility, other_fields: Sequence[FieldVisibility], surfaces: Surfaces | None,
                 far: bool = False) -> None:
        self.field, self.other_fields, self.surfaces, self.far = field, other_fields, surfaces, far

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask,
            sun: Mask | None = None) -> Array:
        """Return the product of all transmittances, a colour if surfaces are coloured."""
        frame, method = self.field
        tau = method.tau(x, wi, type(distance)(dr.inf) if self.far else distance, index, active, sun)
        p, d = frame.point_to_world(x), frame.direction_to_world(wi)
        length = distance * frame.unit
        for other in self.other_fields:
            tau = tau * transmittance_between(other, p, d, length, index, active & (tau != 0), sun)
        if self.surfaces:
            tau = tau * self.surfaces.transmission(p, d, length, active & (tau != 0))
        return tau


class KnownTransmittance:
    """Visibility of a light at the camera, which has the transmittance of the view."""

    def __init__(self, tau: Float) -> None:
        self._tau = tau

    def tau(self, x: Vector, wi: Vector, distance: Float, index: UInt32, active: Mask,
            sun: Mask | None = None) -> Float:
        """Return the transmittance of the view."""
        return self._tau


def transmittance_between(field: FieldVisibility, p: Vector3, d: Vector3, length: Float, index: UInt32,
                          active: Mask, sun: Mask = None) -> Float:
    """Return a field's transmittance from the scene points `p` along `d`, as far as `length` in scene units."""
    frame = field.frame
    x, wi = frame.point_to_field(p), frame.direction_to_field(d)
    return outside.tau(field.method, x, wi, length / frame.unit, index, active, sun)

"""Many fields as one medium, whose kernels do not grow with their number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import mitsuba as mi
import numpy as np

from ...core.architecture import Similarity
from ...infer.backend import module_of
from ...infer.grid import Density, GridField
from ...infer.instances import Copies, InstancedVisibility, Instances
from ...infer.shade import Reflectance
from ...infer.types import Vector, Visibility
from .frame import Frame
from .loaded import LoadedField
from .media import NRFMedium

MIN_GLOSS = 0.01
"""Least weight of a specular lobe that is evaluated, relative to a white diffuse surface
(:class:`mi_ntf.infer.grid.GridField`, `gloss`)."""
FEWEST = 4
"""Least number of fields that are one medium. Fewer are media of their own, whose densities each kernel contains."""
WIDEST = 2.0
"""Largest ratio of sizes in one medium, since cells of a march are as long as the smallest field needs."""
FARTHEST = 1000.0
"""Largest extent of one medium, in radii of its smallest field. Single precision then places a point to a twentieth of
a cell, 1/500 of a radius."""
MARGIN = 1.002
"""Radius of the sphere around all instances over the least one, since marches leave out rays that graze a sphere."""


class Crowd:
    """The `members`, of about the same size, as one medium. They are of one field or of surfaces of one kind.

    `frame`: of a sphere around all; `finest`: radius of the smallest one, in radii of this sphere; `kinds`: one member
    of each field. No parameter of a member carries gradients.
    """

    attached: Sequence[str] = ()
    attached_log_density = None
    shadow_catcher = False

    def __init__(self, members: Sequence[NRFMedium]) -> None:
        self.members = members
        first = members[0]
        self.field: LoadedField = first.field
        self.representation, self.path = first.representation, first.path
        origin = np.array([m.frame.origin for m in members])
        length = np.array([m.frame.length for m in members])
        centre = ((origin - length[:, None]).min(0) + (origin + length[:, None]).max(0)) / 2
        radius = MARGIN * float((np.linalg.norm(origin - centre, axis=1) + length).max())
        self.frame = Frame(Similarity(tuple(centre), radius), np.eye(4), 1.0)
        rotation = np.array([m.frame.rotation for m in members])
        kinds = {_content(m): m for m in members}
        self.kinds = list(kinds.values())
        field_index = np.array([list(kinds).index(_content(m)) for m in members])
        self.copies = Copies((origin - centre) / radius, rotation, length / radius, field_index, module_of(mi.Float))
        self.finest = float(length.min()) / radius
        self._instances = Instances([m.source for m in self.kinds], self.copies, [m.reflectance for m in self.kinds])
        self.source: Density = self._instances

    def reflectance(self, x: Vector) -> Reflectance:
        """Return the reflectance at field points."""
        return self._instances.reflect(x)

    def visibility(self, methods: Sequence[Visibility | None]) -> Visibility | None:
        """Return the visibility of all members by the methods of their fields, `kinds`."""
        present = [method for method in methods if method is not None]
        return InstancedVisibility(present, self.copies) if present else None


def _content(medium: NRFMedium) -> tuple[int, int]:
    """Return numbers that are the same for media of equal density and reflectance, set values included."""
    return id(medium.source), id(medium.field)


def _kind(medium: NRFMedium) -> tuple[int, ...]:
    """Return numbers that are the same for media that may be one: those of one field, and all opaque baked surfaces."""
    field = medium.field
    if medium.shadow_catcher:
        return 2, id(medium)  # casts shadows on the others of its kind
    if isinstance(medium.source, GridField) and field.softness.opaque and field.phase is None:
        return 0, int(field.retro is None), int(field.tail is None), int(field.grid.gloss > MIN_GLOSS)
    return 1, *_content(medium)


def _near(media: list[NRFMedium]) -> list[list[NRFMedium]]:
    """Return `media` in parts whose extent is at most ``FARTHEST``, halved along the longest side until they are."""
    places = np.array([m.frame.origin for m in media])
    low, high = places.min(0), places.max(0)
    if len(media) < FEWEST or np.linalg.norm(high - low) <= FARTHEST * min(m.frame.length for m in media):
        return [media]
    axis = int(np.argmax(high - low))
    upper = places[:, axis] > (low + high)[axis] / 2
    halves = ([m for m, u in zip(media, upper, strict=True) if u == side] for side in (False, True))
    return [part for half in halves for part in _near(half)]


def joined(media: Sequence[NRFMedium]) -> list[NRFMedium]:
    """Return `media` with those of one kind and similar size as a :class:`Crowd` where they are many."""
    groups: list[list[NRFMedium]] = []
    for medium in sorted(media, key=lambda m: (_kind(m), m.frame.length)):
        last = groups[-1][0] if groups else None
        if last and _kind(last) == _kind(medium) and medium.frame.length <= WIDEST * last.frame.length:
            groups[-1].append(medium)
        else:
            groups.append([medium])
    crowds = [Crowd(part) for group in groups for part in _near(group) if len(part) >= FEWEST]
    members = {id(m) for crowd in crowds for m in crowd.members}
    return [m for m in media if id(m) not in members] + [cast(NRFMedium, crowd) for crowd in crowds]

"""Many instances of one field as one medium, whose kernels do not grow with their number."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import mitsuba as mi
import numpy as np

from ...core.architecture import Similarity
from ...infer.backend import module_of
from ...infer.grid import Density
from ...infer.instances import Copies, InstancedVisibility, Instances
from ...infer.shade import Reflectance
from ...infer.types import Vector, Visibility
from .frame import Frame
from .loaded import LoadedField, VolumeField
from .media import NRFMedium

FEWEST = 4
"""Least number of instances that are one medium. Fewer are media of their own, whose densities each kernel contains."""
WIDEST = 2.0
"""Largest ratio of sizes in one medium, since cells of a march are as long as the smallest field needs."""
MARGIN = 1.002
"""Radius of the sphere around all instances over the least one, since marches leave out rays that graze a sphere."""


class Crowd:
    """The `members`, instances of one field of about the same size, as one medium.

    `frame`: of a sphere around all; `finest`: radius of the smallest one, in radii of this sphere.
    """

    def __init__(self, members: Sequence[NRFMedium]) -> None:
        self.members = members
        first = members[0]
        self.field: LoadedField | VolumeField = first.field
        self.representation, self.path = first.representation, first.path
        origin = np.array([m.frame.origin for m in members])
        length = np.array([m.frame.length for m in members])
        centre = ((origin - length[:, None]).min(0) + (origin + length[:, None]).max(0)) / 2
        radius = MARGIN * float((np.linalg.norm(origin - centre, axis=1) + length).max())
        self.frame = Frame(Similarity(tuple(centre), radius), np.eye(4), 1.0)
        rotation = np.array([m.frame.rotation for m in members])
        self.copies = Copies((origin - centre) / radius, rotation, length / radius, module_of(mi.Float))
        self.finest = float(length.min()) / radius
        self._instances = Instances(first.source, self.copies, first.reflectance)
        self.source: Density = self._instances

    def reflectance(self, x: Vector) -> Reflectance:
        """Return the reflectance at field points."""
        return self._instances.reflect(x)

    def visibility(self, method: Visibility | None) -> Visibility | None:
        """Return the visibility of all members by the visibility `method` of their field."""
        return None if method is None else InstancedVisibility(method, self.copies)


def joined(media: Sequence[NRFMedium]) -> list[NRFMedium]:
    """Return `media` with those of one field and similar size as a :class:`Crowd` where they are many."""
    groups: list[list[NRFMedium]] = []
    for medium in sorted(media, key=lambda m: (id(m.source), m.frame.length)):
        last = groups[-1][0] if groups else None
        if last and last.source is medium.source and medium.frame.length <= WIDEST * last.frame.length:
            groups[-1].append(medium)
        else:
            groups.append([medium])
    crowds = [Crowd(group) for group in groups if len(group) >= FEWEST]
    members = {id(m) for crowd in crowds for m in crowd.members}
    return [m for m in media if id(m) not in members] + [cast(NRFMedium, crowd) for crowd in crowds]

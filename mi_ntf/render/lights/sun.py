"""The sun's disc of a ``sunsky``, which is too small for cells of the sky."""

import re

import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from . import environment

RINGS = 16
"""Rings of the disc, of equal solid angle, that its radiance is averaged over."""


class Sun:
    """`axis`: unit vector (3,) towards it; `power`: (3,) irradiance above the sky's. Raises MiNtfError where Mitsuba
    does not tell how large it is."""

    def __init__(self, emitter):
        self._emitter = emitter
        self.axis = np.array(mi.traverse(emitter)["sun_direction"], np.float64).ravel()
        # The aperture is no scene parameter; the plugin prints it, in degrees.
        printed = re.search(r"Sun aperture = ([\d.e+-]+)", str(emitter))
        if not printed:
            raise MiNtfError(
                f"{environment.name(emitter, 'sunsky')}: Mitsuba prints no \"Sun aperture\" of it, without which its "
                "sun has no size; use the Mitsuba that this package asks for, or light_samples"
            )
        self.half_aperture = np.radians(float(printed[1]) / 2)
        side = np.cross(self.axis, [0.0, 0.0, 1.0] if abs(self.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        self._side = side / np.linalg.norm(side)
        self._up = np.cross(self._side, self.axis)
        cap = 1 - np.cos(self.half_aperture)
        cos = 1 - (np.arange(RINGS) + 0.5) / RINGS * cap
        phi = (np.arange(4 * RINGS) + 0.5) * np.pi / (2 * RINGS)
        cos, phi = (v.ravel() for v in np.meshgrid(cos, phi))
        disc = self._around(np.arccos(cos), phi)
        glow = environment.radiance(emitter, disc) - self.sky(disc)
        self.power = glow.mean(axis=0) * 2 * np.pi * cap

    def sky(self, towards: np.ndarray) -> np.ndarray:
        """(n, 3) radiance without the sun from the scene directions `towards` (n, 3): on the disc that beside it."""
        on = towards @ self.axis > np.cos(self.half_aperture * 1.01)
        phi = np.arctan2(towards @ self._up, towards @ self._side)
        beside = self._around(np.full(len(towards), self.half_aperture * 1.02), phi)
        return environment.radiance(self._emitter, np.where(on[:, None], beside, towards))

    def _around(self, angle, phi) -> np.ndarray:
        across = np.cos(phi)[:, None] * self._side + np.sin(phi)[:, None] * self._up
        return np.cos(angle)[..., None] * self.axis + np.sin(angle)[..., None] * across

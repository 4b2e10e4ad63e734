"""Split of a ``sunsky`` into the disc of its sun, which is too small for cells of the sky, and the sky without it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from ..scene.recent import Recent
from . import environment

RINGS = 16
"""Rings of the disc, of equal solid angle, over which its radiance is averaged."""
TEXELS = 256, 512
"""Height and width of the map of the sky. The horizon lies between two of its rows."""


@dataclass(frozen=True)
class Sky:
    """Sun and sky of a ``sunsky``.

    axis   (3,) unit vector towards the sun
    power  (3,) irradiance of the sun in excess of the sky's
    image  (height, width, 3) texels of the sky in its own axes, y up
    """

    axis: np.ndarray
    power: np.ndarray
    image: np.ndarray


_skies: Recent[Sky] = Recent()


def sky(emitter: mi.Emitter) -> Sky:
    """Return sun and sky of a ``sunsky``. The last results are cached.

    Raises MiNtfError if Mitsuba does not print the size of the sun.
    """
    parameters = mi.traverse(emitter)
    key = str(emitter), *(np.array(dr.detach(getattr(v, "matrix", v))).tobytes() for _, v in parameters)
    return _skies.of(key, lambda: _sky(emitter))


def _sky(emitter: mi.Emitter) -> Sky:
    disc = _Disc(emitter)
    height, width = TEXELS
    theta, phi = np.arange(height) * np.pi / (height - 1), (np.arange(width) + 0.5) * 2 * np.pi / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    towards = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    rotation, _ = environment.placement(emitter, "sunsky")
    image = disc.sky(towards.reshape(-1, 3) @ rotation.T).reshape(height, width, 3)
    return Sky(disc.axis, disc.power(), image)


class _Disc:
    """Disc of the sun of `emitter`, and the sky around and behind it."""

    def __init__(self, emitter: mi.Emitter) -> None:
        self._emitter = emitter
        axis = np.array(mi.traverse(emitter)["sun_direction"], np.float64).ravel()
        self.axis = axis / np.linalg.norm(axis)  # a new value of the parameter need not have length 1
        # The aperture is no scene parameter; the plugin prints it, in degrees.
        printed = re.search(r"Sun aperture = ([\d.e+-]+)", str(emitter))
        if not printed:
            raise MiNtfError(
                f"{environment.name(emitter, 'sunsky')}: Mitsuba prints no \"Sun aperture\" of it, without which its "
                "sun has no size; use the Mitsuba that this package asks for, or light_samples"
            )
        self._half_aperture = np.radians(float(printed[1]) / 2)
        side = np.cross(self.axis, [0.0, 0.0, 1.0] if abs(self.axis[2]) < 0.9 else [1.0, 0.0, 0.0])
        self._side = side / np.linalg.norm(side)
        self._up = np.cross(self._side, self.axis)

    def power(self) -> np.ndarray:
        """Return the irradiance (3,) of the sun in excess of the sky's."""
        cap = 1 - np.cos(self._half_aperture)
        cos = 1 - (np.arange(RINGS) + 0.5) / RINGS * cap
        phi = (np.arange(4 * RINGS) + 0.5) * np.pi / (2 * RINGS)
        cos, phi = (v.ravel() for v in np.meshgrid(cos, phi))
        disc = self._around(np.arccos(cos), phi)
        excess = environment.radiance(self._emitter, disc) - self.sky(disc)
        power: np.ndarray = excess.mean(axis=0) * 2 * np.pi * cap
        return power

    def sky(self, towards: np.ndarray) -> np.ndarray:
        """Return the radiance (n, 3) without the sun from the scene directions `towards` (n, 3).

        On the disc it is the radiance beside the disc.
        """
        on_disc = towards @ self.axis > np.cos(self._half_aperture * 1.01)
        phi = np.arctan2(towards @ self._up, towards @ self._side)
        beside = self._around(np.full(len(towards), self._half_aperture * 1.02), phi)
        return environment.radiance(self._emitter, np.where(on_disc[:, None], beside, towards))

    def _around(self, angle: np.ndarray, phi: np.ndarray) -> np.ndarray:
        across = np.cos(phi)[:, None] * self._side + np.sin(phi)[:, None] * self._up
        directions: np.ndarray = np.cos(angle)[..., None] * self.axis + np.sin(angle)[..., None] * across
        return directions

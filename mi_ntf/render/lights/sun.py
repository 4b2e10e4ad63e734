"""A ``sunsky`` in two: its sun's disc, which is too small for cells of the sky, and the sky without it."""

import re
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.errors import MiNtfError
from . import environment
from .recent import Recent

RINGS = 16
"""Rings of the disc, of equal solid angle, that its radiance is averaged over."""
TEXELS = 256, 512
"""Of the map that the sky is looked up in. The horizon lies between two rows."""
_kept = Recent()


@dataclass(frozen=True)
class Sky:
    """`axis`: unit vector (3,) towards the sun; `power`: (3,) its irradiance above the sky's; `image`: (height, width,
    3) texels of the sky in its own axes, y up."""

    axis: np.ndarray
    power: np.ndarray
    image: np.ndarray


def sky(emitter) -> Sky:
    """That of a ``sunsky``; the last few are kept. Raises MiNtfError where Mitsuba does not tell how large its sun
    is."""
    parameters = mi.traverse(emitter)
    key = str(emitter), *(np.array(dr.detach(getattr(v, "matrix", v))).tobytes() for _, v in parameters.items())
    return _kept.of(key, lambda: _sky(emitter))


def _sky(emitter) -> Sky:
    disc = _Disc(emitter)
    height, width = TEXELS
    theta, phi = np.arange(height) * np.pi / (height - 1), (np.arange(width) + 0.5) * 2 * np.pi / width
    theta, phi = np.meshgrid(theta, phi, indexing="ij")
    towards = np.stack([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)], axis=-1)
    rotation, _ = environment.placement(emitter, "sunsky")
    image = disc.beside(towards.reshape(-1, 3) @ rotation.T).reshape(height, width, 3)
    return Sky(disc.axis, disc.power(), image)


class _Disc:
    """The sun of `emitter`, and what is beside it."""

    def __init__(self, emitter):
        self._emitter = emitter
        axis = np.array(mi.traverse(emitter)["sun_direction"], np.float64).ravel()
        self.axis = axis / np.linalg.norm(axis)  # which a new value of the parameter need not be
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
        """(3,) irradiance above the sky's."""
        cap = 1 - np.cos(self._half_aperture)
        cos = 1 - (np.arange(RINGS) + 0.5) / RINGS * cap
        phi = (np.arange(4 * RINGS) + 0.5) * np.pi / (2 * RINGS)
        cos, phi = (v.ravel() for v in np.meshgrid(cos, phi))
        disc = self._around(np.arccos(cos), phi)
        glow = environment.radiance(self._emitter, disc) - self.beside(disc)
        return glow.mean(axis=0) * 2 * np.pi * cap

    def beside(self, towards: np.ndarray) -> np.ndarray:
        """(n, 3) radiance without the sun from the scene directions `towards` (n, 3): on the disc that beside it."""
        on = towards @ self.axis > np.cos(self._half_aperture * 1.01)
        phi = np.arctan2(towards @ self._up, towards @ self._side)
        beside = self._around(np.full(len(towards), self._half_aperture * 1.02), phi)
        return environment.radiance(self._emitter, np.where(on[:, None], beside, towards))

    def _around(self, angle, phi) -> np.ndarray:
        across = np.cos(phi)[:, None] * self._side + np.sin(phi)[:, None] * self._up
        return np.cos(angle)[..., None] * self.axis + np.sin(angle)[..., None] * across

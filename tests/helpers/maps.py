"""Lights, media and maps for tests of what is kept of maps."""

import dataclasses

import mitsuba as mi
import numpy as np

from helpers import scenes
from mi_ntf.infer.lights import LightTable
from mi_ntf.render.maps import building
from mi_ntf.render.scene.media import find_media

OPTIONS = building.Options(2 / 96, 16, cache=True)
WHERE = np.array([[0.48, 0.6, 0.64], [1.5, 1.0, 2.0], [0.1, 0.5, -0.1]])
SIZE = 4 * 2 * 16**2
"""Bytes of one light's map."""


def find_medium(path, **options):
    """The medium of a scene around the field file `path`; `options`: parameters of the medium."""
    loaded = scenes.scene(path, {"type": "nrf"}, {"light": scenes.light("point")}, medium={"resolution": 48, **options})
    return find_media(loaded)[0]


def table(count=3, move=0.0):
    """A directional light and point lights outside and inside the sphere."""
    return LightTable(WHERE[:count] + move, np.ones((count, 3)), np.arange(count) > 0, 1.0, mi)


def build(medium, lights=None, options=OPTIONS):
    """The map of `lights`."""
    return building.build("transmittance_map", medium, lights or table(), options)


def texels(medium, lights=None, options=OPTIONS):
    """Its numbers."""
    return np.array(build(medium, lights, options).values)


def without_cache(medium, lights=None, options=OPTIONS):
    """The same, made anew."""
    return texels(medium, lights, dataclasses.replace(options, cache=False))

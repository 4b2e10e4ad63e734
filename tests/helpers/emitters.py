"""Lights of each kind that Mitsuba has."""

import mitsuba as mi
import numpy as np

from helpers import scenes

AWAY = np.array((2.0, 2.1, 1.5))
"""Where lights that have a place are, in radii of what they light: to the upper right, in front."""


def emitter(kind: str, target, radius: float) -> dict:
    """A light of `kind` on a ball of `radius` around `target`."""
    place = np.asarray(target) + radius * AWAY
    power = radius * radius
    aim = mi.ScalarTransform4f().look_at(place.tolist(), np.asarray(target).tolist(), [0, 1, 0])
    pixels = np.tile(np.float32([[[1, 0.5, 2], [0.2, 1, 1]]]), (2, 1, 1))
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(pixels)}
    sky = {"type": "sunsky", "sun_direction": [0.6, 0.5, 0.7], "sky_scale": 4.0, "sun_aperture": 1.0}
    lamp = {"type": "rectangle", "to_world": aim @ mi.ScalarTransform4f().scale(0.5 * radius)}
    warm = {"type": "rgb", "value": [26 * power, 22 * power, 18 * power]}
    return {
        "point": {"type": "point", "position": place.tolist(), "intensity": warm},
        "directional": scenes.light("directional"),
        "envmap": scenes.light("env"),
        "constant": {"type": "constant", "radiance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}},
        "spot": {"type": "spot", "to_world": aim, "cutoff_angle": 16.0, "beam_width": 4.0, "intensity": 22 * power},
        "textured": {
            "type": "spot",
            "to_world": aim,
            "cutoff_angle": 20.0,
            "intensity": 22 * power,
            "texture": texture,
        },
        "projector": {"type": "projector", "to_world": aim, "fov": 30.0, "irradiance": texture, "scale": 4 * power},
        "sunsky": {**sky, "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90)},
        "area": {**lamp, "emitter": {"type": "area", "radiance": 12.0}},
        "directionalarea": {**lamp, "emitter": {"type": "directionalarea", "radiance": 12.0}},
    }[kind]

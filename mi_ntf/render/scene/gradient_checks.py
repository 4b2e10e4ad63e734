"""Which scene parameters the picture can be differentiated by. The others would have derivatives of zero."""

import drjit as dr
import mitsuba as mi

from ...core.errors import MiNtfError
from .media import ordinary_shapes, shape_groups, transmits

POWERS = {
    "PointLight": ("intensity",),
    "SpotLight": ("intensity", "texture"),
    "DirectionalEmitter": ("irradiance",),
    "EnvironmentMapEmitter": ("data", "scale"),
    "ConstantBackgroundEmitter": ("radiance",),
    "AreaLight": ("radiance",),
    "Projector": ("irradiance", "scale"),
    "SmoothDiffuse": ("reflectance",),
}
"""Mitsuba's class name → parameters that the light on its way is linear in."""
PLACES = {"PointLight": ("position",), "SpotLight": ("to_world",), "DirectionalEmitter": ("to_world",)}
"""Those that move a light, where it is a row of the table, whose shadows move with it."""


def check(scene, light) -> bool:
    """Whether a parameter of `scene` carries gradients; `light`: its :class:`mi_ntf.render.lights.scene_lights.Lights`.
    Raises MiNtfError where it is one that derivatives of the picture leave out."""
    parameters = mi.traverse(scene)
    attached = [key for key, value in parameters if dr.grad_enabled(value)]
    for key in attached:
        if not _supported(parameters, key, light):
            raise MiNtfError(
                f"gradients by {key}: not supported; detach it. Supported are what lights emit (intensity, irradiance, "
                "radiance, texture of a spot, data and scale of an envmap), the reflectance of diffuse BSDFs and, of "
                "lights that are not drawn at random, the position of a point and the to_world of a spot or directional"
            )
        place = key.rpartition(".")[2] in ("position", "to_world")
        if place and transmits(shape_groups(scene) + ordinary_shapes(scene)):
            raise MiNtfError(f"gradients by {key}: not supported beside surfaces that let light through (null, mask, "
                             "thindielectric), whose own slopes would be missing; detach it or take these surfaces out")
    return bool(attached)


def _supported(parameters, key: str, light) -> bool:
    node, words = parameters.properties[key][2], 1
    while node is not None:
        of_owner, kind = ".".join(key.split(".")[-words:]), node.class_name()
        if of_owner.startswith(POWERS.get(kind, ())):
            return True
        if of_owner in PLACES.get(kind, ()):
            return any(node is d.emitter for d in light.discrete)
        node, words = parameters.hierarchy[node][0], words + 1
    return False

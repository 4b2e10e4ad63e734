"""Scene of the photographs: a field whose parameters change, and the light that is known."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..core import field_file
from ..core.errors import MiNtfError
from ..core.voxels import Voxels
from ..infer import ops
from ..infer.types import Array
from ..infer.voxel_parameters import Lattice, VoxelParameters
from ..render.plugins import properties
from ..render.scene import scene_file
from ..render.scene.environment_option import Environment
from ..render.scene.field_parameters import FieldParameters
from ..render.scene.media import NRFMedium, find_media
from ..render.scene.settings import Settings
from .photographs import Photographs
from .voxels import RANGES

LIGHT_SAMPLES = 4
"""Sampled lights per shading point under an environment."""


class Renderer(Protocol):
    """The ``nrf`` integrator."""

    def render(self, scene: mi.Scene, sensor: mi.Sensor, seed: int, spp: int, /) -> Array:
        """Return a picture (h, w, 4), linear RGBA."""


class Subject:
    """Scene with one field, rendered by the light of photographs.

    Parameters
    ----------
    path
        Scene with an ``nrf`` medium and integrator; or a field file, which the flash of each photograph lights.
    defined
        Values of the scene's $names.
    environment
        Changes of the scene's environment.

    Attributes
    ----------
    flash
        True if the light is that of the photographs' flash.
    medium, original
        The field's medium, and its field without changes.
    digest
        Hash of the scene's file and options.
    bounces
        True if the scene's `max_depth` has light that is scattered more than once.
    """

    def __init__(self, path: Path, defined: dict[str, str], environment: Environment) -> None:
        self.flash = path.suffix.lower() == ".safetensors"
        if self.flash and (defined or environment != Environment()):
            raise MiNtfError(f"{path} is a field file, lit by the flash of each photograph, and has no $names and no "
                             "environment; leave -D and --env out, or give a scene")
        self._scene = _flash_scene(path) if self.flash else scene_file.load(path, defined, environment)
        options = json.dumps([defined, repr(environment)], sort_keys=True)
        self.digest = hashlib.sha256(path.read_bytes() + options.encode()).hexdigest()
        media = [m for m in find_media(self._scene) if getattr(m, "is_nrf", False)]
        if len(media) != 1:
            raise MiNtfError(f"{path}: the scene has {len(media)} nrf media, and photographs refine one field; give a "
                             "scene with one")
        self.medium: NRFMedium = media[0]
        self.original = self.medium.field
        self._parameters = mi.traverse(self._scene)
        keys = [key for key, _ in self._parameters if key.endswith("reflectance_blocks")]
        if not keys:
            raise MiNtfError(f"{path}: the nrf medium has representation=network or holds no matter, so it has no "
                             "voxels to refine; choose representation=grid")
        self._prefix = keys[0].removesuffix("reflectance_blocks")
        context = getattr(self._scene.integrator(), "context", None)
        if context is None:
            raise MiNtfError(f"{path}: its integrator is no nrf, which knows derivatives by a field; give the scene "
                             '<integrator type="nrf"/>')
        settings = _settings(context.settings, self._scene.environment() is not None)
        self._full = _integrator(settings)
        self.bounces = not 0 <= settings.max_depth <= 2
        self._direct = _integrator(replace(settings, max_depth=2)) if self.bounces else self._full

    @property
    def solid(self) -> bool:
        """True if the field is a surface."""
        return self.medium.field.phase is None and not self.medium.field.emissive

    def to_scene(self) -> np.ndarray:
        """Return the (4, 4) matrix from the world of the photographs to the scene."""
        return self.medium.frame.of_capture(self.medium.field.similarity)

    def names(self, requested: tuple[str, ...]) -> list[str]:
        """Return the field's names of the parameters `requested`. Raises MiNtfError."""
        known = [name for name in RANGES if self.has(name)]
        for name in requested:
            if name not in known:
                raise MiNtfError(f"--parameters: {name!r} cannot be refined; this field has {', '.join(known)}")
        return list(dict.fromkeys(requested))

    def has(self, name: str) -> bool:
        """Return True if the field has a parameter of this name."""
        return self._prefix + name in self._parameters

    def lattice(self, name: str) -> Lattice:
        """Return the places of the voxels of a parameter."""
        voxels = self._voxels()
        return voxels.density_lattice if name == voxels.density_name else voxels.reflectance_lattice

    def _voxels(self) -> VoxelParameters:
        parameters: FieldParameters = getattr(self.medium, "parameters")  # noqa: B009  only this kind has them
        return parameters.voxels

    def get(self, name: str) -> Array:
        """Return the tensor of a parameter."""
        return mi.TensorXf(self._parameters[self._prefix + name])

    def set(self, values: dict[str, Array]) -> None:
        """Set parameters by name."""
        for name, value in values.items():
            self._parameters[self._prefix + name] = value
        self._parameters.update()

    def light(self, photographs: Photographs, view: int) -> None:
        """Move the flash to that of a photograph, if it is the light."""
        if self.flash:
            place: Array = mi.Point3f(photographs.lamp[view].tolist())
            intensity: Array = mi.Color3f(photographs.intensity[view].tolist())
            dr.make_opaque(place, intensity)  # so that they are not compiled into kernels
            self._parameters["lamp.position"], self._parameters["lamp.intensity.value"] = place, intensity
            self._parameters.update()

    def render(self, sensor: mi.Sensor, seed: int, spp: int) -> Array:
        """Return a picture (h, w, 3) with all light, without derivatives."""
        with ops.suspend_grad():
            image: Array = self._full.render(self._scene, sensor, seed, spp)
        return image[..., :3]

    def render_direct(self, sensor: mi.Sensor, seed: int, spp: int) -> Array:
        """Return a picture (h, w, 3) of the light that is scattered once, with derivatives."""
        image: Array = self._direct.render(self._scene, sensor, seed, spp)
        return image[..., :3]


def _flash_scene(path: Path) -> mi.Scene:
    """Return a scene of a field file and a point light called ``lamp``.

    As in training, light bounces between surfaces, and smoke scatters it once.
    """
    header = field_file.load_header(path)
    sphere, phase = header.similarity, header.phase if isinstance(header, Voxels) else header.architecture.phase
    scene: mi.Scene = mi.load_dict({
        "type": "scene", "integrator": {"type": "nrf", "max_depth": -1 if phase is None else 2},
        "lamp": {"type": "point", "position": [0, 0, 0], "intensity": {"type": "rgb", "value": [1.0, 1.0, 1.0]}},
        "field": {"type": "sphere", "center": list(sphere.center), "radius": sphere.radius, "bsdf": {"type": "null"},
                  "interior": {"type": "nrf", "filename": str(path)}}})
    return scene


def _settings(settings: Settings, environment: bool) -> Settings:
    """Return the settings for many small pictures: shadows are marched, and lights of an environment sampled."""
    return replace(settings, hide_emitters=True, bounces="paths" if settings.bounces == "auto" else settings.bounces,
                   visibility="raymarch" if settings.visibility == "auto" else settings.visibility,
                   light_samples=settings.light_samples or LIGHT_SAMPLES * environment)


def _integrator(settings: Settings) -> Renderer:
    values = {name: value for name, value in vars(settings).items() if name in properties.INTEGRATOR and value != ""}
    integrator: Renderer = mi.load_dict({"type": "nrf", **values})
    return integrator

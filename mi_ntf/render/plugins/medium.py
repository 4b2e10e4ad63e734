"""Reflectance field inside a bounding shape (``nrf``, a medium).

=============== ========= ======== ============= =======================================================================
parameter       type      default  range         meaning
=============== ========= ======== ============= =======================================================================
filename        string    required a path        field file (``.safetensors``, of ``mi-ntf train`` or ``import``)
to_world        transform identity similarity    placement after `scale`: rotation, translation, uniform scale
scale           float     1        10⁻¹² to 10¹² scene units per capture unit
representation  string    grid     grid, network ``grid``: baked voxels; ``network``: the networks, exact and slower
resolution      integer   by field 16 to 1024    voxels per side of the baked grid; by default 192 to 512, two for each
                                                 texel of the density's planes, and more where skins are thinner
shadow_catcher  boolean   false                  the lights' shadows darken what the field emits; for fields of
                                                 ``mi-ntf import --emissive``
sample_emitters boolean   true                   as for any medium; for stock volumetric integrators
=============== ========= ======== ============= =======================================================================

``mi.traverse`` exposes `to_world`, with the flags of a shape's. An update moves the field. It bakes nothing again and
keeps its atlas, and compiles no kernel. The bounding shape has a `to_world` of its own, which has to move with it.
It also exposes the field at its voxels, in blocks of 8³:

================== ===================== ===== ========================================================================
name               shape                 flags meaning
================== ===================== ===== ========================================================================
log_density        blocks, 8, 8, 8       ∂     ln σ of a trained field, σ in 1/radius of its sphere; below ln 0.1 there
                                               is no matter
density            blocks, 8, 8, 8       ∂     σ of a field of voxels, 1/capture unit, in place of ``log_density``
albedo             blocks, 8, 8, 8, 3    ∂     linear RGB; ``emission``, the radiance, of a field that emits light
roughness          blocks, 8, 8, 8       ∂     of surfaces alone
specular           blocks, 8, 8, 8, 3    ∂     specular weight, linear RGB, of surfaces alone
normal             blocks, 8, 8, 8, 3    ∂, D  of surfaces alone, of any length; ``nrf`` has no derivative by it
density_blocks     blocks, 3             R     places of the density's blocks, x first, in blocks
reflectance_blocks blocks, 3             R     likewise of the reflectance
================== ===================== ===== ========================================================================

The voxels of a block have z first and x last. Density can be set where the field has bricks with matter. Reflectance
that is set is added to the field's own as a difference, trilinear between voxels. The softness of skins stays that of
the file. Derivatives by a density are those of the matter that is there: cells whose voxels are all empty have none,
although matter that is set there would be seen. Visibility methods of trained networks refuse a density that was set in
the scene.
Maps and atlases of such a density are made anew. Values are computed when they are read, or by the first ``update()``.
With ``representation`` ``network``, the tensors of the networks are shown, read-only.

The medium fills the sphere around the captured object, whose centre and radius in capture units are in the file. It
belongs inside one bounding shape with a ``null`` BSDF that encloses the object. Extinction is in inverse scene units.
A field of voxels, of ``mi-ntf import``, fills a box. It has no networks, so `representation` is ``grid``, `resolution`
is its own, and the visibility methods that are trained refuse it.
Every collision scatters (the single-scattering albedo is 1), with the field's reflectance as phase function. Smoke has
the phase function of Henyey and Greenstein in place of a surface's reflectance. Media may overlap: the ``nrf``
integrator adds their densities. Stock volumetric integrators know one medium at a time and are no reference there.

A `shadow_catcher` keeps the colours that its file emits, and the scene's lights stand for those of its photographs.
Each colour has as a factor the fraction of the lights' irradiance, from all sides and by red, green and blue, that
other fields, media and surfaces let through to the point. A `shadow_catcher` casts shadows on them, and none on
itself. Only ``nrf`` renders this.

A medium in a ``shapegroup`` lies where each ``instance`` places it, under the ``nrf`` integrator alone.

Does not support: several bounding shapes for one medium; shearing or non-uniform transforms; spectral extinction.
Source: neural reflectance fields, Bi et al. 2020.

.. code-block:: xml

    <shape type="sphere">
        <point name="center" x="0.101624" y="0.794786" z="0.000442"/> <float name="radius" value="1.002768"/>
        <bsdf type="null"/>
        <medium type="nrf" name="interior">
            <string name="filename" value="scenes/statue/field.safetensors"/>
        </medium>
    </shape>

.. code-block:: python

    {
        "type": "sphere",
        "center": [0.101624, 0.794786, 0.000442],
        "radius": 1.002768,
        "bsdf": {"type": "null"},
        "interior": {"type": "nrf", "filename": "scenes/statue/field.safetensors"},
    }
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Protocol
from weakref import WeakSet

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.architecture import MAX_LOG_DENSITY
from ...core.errors import MiNtfError
from ...infer.backend import module_of
from ...infer.grid import Density, GridField, NetworkVolume
from ...infer.phase_function import HenyeyGreenstein, smoke
from ...infer.shade import Reflectance
from ...infer.types import Color3, Float, Mask, Ray, Reflected, Vector, Vector3
from .. import log
from ..scene import loaded, traversal
from ..scene.field_parameters import FieldParameters
from ..scene.frame import SCALES, Frame
from ..scene.loaded import LoadedField
from . import properties

REPRESENTATIONS = ("grid", "network")


class Follower(Protocol):
    """Object that depends on the place and the field of a medium."""

    def follow(self, field_changed: bool) -> None:
        """Adapt to the new place, and to the new field if it has changed."""


class Reflects(Protocol):
    """Anything that has a reflectance at field points."""

    def reflectance(self, p: Vector, /) -> Reflected:
        """Return normal, albedo, roughness and specular weight."""


def _reflectance(source: Reflects, field: LoadedField) -> Callable[[Vector], Reflectance]:
    """Return the reflectance of field points as a function.

    The phase function holds it rather than the medium, which holds the phase function. The two would never be freed.
    """
    softness, emissive = field.softness, field.emissive
    back, tail = (None if v is None else dr.opaque(mi.Float, v) for v in (field.retro, field.tail))
    lobe = None if field.phase is None else HenyeyGreenstein(field.phase, module_of(mi.Float))

    def reflectance(x: Vector) -> Reflectance:
        if lobe and emissive:
            colour = source.reflectance(x)[1]
            black = tuple(dr.zeros(type(c), dr.width(c)) for c in colour)
            return smoke(black, lobe)._replace(emission=colour)
        if lobe:
            return smoke(source.reflectance(x)[1], lobe)
        return Reflectance(*source.reflectance(x), softness(x), back, tail)

    return reflectance


def _density(field: LoadedField, representation: str) -> Density:
    """Return the density of `field` in a `representation`, one of ``REPRESENTATIONS``."""
    if representation == "grid":
        return field.grid
    if not isinstance(field.grid, GridField):
        raise MiNtfError(f'nrf medium: representation is "network", but {field.name} is a field of voxels, which has '
                         "no networks; choose grid")
    return NetworkVolume(field.network, field.grid, math.exp(MAX_LOG_DENSITY))  # clipping alone bounds the networks


def medium_class(phase_class: type) -> type:
    """Return the plugin class for the current variant; `phase_class`: the variant's ``nrf`` phase function."""

    class NRFMedium(mi.Medium):
        __doc__ = __doc__

        is_nrf = True

        def __init__(self, props: mi.Properties) -> None:
            read = properties.Reader(props, "nrf medium", properties.MEDIUM)
            name = read.text("filename", "")
            if not name:
                raise MiNtfError(
                    'nrf medium: "filename" is missing; add <string name="filename" value="field.safetensors"/>'
                )
            path = name if loaded.is_in_memory(name) else log.resolve(name)
            to_world = read.placement("to_world")
            self._scale = read.number("scale", 1.0, *SCALES)
            self.representation = read.choice("representation", "grid", REPRESENTATIONS)
            self.resolution = read.whole("resolution", 0, 16, 1024) or None
            read.flag("sample_emitters", True)
            self.shadow_catcher = read.flag("shadow_catcher", False)
            self.field: LoadedField = loaded.load(path, self.resolution)
            if self.shadow_catcher and not self.field.emissive:
                raise MiNtfError(f"nrf medium: shadow_catcher is true, but {path} emits no light of its own; leave it "
                                 "out, or import the splats with --emissive")
            self._parameters: FieldParameters | None = None
            self.source: Density = _density(self.field, self.representation)
            self.reflectance = _reflectance(self.source, self.field)
            self.to_world = mi.Transform4f(mi.ScalarTransform4f(to_world))
            self.path = path
            phase = phase_class(mi.Properties("nrf"))
            props["phase"] = phase
            mi.Medium.__init__(self, props)
            self.phase = phase
            self.m_is_homogeneous = False
            self.m_has_spectral_extinction = False
            self.followers: WeakSet[Follower] = WeakSet()
            self._place(to_world)

        def _bound(self) -> None:
            """Prepare the majorant, and the box outside of which there is no matter."""
            self._majorant = dr.opaque(mi.Float, max(self.source.majorant, 1e-3) / self.frame.length)
            low, high = self.source.bounds
            self._low, self._high = (mi.Vector3f(*map(float, side)) for side in (low, high))
            dr.make_opaque(self._low, self._high)

        def _place(self, to_world: np.ndarray) -> None:
            """Move the field to `to_world`, a (4, 4) matrix."""
            self.frame = Frame(self.field.similarity, to_world, self._scale)
            self.phase.attach(self.frame, self.reflectance)
            self._density_unit = dr.opaque(mi.Float, 1 / self.frame.length)
            self._bound()

        def traverse(self, callback: mi.TraversalCallback) -> None:
            mi.Medium.traverse(self, callback)
            callback.put("to_world", self.to_world, mi.ParamFlags.Differentiable | mi.ParamFlags.Discontinuous)
            if self.representation == "network":
                for name, tensor in self.field.network.tensors().items():
                    callback.put(name, tensor, mi.ParamFlags.NonDifferentiable | mi.ParamFlags.ReadOnly)
                return
            if self._parameters or (not traversal.is_quiet() and self.source.majorant > 0):
                self.parameters.traverse(callback)

        def parameters_changed(self, keys: Sequence[str] = ()) -> None:
            # The method of the base class is empty, and would call this one a second time.
            parameters = self._parameters
            changed = parameters is not None and parameters.changed(keys)
            if parameters and changed:
                self.field = parameters.field
                self.source = self.field.grid
                self.reflectance = _reflectance(parameters.reflectance(self.field.grid), self.field)
            if changed or not keys or "to_world" in keys:
                self._place(np.array(dr.detach(self.to_world).matrix, np.float64).reshape(4, 4))
                for emitter in self.followers:
                    emitter.follow(changed)

        @property
        def parameters(self) -> FieldParameters:
            """Density and reflectance at voxels."""
            if self._parameters is None:
                self._parameters = FieldParameters(self.field)
            return self._parameters

        @property
        def attached(self) -> Sequence[str]:
            """Names of the field's parameters that carry gradients."""
            return self._parameters.attached() if self._parameters else ()

        @property
        def attached_log_density(self) -> Callable[[Vector], Float] | None:
            """Function of field points to ln σ with the gradients of the density; None if it has none."""
            return self._parameters.log_density if self._parameters else None

        def extinction(self, p: Vector3) -> Float:
            """Return σ_t at the scene points `p`, in 1/scene unit."""
            x = self.frame.point_to_field(p)
            sigma = self.source.density(x) * self._density_unit
            if self.attached_log_density is None:
                return sigma
            log_density = self.attached_log_density(x)
            return sigma * dr.exp(log_density - dr.detach(log_density))

        def intersect_aabb(self, ray: Ray) -> tuple[Mask, Float, Float]:
            o: Vector3 = mi.Vector3f(*self.frame.point_to_field(ray.o))
            inverse: Vector3 = mi.Vector3f(self.frame.unit) / mi.Vector3f(*self.frame.direction_to_field(ray.d))
            t1, t2 = (self._low - o) * inverse, (self._high - o) * inverse
            near, far = dr.max(dr.minimum(t1, t2)), dr.min(dr.maximum(t1, t2))
            return (near <= far) & (far >= 0), near, far

        def get_majorant(self, mei: mi.MediumInteraction3f, active: Mask = True) -> Color3:
            return mi.Spectrum(self._majorant)

        def get_scattering_coefficients(self, mei: mi.MediumInteraction3f, active: Mask = True
                                        ) -> tuple[Color3, Color3, Color3]:
            sigma = dr.minimum(self.extinction(mei.p), self._majorant)
            return mi.Spectrum(sigma), mi.Spectrum(self._majorant - sigma), mi.Spectrum(sigma)

        def to_string(self) -> str:
            return (
                f"NRFMedium[\n  filename = {self.path},\n  representation = {self.representation},\n"
                f"  center = {self.frame.origin.tolist()},\n  radius = {self.frame.length}\n]"
            )

    return NRFMedium

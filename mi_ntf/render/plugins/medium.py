"""The ``nrf`` medium."""

import math

import drjit as dr
import mitsuba as mi

from ...core.architecture import MAX_LOG_DENSITY
from ...core.errors import MiNtfError
from ...infer.grid import NetworkVolume
from ...infer.shade import Reflectance
from ..scene import loaded
from ..scene.frame import SCALES, Frame
from . import properties

REPRESENTATIONS = ("grid", "network")


def _reflectance(source, softness, fresnel: bool):
    """The :class:`mi_ntf.infer.shade.Reflectance` of field points, as a function. The phase function keeps it, and must
    not keep the medium, which keeps the phase function: nothing would ever let go of the two."""

    def reflectance(x):
        return Reflectance(*source.reflectance(x), softness(x), fresnel)

    return reflectance


def medium_class(phase_class: type) -> type:
    """The plugin class for the current variant; `phase_class`: the variant's ``nrf`` phase function."""

    class NRFMedium(mi.Medium):
        """A trained reflectance field inside a bounding shape (``nrf``).

        ================ ========= ====================================================================================
        parameter        type      meaning
        ================ ========= ====================================================================================
        filename         string    field file (``.safetensors``, written by ``mi-ntf train``)
        to_world         transform placement after `scale`; rotation, translation, uniform scale (default: identity)
        scale            float     scene units per capture unit, > 0 (default: 1)
        representation   string    ``grid``: baked voxels; ``network``: the networks, exact and slower (default: grid)
        resolution       integer   voxels per side of the baked grid, 16 to 1024 (default: by the field, 192 or more)
        sample_emitters  boolean   as of any medium: for stock volumetric integrators (default: true)
        ================ ========= ====================================================================================

        The medium fills the sphere around the captured object (the file's similarity: centre and radius in capture
        units). It belongs inside one bounding shape with a ``null`` BSDF that encloses the object. Extinction is in
        inverse scene units; every collision scatters (single-scattering albedo 1) with the field's reflectance as phase
        function. Media may overlap: the ``nrf`` integrator adds their densities. Stock volumetric integrators know one
        medium at a time, and are no reference there.

        Does not support: several bounding shapes for one medium; shearing or non-uniform transforms; spectral
        extinction. Source: neural reflectance fields, Bi et al. 2020.
        """

        is_nrf = True

        def __init__(self, props):
            read = properties.Reader(props, "nrf medium", properties.MEDIUM)
            name = read.text("filename", "")
            if not name:
                raise MiNtfError(
                    'nrf medium: "filename" is missing; add <string name="filename" value="field.safetensors"/>'
                )
            path = str(mi.file_resolver().resolve(name))
            to_world = read.placement("to_world")
            scale = read.number("scale", 1.0, *SCALES)
            self.representation = read.choice("representation", "grid", REPRESENTATIONS)
            resolution = read.whole("resolution", None, 16, 1024)
            read.flag("sample_emitters", True)
            self.field = loaded.load(path, resolution)
            grid, bound = self.field.grid, math.exp(MAX_LOG_DENSITY)  # the networks are bounded by their clipping alone
            self.source = grid if self.representation == "grid" else NetworkVolume(self.field.network, grid, bound)
            architecture = self.field.header.architecture
            self.reflectance = _reflectance(self.source, self.field.softness, architecture.fresnel)
            self.frame = Frame(self.field.header.similarity, to_world, scale)
            self.path = path
            phase = phase_class(mi.Properties("nrf"))
            phase.attach(self.frame, self.reflectance)
            props["phase"] = phase
            mi.Medium.__init__(self, props)
            self.phase = phase
            self.m_is_homogeneous = False
            self.m_has_spectral_extinction = False
            self._density_unit = dr.opaque(mi.Float, 1 / self.frame.length)
            self._majorant = dr.opaque(mi.Float, max(self.source.majorant, 1e-3) / self.frame.length)
            low, high = self.source.bounds
            self._low, self._high = (mi.Point3f(*map(float, side)) for side in (low, high))
            dr.make_opaque(self._low, self._high)

        def extinction(self, p):
            """σ_t at the scene point `p`, 1/scene unit."""
            return self.source.density(self.frame.point_to_field(p)) * self._density_unit

        def intersect_aabb(self, ray):
            o = mi.Vector3f(*self.frame.point_to_field(ray.o))
            inverse = dr.rcp(mi.Vector3f(*self.frame.direction_to_field(ray.d))) * self.frame.length
            t1, t2 = (self._low - o) * inverse, (self._high - o) * inverse
            near, far = dr.max(dr.minimum(t1, t2)), dr.min(dr.maximum(t1, t2))
            return (near <= far) & (far >= 0), near, far

        def get_majorant(self, mei, active=True):
            return mi.Spectrum(self._majorant)

        def get_scattering_coefficients(self, mei, active=True):
            sigma = dr.minimum(self.extinction(mei.p), self._majorant)
            return mi.Spectrum(sigma), mi.Spectrum(self._majorant - sigma), mi.Spectrum(sigma)

        def to_string(self):
            return (
                f"NRFMedium[\n  filename = {self.path},\n  representation = {self.representation},\n"
                f"  center = {self.frame.origin.tolist()},\n  radius = {self.frame.length}\n]"
            )

    return NRFMedium

"""Mitsuba's own participating media as the renderer sees them: voxels of extinction and a phase function."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from ...core.architecture import Similarity
from ...core.errors import MiNtfError
from ...core.mesh_voxels import fraction_inside
from ...core.spheres import fibonacci
from ...core.voxels import MARGIN, Voxels
from ...infer.backend import module_of
from ...infer.convex import Convex, box, planes_of
from ...infer.network import NOTHING
from ...infer.phase_function import smoke
from ...infer.shade import Reflectance
from ...infer.types import Array, Float, Vector, Vector3
from ...infer.volume import FAINTEST, Solid, VoxelVolume, dense
from .. import log
from . import medium_voxels
from .frame import Frame
from .loaded import LoadedField
from .recent import Recent, Version
from .traversal import traverse

BODY_VOXELS = 192
"""Voxels along the longest side of a mesh that is not convex or has many planes."""
DENSITY = ("sigma_t", "scale")
"""Parameters of a medium on which its extinction depends."""
_volumes: Recent[tuple[VoxelVolume, Frame]] = Recent()


class PhaseLobe:
    """A phase function of Mitsuba at scene points, for directions in the coordinates of `frame`."""

    def __init__(self, phase: mi.PhaseFunction, frame: Frame, p: Vector3) -> None:
        self._phase, self._frame, self._p = phase, frame, p

    def _interaction(self, wo: Vector) -> mi.MediumInteraction3f:
        mei = dr.zeros(mi.MediumInteraction3f)
        mei.p, mei.wi = self._p, self._frame.direction_to_world(wo)
        mei.sh_frame = mi.Frame3f(mei.wi)
        return mei

    def evaluate(self, wi: Vector, wo: Vector) -> tuple[Vector, Float]:
        """Return value and density of light scattered from `wi` to `wo` (:class:`mi_ntf.infer.shade.Lobe`)."""
        value, pdf = self._phase.eval_pdf(mi.PhaseFunctionContext(), self._interaction(wo),
                                          self._frame.direction_to_world(wi))
        return tuple(mi.Color3f(value)), pdf

    def sample(self, wo: Vector, u1: Float, u2: tuple[Float, Float]) -> Vector:
        """Return a direction to the light."""
        d, _, _ = self._phase.sample(mi.PhaseFunctionContext(), self._interaction(wo), u1, mi.Point2f(*u2))
        return self._frame.direction_to_field(d)


class StockMedium:
    """A ``homogeneous`` or ``heterogeneous`` medium inside `shape`, with the interface of the ``nrf`` medium.

    Notes
    -----
    The extinction is sampled at the medium's own voxels and interpolated as Mitsuba does. Albedo and phase function are
    evaluated by Mitsuba's plugins at the shading points.
    """

    representation = "grid"
    resolution = None
    shadow_catcher = False

    def __init__(self, shape: mi.Shape, medium: mi.Medium, name: str) -> None:
        self.path, self._medium = name, medium
        if mi.has_flag(medium.phase_function().flags(), mi.PhaseFunctionFlags.Microflake):
            raise MiNtfError(f"the medium of {name} has an sggx phase function, whose flakes give each direction "
                             "another extinction, which one density cannot hold; choose another phase function, or "
                             "render with volpath")
        volume_box = _volume_box(medium)
        self.source, self.frame = Version(shape).once(
            _volumes, lambda: _sampled(shape, medium, volume_box, name), str(mi.variant()), medium.class_name(),
            volume_box.tobytes())
        self.field = LoadedField(name, self.source, self.source.digest, self.source.digest)

    @property
    def attached(self) -> list[str]:
        """Names of the medium's parameters that carry gradients."""
        return [key for key, value in traverse(self._medium) if dr.grad_enabled(value)]

    @property
    def attached_log_density(self) -> Callable[[Vector], Float] | None:
        """Function of field points to ln σ with the gradients of the extinction; None if it has none."""
        if not any(key.split(".")[0] in DENSITY for key in self.attached):
            return None

        def log_density(x: Vector) -> Float:
            _, extinction = _coefficients(self._medium, self.frame.point_to_world(x))
            extinction = extinction * self.frame.length
            return dr.select(extinction > FAINTEST, dr.log(dr.maximum(extinction, FAINTEST)), NOTHING)

        return log_density

    def reflectance(self, x: Vector) -> Reflectance:
        """Return albedo and phase function at field points."""
        p = self.frame.point_to_world(x)
        scattering, extinction = _coefficients(self._medium, p)
        albedo = tuple(dr.select(extinction > 0, s / dr.maximum(extinction, 1e-30), 0) for s in scattering)
        dr.eval(p)
        return smoke(albedo, PhaseLobe(self._medium.phase_function(), self.frame, p))


def _coefficients(medium: mi.Medium, p: Vector3) -> tuple[Array, Float]:
    """Return σ_s (three channels) and σ_t (the red channel) at scene points, 1/scene unit."""
    mei = dr.zeros(mi.MediumInteraction3f, dr.width(p))
    mei.p = p
    scattering, _, extinction = medium.get_scattering_coefficients(mei)
    return mi.Color3f(scattering), mi.Color3f(extinction).x


def _volume_box(medium: mi.Medium) -> np.ndarray:
    """Return the corners (2, 3) of the box outside of which `medium` has no matter, infinite if there is none."""
    volume = medium_voxels.extinction_volume(medium)
    if medium.is_homogeneous() or volume is None:
        return np.array([[-np.inf] * 3, [np.inf] * 3])
    return np.array([volume.bbox().min, volume.bbox().max], np.float64).reshape(2, 3)


def _sampled(shape: mi.Shape, medium: mi.Medium, volume_box: np.ndarray, name: str) -> tuple[VoxelVolume, Frame]:
    """Return the density of `medium` inside `shape`, and its placement."""
    corners = np.array([shape.bbox().min, shape.bbox().max], np.float64).reshape(2, 3)
    low, high = np.maximum(corners[0], volume_box[0]), np.minimum(corners[1], volume_box[1])
    if not (high > low).all():
        raise MiNtfError(f"{name} and its medium do not overlap; give both the same to_world")
    ball = shape.class_name() == "Sphere"
    centre = corners.mean(0) if ball else (low + high) / 2
    radius = (corners[1, 0] - corners[0, 0]) / 2 if ball else np.linalg.norm(high - low) / 2
    frame = Frame(Similarity(tuple(centre), float(radius * MARGIN)), np.eye(4), 1.0)
    ends = (low - centre) / frame.length, (high - centre) / frame.length
    with log.Work("medium", f"sampling the medium of {name}"):
        values = medium_voxels.sampled(medium, low, high, name)
        bounded = np.isfinite(volume_box).all()
        body = (Convex(box(*ends) if bounded else np.zeros((0, 4)), 1 / MARGIN, module_of(mi.Float)) if ball
                else _mesh_body(shape, frame, ends, name))
    hull = fibonacci(400) / MARGIN * 1.01 if ball else _corners(*ends)
    header = Voxels(tuple(low), tuple(high), values.shape[::-1])
    values = values * np.float32(frame.length)
    even = np.ptp(values) == 0 and not isinstance(body, Solid)
    return VoxelVolume(dense(values), header, *ends, body, hull, module_of(mi.Float),
                       float(values.flat[0]) if even else None), frame


def _corners(low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return the eight corners (8, 3) of a box."""
    corners: np.ndarray = np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), -1).reshape(-1, 3)
    return corners


def _mesh_body(shape: mi.Shape, frame: Frame, ends: tuple[np.ndarray, np.ndarray], name: str) -> Convex:
    """Return the part of a closed mesh in the box between two corners, `ends`; refuse any other shape."""
    if not shape.is_mesh():
        raise MiNtfError(f"{name} holds a medium, but media fill spheres, cubes and closed meshes alone; give the "
                         "medium one of these shapes")
    mesh = cast(mi.Mesh, shape)
    vertices = np.array(mesh.vertex_positions_buffer(), np.float64).reshape(-1, 3)
    vertices = (vertices - frame.origin) / frame.length
    faces = np.array(mesh.faces_buffer()).reshape(-1, 3).astype(int)
    planes = planes_of(vertices, faces)
    if planes is not None:
        return Convex(np.concatenate([box(*ends), planes]), None, module_of(mi.Float))
    size = ends[1] - ends[0]
    counts = np.maximum(np.ceil(BODY_VOXELS * size / size.max()), 2).astype(int)
    return Solid(fraction_inside(vertices, faces, *ends, counts), *ends, module_of(mi.Float))

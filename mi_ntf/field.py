"""Fields and renderings from Python, as NumPy arrays or Dr.Jit arrays."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from . import importing, importing_splats
from .core.errors import MiNtfError
from .core.ops import Tensors
from .core.variants import VARIANTS
from .core.voxels import Voxels, named
from .data import grids, splat_files
from .infer.visibility.raymarch import RayMarch
from .render import register
from .render.maps import map_cache
from .render.scene import loaded
from .render.scene.frame import Frame

Array: TypeAlias = Any
"""Array of NumPy, or of Dr.Jit where the arguments are arrays of Dr.Jit."""


class Reflectance(NamedTuple):
    """Reflectance at `n` points.

    Attributes
    ----------
    normal
        Unit vectors in the coordinates of the capture, (n, 3); 0 for smoke.
    albedo
        Diffuse albedo in linear RGB, 0 to 1, (n, 3). For smoke, the fraction of light that is scattered.
    roughness
        Roughness of the specular lobe, 0 to 1, (n,); 1 for smoke.
    specular
        Weight of the specular lobe in linear RGB, 0 to 1, (n, 3); 0 for smoke. It is the reflectance at normal
        incidence of fields that are trained with a Fresnel effect.
    """

    normal: Array
    albedo: Array
    roughness: Array
    specular: Array


class Field:
    """A reflectance field. Use :meth:`load`, :meth:`from_grid` or :meth:`from_function` to make one.

    All coordinates are those of the capture, the world of the photographs. Points and directions are arrays of shape
    (n, 3), which give NumPy arrays, or Dr.Jit's ``Point3f`` and ``Vector3f``, which give Dr.Jit arrays.

    Attributes
    ----------
    path
        The field file; the name of a field in memory.
    center, radius
        Sphere around the object. The density outside of it is 0.
    phase
        Asymmetry g of smoke, whose phase function is that of Henyey and Greenstein; None for surfaces.
    """

    def __init__(self, path: Path, field: loaded.LoadedField,
                 memory: loaded.InMemory | None = None):
        similarity, self._memory = field.similarity, memory
        self.path = path
        self.center: np.ndarray = np.array(similarity.center, np.float64)
        self.radius = float(similarity.radius)
        self.phase: float | None = field.phase
        self._frame, self._grid = Frame(similarity, np.eye(4), 1.0), field.grid

    @classmethod
    def load(cls, path: str | Path, resolution: int | None = None) -> "Field":
        """Read a field file. The voxels are read from the cache, or baked first.

        Parameters
        ----------
        path
            Field file (``.safetensors``) of ``mi-ntf train``.
        resolution
            Voxels per side, 16 to 1024. By default it follows from the field.

        Raises
        ------
        MiNtfError
            If the file is missing or no field.
        """
        _ready()
        if resolution is not None and not 16 <= resolution <= 1024:
            raise MiNtfError(f"resolution is {resolution}, expected 16 to 1024 voxels per side")
        return cls(Path(path), loaded.load(str(path), resolution))

    @classmethod
    def from_grid(cls, density: ArrayLike, albedo: ArrayLike = 1.0,
                  bounds: ArrayLike = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), phase: float = 0.0) -> "Field":
        """Make a field of voxels in memory, without a file.

        Parameters
        ----------
        density
            Extinction at the centres of the voxels, 1/scene unit, (z, y, x), x fastest.
        albedo
            Single-scattering albedo, 0 to 1: a number, three numbers, or (z, y, x, 3) in linear RGB.
        bounds
            Lower and upper corner of the box that the voxels fill, x first.
        phase
            Asymmetry g of the phase function of Henyey and Greenstein.

        Raises
        ------
        MiNtfError
            If a value is out of range.

        Notes
        -----
        Scenes find the field as long as the object exists.
        """
        colours = np.asarray(albedo)
        constant = colours.ndim < 2
        grid = grids.checked(grids.Grid(np.asarray(density), np.asarray(bounds, np.float64),
                                        None if constant else colours), "from_grid")
        return cls.of_voxels(*importing.of_grid(grid, colours if constant else 1.0, phase))

    @classmethod
    def from_function(cls, sigma: Callable[[np.ndarray], ArrayLike],
                      albedo: ArrayLike | Callable[[np.ndarray], ArrayLike] = 1.0,
                      bounds: ArrayLike = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), phase: float = 0.0,
                      resolution: int = 128) -> "Field":
        """Make a field of voxels in memory, whose density is a function of points.

        Parameters
        ----------
        sigma
            Function of scene points, a NumPy array (n, 3), that returns their extinction (n,), 1/scene unit.
        albedo
            Likewise, a function that returns (n, 3), or one or three numbers.
        bounds
            Lower and upper corner of the box outside of which there is no matter.
        phase
            Asymmetry g of the phase function of Henyey and Greenstein.
        resolution
            Voxels along the longest side of the box, 2 to 1024. Voxels are about cubes.

        Raises
        ------
        MiNtfError
            If a value is out of range, or a function returns another shape.
        """
        if not 2 <= resolution <= 1024:
            raise MiNtfError(f"resolution is {resolution}, expected 2 to 1024 voxels along the longest side")
        low, high = grids.corners(bounds, "from_function")
        counts = np.maximum(np.ceil((high - low) / (high - low).max() * resolution - 1e-6), 1).astype(int)
        values = _at_centres(sigma, low, high, counts, 1, "sigma")[..., 0]
        colours = _at_centres(albedo, low, high, counts, 3, "albedo") if callable(albedo) else albedo
        return cls.from_grid(values, colours, (low, high), phase)

    @classmethod
    def from_splats(cls, path: str | Path, emissive: bool = False, resolution: int | None = None,
                    bounds: ArrayLike | None = None) -> "Field":
        """Make a field of voxels in memory of Gaussian splats.

        Parameters
        ----------
        path
            A ``.ply`` of Gaussian splatting, or an ``.spz``.
        emissive
            Keep the colours as emitted radiance. By default they are the albedo of a diffuse surface, with whatever
            light is baked into them.
        resolution
            Voxels along the longest side, 16 to 2048. By default it follows from the splats' sizes.
        bounds
            Lower and upper corner of a box outside of which splats are left out.

        Raises
        ------
        MiNtfError
            If the file is missing or damaged, or a value is out of range.
        """
        _ready()
        box = None if bounds is None else grids.corners(bounds, "from_splats")
        return cls.of_voxels(*importing_splats.of_splats(splat_files.read(path), resolution, emissive, str(path), box))

    @classmethod
    def of_voxels(cls, header: Voxels, density: Tensors, reflectance: Tensors | None = None) -> "Field":
        """Make a field in memory of the contents of a file of voxels (:func:`mi_ntf.core.voxels.save`)."""
        _ready()
        memory = loaded.InMemory(header, named(density, reflectance))
        return cls(Path(memory.name), loaded.load(memory.name, None), memory)

    def density(self, points: ArrayLike) -> Array:
        """Return the extinction coefficient at `points`, in 1/capture unit, (n,)."""
        sigma = self._grid.density(self._frame.point_to_field(_vectors(points))) / self._frame.length
        return _like(points, sigma)

    def transmittance(self, origins: ArrayLike, directions: ArrayLike, distance: ArrayLike = np.inf) -> Array:
        """Return the transmittance of rays, exp(−∫ σ dt), by a march in steps of an eighth of a voxel.

        Parameters
        ----------
        origins, directions
            (n, 3); directions are normalised.
        distance
            Length of the rays in capture units, one number or (n,). The default is infinite.

        Returns
        -------
        array of shape (n,)
            0 to 1. Optical depths above 12 count as opaque.
        """
        start, direction = _vectors(origins), dr.normalize(_vectors(directions))
        width = max(dr.width(start), dr.width(direction))
        length = mi.Float(distance) / self._frame.length
        step = 0.25 / self._grid.resolution
        march = RayMarch(self._grid, (step, step, 0.0))
        tau = march.tau(self._frame.point_to_field(start), self._frame.direction_to_field(direction), length, None,
                        dr.full(mi.Bool, True, width))
        return _like(origins, tau)

    def reflectance(self, points: ArrayLike) -> Reflectance:
        """Return normal, albedo, roughness and specular weight at `points`. They mean nothing where density is 0."""
        normal, albedo, roughness, specular = self._grid.reflectance(self._frame.point_to_field(_vectors(points)))
        values = self._frame.direction_to_world(normal), mi.Color3f(*albedo), roughness, mi.Color3f(*specular)
        return Reflectance(*(_like(points, value) for value in values))

    def shape(self) -> dict[str, Any]:
        """Return the field as a shape for ``mi.load_dict``: a sphere without surface, filled by the ``nrf`` medium."""
        return {"type": "sphere", "center": self.center.tolist(), "radius": self.radius, "bsdf": {"type": "null"},
                "interior": {"type": "nrf", "filename": str(self.path)}}


def relight(field: Field, *emitters: dict[str, Any], sensor: dict[str, Any] | None = None, size: int = 256,
            spp: int = 16, seed: int = 0, **integrator: Any) -> np.ndarray:
    """Render a field under any emitters of Mitsuba.

    Parameters
    ----------
    field
        The field.
    emitters
        Emitters for ``mi.load_dict``.
    sensor
        Sensor for ``mi.load_dict``. By default a perspective camera looks at the field along −z, y up.
    size
        Pixels per side of the default sensor's film.
    spp
        Samples per pixel.
    seed
        Seed of the random numbers.
    integrator
        Parameters of the ``nrf`` integrator, such as ``visibility``.

    Returns
    -------
    array of shape (height, width, 3)
        Linear RGB.
    """
    distance = 4 * field.radius
    camera = sensor or {
        "type": "perspective", "fov": 30.0,
        "to_world": mi.ScalarTransform4f().look_at(field.center + np.array([0, 0, distance]), field.center, [0, 1, 0]),
        "film": {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgb"}}
    lights = {f"emitter_{index}": emitter for index, emitter in enumerate(emitters)}
    scene = mi.load_dict({"type": "scene", "integrator": {"type": "nrf", **integrator}, "sensor": camera,
                          "field": field.shape(), **lights})
    return np.array(mi.render(scene, spp=spp, seed=mi.UInt32(seed)))[..., :3]


def clear_caches() -> None:
    """Free the fields and maps that this process keeps in memory. ``mi-ntf cache --clear`` empties the disk's cache."""
    loaded.forget()
    map_cache.forget()


def _ready() -> None:
    """Set a variant if there is none, and register the plugins."""
    if mi.variant() is None:
        mi.set_variant(*VARIANTS)
    register()


def _at_centres(function: Callable[[np.ndarray], ArrayLike], low: np.ndarray, high: np.ndarray, counts: np.ndarray,
                channels: int, name: str) -> np.ndarray:
    """Return the values (z, y, x, channels) of a function of points at the centres of voxels, layer by layer."""
    x, y, z = ((np.arange(n) + 0.5) / n * (b - a) + a for n, a, b in zip(counts, low, high, strict=True))
    result = np.empty((*counts[::-1], channels), np.float32)
    for layer, height in enumerate(z):
        points = np.stack(np.broadcast_arrays(x[None, :], y[:, None], height), -1).reshape(-1, 3)
        values = np.asarray(function(points))
        if values.shape not in [(len(points), channels)] + [(len(points),)] * (channels == 1):
            raise MiNtfError(f"{name} returned an array of shape {values.shape} for {len(points)} points, expected "
                             f"({len(points)}{', 3' if channels == 3 else ''},)")
        result[layer] = values.reshape(*result.shape[1:])
    return result


def _vectors(values: ArrayLike) -> "mi.Vector3f":
    if dr.is_array_v(values):
        return mi.Vector3f(values)
    return mi.Vector3f(np.atleast_2d(np.asarray(values, np.float32)).T)


def _like(points: ArrayLike, values: Any) -> Array:
    """Return `values` as NumPy array, (n,) or (n, 3), unless `points` belong to Dr.Jit."""
    if dr.is_array_v(points):
        return values
    array = np.array(values)
    return array.T if array.ndim == 2 else array

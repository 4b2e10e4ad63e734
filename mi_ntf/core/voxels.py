"""Fields of kind *voxels*: extinction and colour of any origin as sparse bricks, without networks.

The file is one ``.safetensors`` as that of a trained field. Its arrays are those of
:class:`mi_ntf.infer.bricks.Bricks`, under two prefixes:

    density.*       one channel: extinction σ, linear, 1/scene unit
    reflectance.*   3 channels: albedo; optional with `phase`
                    8 or 10: normal (3), albedo (3), roughness, specular weight (1 or 3)

Both are trilinear between the centres of their voxels, which fill the same box, and continue to its faces with the
values of the nearest centre, as in Mitsuba's ``gridvolume``.
"""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from . import files
from .architecture import FORMAT, KEY, Similarity
from .errors import MiNtfError, shown
from .json_values import Json, member, number, whole
from .ops import Tensors
from .spheres import MIN_HALF_CHORD

MARGIN = 1.00001 / (1 - MIN_HALF_CHORD**2) ** 0.5
"""Radius of the unit sphere over that of the matter: a ray that grazes the matter has a chord that counts."""
MAX_PHASE = 0.999
"""Largest |g|: the lobe of a larger one is narrower than a degree."""
MAX_SIDE = 1 << 12
"""Largest number of voxels along an axis."""
ARRAYS = ("index", "words", "range", "resolution")
"""Arrays of a :class:`mi_ntf.infer.bricks.Bricks`."""
Triple = tuple[float, float, float]
Counts = tuple[int, int, int]


@dataclass(frozen=True)
class Voxels:
    """Header of a field of kind *voxels*; every triple has x first.

    Attributes
    ----------
    low, high
        Corners of the box that the voxels fill, scene units.
    counts
        Number of voxels along each axis. The bricks' ``resolution`` is the largest.
    reflectance_counts
        Number of voxels of the reflectance along each axis; None: there is none, and `albedo` holds everywhere.
    phase
        Asymmetry g of the Henyey-Greenstein phase function; None: matter reflects as a surface (8 or 10 channels).
    albedo
        Single-scattering albedo, linear RGB, 0 to 1, where the file has no reflectance.
    emissive
        True if the three channels of the reflectance are emitted radiance, and the matter reflects nothing.
    provenance
        Free-form JSON about the origin.
    """

    low: Triple
    high: Triple
    counts: Counts
    reflectance_counts: Counts | None = None
    phase: float | None = 0.0
    albedo: Triple = (1.0, 1.0, 1.0)
    emissive: bool = False
    provenance: Json = field(default_factory=dict)

    @property
    def similarity(self) -> Similarity:
        """Return the transform to field coordinates: the unit sphere holds the box."""
        low, high = np.asarray(self.low, np.float64), np.asarray(self.high, np.float64)
        x, y, z = ((low + high) / 2).tolist()
        return Similarity((x, y, z), float(np.linalg.norm(high - low) / 2 * MARGIN))

    def to_json(self) -> Json:
        """Return the header as JSON."""
        described = asdict(self)
        return {"format": FORMAT, "provenance": described.pop("provenance"), "voxels": described}


def voxels_from_json(data: Json, source: str) -> Voxels:
    """Parse and check the header of a file of voxels; raise MiNtfError, whose text begins with `source`."""
    try:
        described = member(data, "voxels", dict)
        low, high = (_triple(described, name) for name in ("low", "high"))
        if not all(b - a > 1e-12 * max(abs(a), abs(b)) and b - a > 1e-30 for a, b in zip(low, high, strict=True)):
            raise ValueError(f"the box from {shown(low)} to {shown(high)} is empty")
        counts = _counts(described, "counts")
        reflectance = None if described.get("reflectance_counts") is None else _counts(described, "reflectance_counts")
        phase = described.get("phase")
        if phase is not None and abs(number(phase, "phase")) > MAX_PHASE:
            raise ValueError(f"phase is {shown(phase)}, expected −{MAX_PHASE} to {MAX_PHASE}")
        if phase is None and reflectance is None:
            raise ValueError("phase is None, but matter that reflects as a surface needs reflectance_counts")
        albedo = _triple(described, "albedo")
        if not all(0 <= value <= 1 for value in albedo):
            raise ValueError(f"albedo is {shown(albedo)}, expected 0 to 1")
        return Voxels(low, high, counts, reflectance, None if phase is None else float(phase), albedo,
                      member(described, "emissive", bool), member({"provenance": {}} | data, "provenance", dict))
    except ValueError as error:
        raise MiNtfError(f"{source}: the header's description is incomplete or wrong: {error}; "
                         "was it written by `mi-ntf import`?") from None


def save(path: str | Path, header: Voxels, density: Tensors, reflectance: Tensors | None = None) -> None:
    """Write a file of voxels atomically.

    Parameters
    ----------
    path
        The file, ``.safetensors``.
    header
        Box, number of voxels, phase function and origin.
    density, reflectance
        Results of :func:`mi_ntf.infer.bricks.pack` or ``of_dense``: linear extinction in 1/scene unit, and 3, 8
        or 10 channels of reflectance.

    Raises
    ------
    MiNtfError
        If header and arrays do not fit together, or the file cannot be written.
    """
    arrays = named(density, reflectance)
    check(str(path), header, arrays)
    data = {name: np.ascontiguousarray(value) for name, value in arrays.items()}
    files.write(path, safetensors.numpy.save(data, metadata={KEY: json.dumps(header.to_json())}))


def named(density: Tensors, reflectance: Tensors | None = None) -> Tensors:
    """Return the arrays of two sets of bricks by their names in a file."""
    parts = {"density": density} | ({} if reflectance is None else {"reflectance": reflectance})
    return {f"{part}.{name}": value for part, arrays in parts.items() for name, value in arrays.items()}


def load(path: str | Path, header: Voxels) -> Tensors:
    """Read and check the arrays of a file whose header is `header`; raise MiNtfError."""
    try:
        with safetensors.safe_open(path, "np") as file:
            arrays = {name: file.get_tensor(name) for name in file.keys()}
    except (safetensors.SafetensorError, TypeError, AttributeError) as error:  # the last two: types that NumPy lacks
        raise MiNtfError(f"{path} is no field file ({str(error)[:200]}); make it anew with `mi-ntf import`") from None
    check(str(path), header, arrays)
    return arrays


def describe(path: str | Path, header: Voxels) -> Json:
    """Return the header of a file with its sphere, and its largest ``extinction``, 1/scene unit."""
    low, step = load(path, header)["density.range"][:, 0].astype(float).tolist()
    return header.to_json() | {"similarity": asdict(header.similarity), "extinction": low + 0xFFFF * step}


def print_rest(description: Json) -> None:
    """Print the lines of ``mi-ntf info`` that a field of voxels has of its own."""
    of, record = description["voxels"], description["provenance"]
    low, high = ("(" + ", ".join(f"{value:.6g}" for value in of[name]) + ")" for name in ("low", "high"))
    print(f"voxels    {' × '.join(map(str, of['counts']))} from {low} to {high}, "
          f"extinction up to {description['extinction']:.4g}")
    lobe = "as a surface" if of["phase"] is None else f"phase function of asymmetry {of['phase']:g}"
    print(f"scatters  {lobe}")
    print(f"made of   {record.get('source', 'not known')}")
    print_refinement(record)


def print_refinement(provenance: Json) -> None:
    """Print the line of ``mi-ntf info`` on the refinement of a field, if its provenance has one."""
    record = provenance.get("refined")
    if isinstance(record, dict) and isinstance(record.get("parameters"), list):
        print(f"refined   {', '.join(map(str, record['parameters']))}, in {record.get('steps')} steps by "
              f"{record.get('photographs')} photographs")


def check(source: str, header: Voxels, arrays: Tensors) -> None:
    """Raise MiNtfError unless `arrays` are those of bricks, as many and as wide as `header` says."""
    voxels_from_json(json.loads(json.dumps(header.to_json())), source)
    parts: dict[str, tuple[Counts, tuple[int, ...]]] = {"density": (header.counts, (1,))}
    if header.reflectance_counts is not None:
        parts["reflectance"] = header.reflectance_counts, (3,) if header.phase is not None else (8, 10)
    expected = [f"{part}.{name}" for part in parts for name in ARRAYS]
    faults = [f"missing array {name}" for name in expected if name not in arrays]
    faults += [f"unknown array {name[:80]}" for name in arrays if name not in expected]
    if not faults:
        for part, (counts, channels) in parts.items():
            faults += brick_faults(part, {name: arrays[f"{part}.{name}"] for name in ARRAYS}, channels, max(counts))
    if faults:
        raise MiNtfError(f"{source} does not match its header: {'; '.join(faults[:4])}; "
                         "make it anew with `mi-ntf import`")


def brick_faults(part: str, arrays: Tensors, channels: Iterable[int], resolution: int | None = None) -> list[str]:
    """Return what is wrong with the `arrays` of one set of bricks called `part`, as far as their forms and ranges go.

    `channels` are the legal numbers of channels. None: any `resolution` of 2 or more is legal.
    """
    if set(arrays) != set(ARRAYS):
        return [f"its arrays {part} are {', '.join(sorted(arrays))[:80]}, expected {', '.join(ARRAYS)}"]
    size, ranges, stored = arrays["resolution"], arrays["range"], arrays["words"]
    faults = []
    whole = size.shape == (1,) and np.issubdtype(size.dtype, np.integer)
    if not whole or not (size[0] == resolution if resolution else 2 <= size[0] <= MAX_SIDE):
        faults.append(f"{part}.resolution is {shown(size.tolist())}, expected [{resolution or f'2 to {MAX_SIDE}'}]")
    if ranges.ndim != 2 or ranges.shape not in [(2, n) for n in channels] or stored.ndim != 5:
        faults.append(f"{part}.range has the shape {ranges.shape}, expected 2 × {' or '.join(map(str, channels))}")
    elif not np.issubdtype(ranges.dtype, np.floating) or not (np.abs(ranges.astype(np.float64)) < 1e30).all():
        faults.append(f"{part}.range has values that are no numbers below 1e30")
    elif part == "density" and (ranges < 0).any():
        faults.append("density.range allows a negative extinction")
    return faults


def _triple(data: Json, key: str) -> Triple:
    values = member(data, key, list)
    if len(values) != 3:
        raise ValueError(f"{key} is {shown(values)}, expected 3 numbers")
    x, y, z = (number(value, key) for value in values)
    return x, y, z


def _counts(data: Json, key: str) -> Counts:
    values = member(data, key, list)
    if len(values) != 3:
        raise ValueError(f"{key} is {shown(values)}, expected 3 numbers of voxels")
    x, y, z = (whole(value, key, 1, MAX_SIDE) for value in values)
    if max(x, y, z) < 2:
        raise ValueError(f"{key} is {shown(values)}, expected at least 2 voxels along an axis")
    return x, y, z

"""Field files: one ``.safetensors`` with a JSON header, checked against a skeleton. They hold no pickle."""

import json
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from . import files, quantities, voxels
from .architecture import FORMAT, KEY, Header, Network, header_from_json
from .errors import MiNtfError
from .json_values import Json
from .ops import Tensors

_BAKED = "baked."
"""Prefix of the names of arrays that were baked from the tensors (:func:`add_baked`), and their key in the metadata."""
_REFINED = {"reflectance": "refined.", "density": "refined_density."}
"""Quantity → prefix of the names of arrays that refine it (:func:`add_refinement`)."""
_PREFIXES = tuple(_REFINED.values())
REFINED_CHANNELS = {"albedo": 3, "roughness": 1, "specular": 3}
"""Channels of a reflectance's refinement, in their order; there is the albedo alone, or there are all."""
_LARGEST = 1e36
"""Upper bound of a network's sums, below which no order of summation overflows single precision."""


def save(path: str | Path, header: Header, tensors: Tensors, dtype: type = np.float16) -> None:
    """Write a field atomically; the names and shapes of `tensors` are ``header.architecture.skeleton()``.

    Planes are stored as `dtype`, layers as float32. Planes whose values `dtype` cannot hold are float32. float16 halves
    the file; interpolation and the perceptron smooth its rounding.
    """
    _check(str(path), header, tensors)
    files.write(path, safetensors.numpy.save(rounded(tensors, dtype), metadata={KEY: json.dumps(header.to_json())}))


def rounded(tensors: Tensors, dtype: type = np.float16) -> Tensors:
    """Return `tensors` in the number formats in which :func:`save` stores them."""
    return {k: np.ascontiguousarray(v, _fitting(v, dtype) if ".planes." in k else
                                    v.dtype if k.startswith(_PREFIXES) else np.float32) for k, v in tensors.items()}


def load(path: str | Path) -> tuple[Header, Tensors]:
    """Read header and tensors; raise one MiNtfError that names every mismatch with the header's skeleton.

    Tensors of networks are float32. The arrays of a refinement, if any, are among the tensors (:func:`refinement`).
    """
    header = load_header(path)
    if isinstance(header, voxels.Voxels):
        raise MiNtfError(f"{path} is a field of voxels, which has no networks; give a file of `mi-ntf train`")
    try:
        with safetensors.safe_open(path, "np") as file:
            tensors = {k: file.get_tensor(k) for k in file.keys() if not k.startswith(_BAKED)}
    except (safetensors.SafetensorError, TypeError, AttributeError) as error:  # the last two: types that NumPy lacks
        raise MiNtfError(f"{path} is no field file ({str(error)[:200]}); make it anew with `mi-ntf train`") from None
    _check(str(path), header, tensors)
    return header, {k: v if k.startswith(_PREFIXES) else v.astype(np.float32) for k, v in tensors.items()}


def refinement(tensors: Tensors, quantity: str) -> Tensors:
    """Return the arrays that refine ``reflectance`` or ``density`` among a field's tensors, named as in bricks.

    The result is empty if none do.
    """
    prefix = _REFINED[quantity]
    return {k.removeprefix(prefix): v for k, v in tensors.items() if k.startswith(prefix)}


def add_refinement(path: str | Path, output: str | Path, arrays: dict[str, Tensors], record: Json) -> None:
    """Write the field file `path` as `output` with a refinement, in place of any older one.

    Parameters
    ----------
    path, output
        Field files, which may be the same.
    arrays
        By quantity, differences from what the networks give, as arrays of a :class:`mi_ntf.infer.bricks.Bricks`.
        ``reflectance`` has the channels of ``REFINED_CHANNELS``, ``density`` the difference of ln σ.
    record
        Entry ``refined`` of the provenance.
    """
    header, _ = load(path)
    with safetensors.safe_open(path, "np") as file:
        data = {k: file.get_tensor(k) for k in file.keys() if not k.startswith((_BAKED, *_PREFIXES))}
    for quantity, differences in arrays.items():
        data |= {_REFINED[quantity] + k: np.ascontiguousarray(v) for k, v in differences.items()}
    _check(str(output), header, data)
    described = header.to_json()
    described["provenance"] = described["provenance"] | {"refined": record}
    files.write(output, safetensors.numpy.save(data, metadata={KEY: json.dumps(described)}))


def add_baked(path: str | Path, arrays: Tensors, stamp: str) -> None:
    """Store `arrays` that were baked from a field in its file, in place of any older ones.

    `stamp` identifies the inputs and version of the bake (:func:`load_baked`). Tensors keep their number formats.
    """
    load(path)
    with safetensors.safe_open(path, "np") as file:
        data = {k: file.get_tensor(k) for k in file.keys() if not k.startswith(_BAKED)}
        metadata = file.metadata()
    data |= {_BAKED + k: np.ascontiguousarray(v) for k, v in arrays.items()}
    files.write(path, safetensors.numpy.save(data, metadata=metadata | {_BAKED: stamp}))


def load_baked(path: str | Path, stamp: str) -> Tensors | None:
    """Return the baked arrays of a field file; None if it has none, or if they have another stamp."""
    with safetensors.safe_open(path, "np") as file:
        if (file.metadata() or {}).get(_BAKED) != stamp:
            return None
        return {k.removeprefix(_BAKED): file.get_tensor(k) for k in file.keys() if k.startswith(_BAKED)}


def load_header(path: str | Path) -> Header | voxels.Voxels:
    """Read the header without the tensors; that of a field of voxels is another class."""
    if not Path(path).is_file():
        raise MiNtfError(f"field file {path} does not exist; make one with `mi-ntf train DATASET -o {Path(path).name}`")
    try:
        with safetensors.safe_open(path, "np") as file:
            metadata = file.metadata() or {}
    except safetensors.SafetensorError as error:
        raise MiNtfError(f"{path} is no field file or is truncated ({str(error)[:200]}); "
                         "make it anew with `mi-ntf train`") from None
    if KEY not in metadata:
        raise MiNtfError(f"{path} is a safetensors file of another program (no '{KEY}' header); "
                         "pass a file of `mi-ntf train`")
    try:
        data = json.loads(metadata[KEY])
    except (ValueError, RecursionError) as error:
        raise MiNtfError(f"{path}: header is not JSON ({error}); make the file anew with `mi-ntf train`") from None
    if isinstance(data, dict) and data.get("format") == FORMAT and "voxels" in data:
        return voxels.voxels_from_json(data, str(path))
    return header_from_json(data, str(path))


def describe(path: str | Path) -> Json:
    """Return the table of `mi-ntf info`: header, parameter counts, file size in bytes."""
    first = load_header(path)
    if isinstance(first, voxels.Voxels):
        return {"file": str(path), "bytes": Path(path).stat().st_size} | voxels.describe(path, first)
    header, tensors = load(path)
    counts = {name: sum(v.size for k, v in tensors.items() if k.startswith(name + ".")) for name in
              header.architecture.networks()}
    return {"file": str(path), "bytes": Path(path).stat().st_size, "parameters": counts} | header.to_json()


def print_summary(description: Json) -> None:
    """Print the result of :func:`describe` in six lines; the sphere is XML to paste into a scene."""
    sphere, record = description["similarity"], description["provenance"]
    x, y, z = (f"{value:.7g}" for value in sphere["center"])
    content = ("voxels" if "voxels" in description else
               f"{quantities.count(sum(description['parameters'].values()))} parameters")
    print(f"field     {description['file']}, {quantities.size(description['bytes'])}, {content}")
    print(f'sphere    <point name="center" x="{x}" y="{y}" z="{z}"/>')
    print(f'          <float name="radius" value="{sphere["radius"]:.7g}"/>')
    if "voxels" in description:
        return voxels.print_rest(description)
    print(f"networks  {', '.join(description['parameters'])}")
    scores = {name: _number(record, split, "srgb") for split, name in (("val", "validation"), ("test", "test"))}
    words = [f"{score:.1f} dB on {name} photographs" for name, score in scores.items() if score is not None]
    print(f"PSNR      {', '.join(words) or 'not known'}")
    print(f"trained   {_training(record) or 'not known'}")
    voxels.print_refinement(record)


def _training(record: Json) -> str:
    """Return what a field's provenance says of its training; that of ``field`` came before, of transmittance alone."""
    words = [f"preset {record['preset']}"] if "preset" in record else []
    whole = record.get("field", record)
    steps, seconds, photographs = (_number(data, *keys) for data, *keys in (
        (whole, "steps_done"), (whole, "seconds"), (record, "views", "train")))
    if steps is not None and seconds is not None:
        words.append(f"{steps:.0f} steps in {quantities.duration(seconds)}")
    if whole is not record and (alone := _number(record, "steps_done")) is not None:
        words.append(f"{alone:.0f} of transmittance alone")
    if photographs is not None:
        words.append(f"{photographs:.0f} photographs")
    return ", ".join(words)


def _number(data: object, *keys: str) -> float | None:
    """Return a number of JSON that may have any form, None if it is not there."""
    for key in keys:
        data = data.get(key) if isinstance(data, dict) else None
    return float(data) if isinstance(data, int | float) else None


def _check(source: str, header: Header, tensors: Tensors) -> None:
    skeleton = header.architecture.skeleton()
    faults = [f"missing tensor {k}" for k in skeleton if k not in tensors]
    faults += [f"unknown tensor {k[:80]}" for k in tensors if k not in skeleton and not k.startswith(_PREFIXES)]
    counts = np.cumsum(list(REFINED_CHANNELS.values())).tolist()
    for quantity, channels in (("reflectance", (counts[0], counts[-1])), ("density", (1,))):
        if refined := refinement(tensors, quantity):
            faults += voxels.brick_faults(_REFINED[quantity].removesuffix("."), refined, channels)
    for name, shape in skeleton.items():
        if name not in tensors:
            continue
        value = tensors[name]
        if value.shape != shape:
            faults.append(f"{name}: expected shape {shape}, found {value.shape}")
        elif not np.issubdtype(value.dtype, np.floating):
            faults.append(f"{name}: expected floating point, found {value.dtype}")
        elif bad := np.count_nonzero(~(np.abs(value) <= np.finfo(np.float32).max)):
            faults.append(f"{name}: {bad} values are NaN or infinite in single precision")
    if not faults:
        reach = {name: _reach(name, net, tensors) for name, net in header.architecture.networks().items()}
        faults += [f"{name}: its weights lead to values of {most:.1e}, more than {_LARGEST:g}"
                   for name, most in reach.items() if not most <= _LARGEST]
    if faults:
        more = f"; and {len(faults) - 8} more" if len(faults) > 8 else ""
        raise MiNtfError(f"{source} does not match its architecture: " + "; ".join(faults[:8]) + more +
                         ". Train or export the field anew")


def _reach(name: str, network: Network, tensors: Tensors) -> float:
    """Return an upper bound of the values in a network's layers for any point, ray or direction of the unit sphere."""
    size = {k: np.abs(v) for k, v in tensors.items() if k.startswith(f"{name}.")}
    planes = [np.prod(size[f"{name}.planes.{i}"].max((1, 2)), 0, np.float64).max()
              for i in range(len(network.encoding.resolutions))]
    most = largest = float(max([8.0, *planes]))  # other encodings (coordinates, sines, logarithms) stay below 8
    for i in range(len(network.hidden) + 1):
        weight, bias = (size[f"{name}.layers.{i}.{part}"] for part in ("weight", "bias"))
        most = float((weight.sum(1, np.float64) * most + bias).max())
        largest = max(largest, most)
    return largest


def _fitting(value: np.ndarray, dtype: type) -> type:
    """Return `dtype`, or float32 if `dtype` cannot hold `value`."""
    return dtype if np.abs(value).max() <= np.finfo(dtype).max else np.float32

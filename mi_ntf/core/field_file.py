"""Field files: one ``.safetensors`` with a JSON header, checked against a skeleton. No pickle is ever read."""

import json
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy

from . import files
from .architecture import Header, header_from_json
from .errors import MiNtfError

_KEY = "mi_ntf"


def save(path: str | Path, header: Header, tensors: dict[str, np.ndarray], dtype: type = np.float16) -> None:
    """Write a field atomically. `tensors`: name → array, exactly ``header.architecture.skeleton()``.

    Planes are stored as `dtype`, layers as float32. float16 keeps 11 bits of features that bilinear
    interpolation and a trained perceptron smooth anyway and halves the file.
    """
    _check(str(path), header, tensors)
    with np.errstate(over="ignore"):  # a float16 overflow is reported by the check below, by name
        data: dict[str, np.ndarray] = {
            k: np.ascontiguousarray(v, dtype if ".planes." in k else np.float32) for k, v in tensors.items()}
    _check(f"{path} as {np.dtype(dtype).name}", header, data)
    files.write(path, safetensors.numpy.save(data, metadata={_KEY: json.dumps(header.to_json())}))


def load(path: str | Path) -> tuple[Header, dict[str, np.ndarray]]:
    """Read a field: header and float32 tensors. Every mismatch with the header's skeleton is named in one error."""
    header = load_header(path)
    tensors = safetensors.numpy.load_file(path)
    _check(str(path), header, tensors)
    return header, {k: v.astype(np.float32) for k, v in tensors.items()}


def load_header(path: str | Path) -> Header:
    """Read the header alone."""
    if not Path(path).is_file():
        raise MiNtfError(f"field file {path} does not exist; make one with `mi-ntf train DATASET -o {Path(path).name}`")
    try:
        with safetensors.safe_open(path, "np") as file:
            metadata = file.metadata() or {}
    except safetensors.SafetensorError as error:
        raise MiNtfError(f"{path} is no field file or is truncated ({error}); "
                         "make it anew with `mi-ntf train`") from None
    if _KEY not in metadata:
        raise MiNtfError(f"{path} is a safetensors file of another program (no '{_KEY}' header); "
                         "pass a file of `mi-ntf train`")
    try:
        data = json.loads(metadata[_KEY])
    except json.JSONDecodeError as error:
        raise MiNtfError(f"{path}: header is not JSON ({error}); make the file anew with `mi-ntf train`") from None
    return header_from_json(data, str(path))


def describe(path: str | Path) -> dict:
    """What `mi-ntf info` prints: header, parameter counts, file size in bytes."""
    header, tensors = load(path)
    counts = {name: sum(v.size for k, v in tensors.items() if k.startswith(name + ".")) for name in
              header.architecture.networks()}
    return {"file": str(path), "bytes": Path(path).stat().st_size, "parameters": counts} | header.to_json()


def _check(source: str, header: Header, tensors: dict[str, np.ndarray]) -> None:
    skeleton = header.architecture.skeleton()
    faults = [f"missing tensor {k}" for k in skeleton if k not in tensors]
    faults += [f"unknown tensor {k}" for k in tensors if k not in skeleton]
    for name, shape in skeleton.items():
        if name not in tensors:
            continue
        value = tensors[name]
        if value.shape != shape:
            faults.append(f"{name}: expected shape {shape}, found {value.shape}")
        elif not np.issubdtype(value.dtype, np.floating):
            faults.append(f"{name}: expected floating point, found {value.dtype}")
        elif not np.isfinite(value).all():
            faults.append(f"{name}: {np.count_nonzero(~np.isfinite(value))} values are NaN or infinite")
    if faults:
        raise MiNtfError(f"{source} does not match its architecture: " + "; ".join(faults) +
                         ". Train or export the field anew")

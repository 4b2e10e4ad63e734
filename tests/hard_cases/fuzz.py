"""A batch of damaged files, in a process of its own: ``fuzz.py KIND SEED FIRST LAST FOLDER``.

For each case a line of JSON before it begins and one when it has ended; a process that dies leaves the first alone.
Memory is limited to what the process has after its start and `ROOM` bytes.
"""

import faulthandler
import json
import os
import pickle
import resource
import struct
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from helpers import mutate
from helpers.variants import VARIANT

from mi_ntf.core import errors, field_file, reference
from mi_ntf.core.architecture import Architecture, Encoding, Header, Network, Similarity
from mi_ntf.core.errors import MiNtfError

ROOM = 512 << 20
"""For files of at most 100 kB: threads reserve the most of it for their stacks."""


class Payload:
    """Leaves a trace where somebody unpickles it."""

    def __init__(self, marker: Path):
        self.marker = marker

    def __reduce__(self):
        return Path.touch, (self.marker,)


def pickled(folder: Path) -> bytes:
    return pickle.dumps(Payload(folder / "EXECUTED"))


# --- field files ------------------------------------------------------------------------------------------------------

PLANES = Architecture(
    density=Network(Encoding("planes", (4, 6), 2), (5,)),
    reflectance=Network(Encoding("frequency", octaves=2), (4, 3)),
    transmittance=Network(Encoding("depth"), (7,), components=2),
    visibility=Network(Encoding("frequency", octaves=1), (3,)),
)
ENDS = Architecture(
    density=Network(Encoding("frequency", octaves=3), (6, 6)),
    reflectance=Network(Encoding("planes", (5,), 3), (4,)),
    transmittance=Network(Encoding("frequency", octaves=2), (7,)),
)


def field(folder: Path):
    """Bytes and headers of field files."""
    bases = []
    for i, architecture in enumerate((PLANES, ENDS)):
        rng = np.random.default_rng(i)
        tensors = {k: np.float32(rng.normal(size=s)) for k, s in architecture.skeleton().items()}
        header = Header(architecture, Similarity((0.5, -1.0, 2.0), 3.0), {"views": 7})
        field_file.save(folder / "base", header, tensors)
        bases.append(((folder / "base").read_bytes(), header.to_json()))
    return bases


def safetensors_bytes(entries: dict, body: bytes) -> bytes:
    text = json.dumps(entries).encode("utf-8", "surrogatepass")
    return struct.pack("<Q", len(text)) + text + body


def field_case(rng, folder: Path, bases):
    data, header = bases[rng.integers(0, len(bases))]
    size = struct.unpack("<Q", data[:8])[0]
    entries, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    kind = rng.choice(["bytes", "header", "entries", "values", "pickle"], p=[0.3, 0.4, 0.15, 0.1, 0.05])
    if kind == "bytes":
        data = mutate.blob(rng, data, head=size)
    elif kind == "header":
        entries["__metadata__"]["mi_ntf"] = json.dumps(mutate.tree(rng, header))
        data = safetensors_bytes(entries, body)
    elif kind == "entries":
        data = safetensors_bytes(mutate.tree(rng, entries), body)
    elif kind == "values":
        floats = np.frombuffer(body, np.float16).copy()
        where = rng.integers(0, len(floats), 3)
        floats[where] = rng.choice([np.nan, np.inf, -np.inf, 65504, -65504, 6e-8, 0], 3)
        data = safetensors_bytes(entries, floats.tobytes())
    else:
        data = pickled(folder) if rng.random() < 0.5 else safetensors_bytes(entries, pickled(folder))
    path = folder / "case.safetensors"
    path.write_bytes(data)

    def attempt():
        field_file.describe(path)
        header, tensors = field_file.load(path)
        check_finite(header.architecture, tensors)

    return str(kind), attempt


def check_finite(architecture: Architecture, tensors: dict) -> None:
    """Check that a loaded file evaluates to numbers in single precision."""
    rng = np.random.default_rng(0)
    x, d = rng.uniform(-1, 1, (64, 3)), rng.normal(size=(64, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    places, total = np.sort(rng.uniform(-1, 1, (7, 64)), 0), rng.uniform(0, 9, 64)
    values = [reference.density(architecture, tensors, x), reference.reflectance(architecture, tensors, x)]
    _, parts = reference.ray_mixture(architecture, tensors, x / 2, d, places, total)
    values += [v for part in parts for v in part]
    if architecture.visibility is not None:
        values.append(reference.visibility(architecture, tensors, x, d))
    for value in values:
        assert np.isfinite(np.float32(value)).all(), "a field that loads is not finite"


# --- fields of voxels, and grids that are imported -------------------------------------------------------------------


def voxels(folder: Path):
    """Bytes of a field file of voxels, and the variant that loads it."""
    import mitsuba as mi

    from mi_ntf.importing import import_grid

    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    np.savez(folder / "base.npz", density=DENSITY, albedo=np.full((5, 4, 3, 3), 0.5))
    import_grid(folder / "base.npz", folder / "base.safetensors", phase=0.4, bounds="0,0,0,1,2,3")
    return (folder / "base.safetensors").read_bytes()


def voxels_case(rng, folder: Path, data):
    from mi_ntf.render.scene import loaded

    size = struct.unpack("<Q", data[:8])[0]
    entries, body = json.loads(data[8 : 8 + size]), data[8 + size :]
    kind = rng.choice(["bytes", "header", "entries", "values"], p=[0.3, 0.4, 0.15, 0.15])
    if kind == "bytes":
        data = mutate.blob(rng, data, head=size)
    elif kind == "header":
        entries["__metadata__"]["mi_ntf"] = json.dumps(mutate.tree(rng, json.loads(entries["__metadata__"]["mi_ntf"])))
        data = safetensors_bytes(entries, body)
    elif kind == "entries":
        data = safetensors_bytes(mutate.tree(rng, entries), body)
    else:
        data = safetensors_bytes(entries, mutate.blob(rng, body, head=200))
    path = folder / "case.safetensors"
    path.write_bytes(data)

    def attempt():
        field_file.describe(path)
        loaded.forget()
        grid = loaded.load(str(path), None).grid
        import mitsuba as mi

        x = tuple(mi.Float(c) for c in np.random.default_rng(0).uniform(-1, 1, (3, 64)).astype(np.float32))
        assert np.isfinite(np.array(grid.density(x))).all(), "a field that loads is not finite"

    return str(kind), attempt


DENSITY = np.random.default_rng(1).uniform(0, 3, (5, 4, 3)).astype(np.float32)


def grid(folder: Path):
    """Bytes of a grid of each form by the ending, and arrays of an archive that another program could write."""
    import mi_ntf.importing  # noqa: F401, for the limit of memory to count it
    from mi_ntf.data import grids

    grids.write_vol(folder / "base.vol", DENSITY, np.array([[0, 0, 0], [1, 2, 3.0]]))
    np.save(folder / "base.npy", DENSITY)
    archives = {
        "dense": {"density": DENSITY, "albedo": np.full((5, 4, 3, 3), 0.5), "bounds": np.array([[0, 0, 0], [1, 2, 3]])},
        "rgba": {"rgba": np.full((5, 4, 3, 4), 0.5)},
        "nerfacc": {"occs": DENSITY.ravel(), "aabbs": np.array([[0, 0, 0, 1, 1, 1]]),
                    "resolution": np.array([5, 4, 3])},
        "plenoxels": {"links": np.arange(60).reshape(5, 4, 3) - 9, "density_data": DENSITY.reshape(-1, 1),
                      "sh_data": np.zeros((60, 27), np.float16), "center": np.zeros(3), "radius": np.ones(3)},
    }
    return {suffix: (folder / f"base{suffix}").read_bytes() for suffix in (".vol", ".npy")}, archives


def grid_case(rng, folder: Path, base):
    from mi_ntf.importing import import_grid

    files, archives = base
    suffix = str(rng.choice([".vol", ".npy", ".npz", ".vdb"], p=[0.3, 0.2, 0.45, 0.05]))
    path, name = folder / f"case{suffix}", suffix
    if suffix == ".npz":
        name = str(rng.choice(sorted(archives)))
        arrays = dict(archives[name])
        if rng.random() < 0.7:
            victim = str(rng.choice(sorted(arrays)))
            arrays[victim] = other_array(rng, arrays[victim])
        np.savez(path, **arrays)
        if rng.random() < 0.5:
            path.write_bytes(mutate.blob(rng, path.read_bytes(), head=200))
    elif rng.random() < 0.1:
        path.write_bytes(pickled(folder) if rng.random() < 0.5 else rng.bytes(200))
    elif suffix == ".npy" and rng.random() < 0.5:
        np.save(path, other_array(rng, DENSITY))
    else:
        path.write_bytes(mutate.blob(rng, files.get(suffix, b"VDB file"), head=80))
    order = str(rng.choice(["zyx", "xyz"]))
    return name, lambda: import_grid(path, folder / "out.safetensors", order=order)


def other_array(rng, values: np.ndarray) -> np.ndarray:
    """Return `values` of another shape, type or range."""
    kind = rng.integers(0, 7)
    if kind == 0:
        return values.ravel()[: rng.integers(0, values.size + 1)]
    if kind == 1:
        return values[None] if rng.random() < 0.5 else values[..., None]
    if kind == 2:
        return values.astype(rng.choice(["U4", "S4", "c8", "f2", "i8", "u1", "?"]))
    if kind == 3:
        result = np.array(values, np.float64)
        result[rng.random(values.shape) < 0.3] = rng.choice([np.nan, np.inf, -1, 1e39, 2, 1e9])
        return result
    if kind == 4:
        return np.array(mutate.VALUES[rng.integers(0, 16)], np.float64)
    return -values.astype(np.float64) if kind == 5 else np.zeros_like(values)


# --- data sets --------------------------------------------------------------------------------------------------------


def dataset(folder: Path):
    """Return a data set of each form, cut to a few frames (LLFF whole); one set has a lens with distortion."""
    import cv2  # noqa: F401, for the limit of memory to count it
    from data import forms

    bases = {}
    for form in (forms.capture, forms.blender, forms.nrhints, forms.nerfstudio):
        place = folder / form.__name__
        form(place)
        splits = {}
        for path in sorted(place.glob("transforms*.json")):
            splits[path.name] = json.loads(path.read_text())
            splits[path.name]["frames"] = splits[path.name]["frames"][:6]
        bases[form.__name__] = (place, splits)
    splits["transforms.json"] |= {"k1": 0.02, "train_filenames": [], "val_filenames": ["images/frame_00002.png"],
                                  "test_filenames": ["images/frame_00004.png"]}
    place = forms.llff(folder / "llff")
    bases["llff"] = (place, {"poses_bounds.npy": (place / "poses_bounds.npy").read_bytes()})
    return bases


def dataset_case(rng, _folder: Path, bases):
    from mi_ntf.data.readers import load_dataset

    form = str(rng.choice(sorted(bases)))
    place, splits = bases[form]
    victim = str(rng.choice(sorted(splits), p=[0.15, 0.7, 0.15] if len(splits) == 3 else None))
    kind = rng.choice(["tree", "bytes", "folder"], p=[0.75, 0.2, 0.05])
    kind = "bytes" if form == "llff" and kind == "tree" else kind
    for name, data in splits.items():
        (place / name).write_bytes(data if form == "llff" else json.dumps(data).encode())
    if kind == "tree":
        (place / victim).write_text(json.dumps(mutate.tree(rng, splits[victim])))
    elif kind == "bytes":
        (place / victim).write_bytes(mutate.blob(rng, (place / victim).read_bytes()))
    else:
        (place / victim).unlink()
    return f"{form} {kind}", lambda: check_splits(load_dataset(place, say=lambda text: None))


def check_splits(splits: dict) -> None:
    for split in splits.values():
        for value in vars(split).values():
            assert value is split.names or np.isfinite(value).all(), "a data set that loads is not finite"


# --- COLMAP -----------------------------------------------------------------------------------------------------------


def colmap(folder: Path):
    """Files of a model with a lens by name, as text and in binary; the photographs are beside it."""
    import cv2  # noqa: F401, for the limit of memory to count it
    import pycolmap
    from data import forms

    place = folder / "colmap"
    forms.colmap(place, "OPENCV")
    model = place / "sparse" / "0"
    text = {p.name: p.read_bytes() for p in model.iterdir()}
    pycolmap.Reconstruction(str(model)).write_binary(str(model))
    binary = {p.name: p.read_bytes() for p in model.glob("*.bin")}
    return place, {"text": text, "binary": binary}


def colmap_case(rng, _folder: Path, base):
    from mi_ntf.data.readers import load_dataset

    place, models = base
    form = str(rng.choice(sorted(models)))
    victim = str(rng.choice(sorted(models[form])))
    model = place / "sparse" / "0"
    for old in model.iterdir():
        old.unlink()
    for name, data in models[form].items():
        (model / name).write_bytes(data)
    if rng.random() < 0.03:
        (model / victim).unlink()
    elif form == "text" and rng.random() < 0.6:
        (model / victim).write_text(mutate.words(rng, models[form][victim].decode()))
    else:
        (model / victim).write_bytes(mutate.blob(rng, models[form][victim], head=100))
    return f"{form} {victim}", lambda: check_splits(load_dataset(place, say=lambda text: None))


# --- properties of the plugins ----------------------------------------------------------------------------------------

SCENE = """<scene version="3.9.0"><integrator type="nrf">{integrator}</integrator>
  <emitter type="ntf">{emitter}<emitter type="point"/><ref id="m"/></emitter>
  <medium type="nrf" id="m"><string name="filename" value="{path}"/>{medium}</medium>
  <shape type="sphere"><bsdf type="null"/><medium type="nrf" name="interior">
    <string name="filename" value="{path}"/>{medium}</medium></shape></scene>"""
TEXTS = ("0", "1", "-1", "2", "17", "100", "1e3", "100.7", "0.5", "nan", "inf", "-inf", "1e39", "1e400", "2147483648",
         "", "9223372036854775807", "99999999999999999999", "true", "false", "none", "auto", "raymarch", "grid",
         "network", "depth, normal", "depth,depth", "1 2", "é", "a" * 300, "../../x", "$spp")  # fmt: skip
SHAPES = (
    '<integer name="{0}" value="{1}"/>', '<float name="{0}" value="{1}"/>', '<string name="{0}" value="{1}"/>',
    '<boolean name="{0}" value="{1}"/>', '<rgb name="{0}" value="{1}"/>', '<spectrum name="{0}" value="{1}"/>',
    '<point name="{0}" x="{1}" y="0" z="1"/>', '<vector name="{0}" value="{1}"/>', '<ref name="{0}" id="m"/>',
    '<transform name="{0}"><scale value="{1}"/></transform>', '<bsdf type="diffuse" name="{0}"/>',
    '<transform name="{0}"><translate x="{1}"/></transform>', '<texture type="checkerboard" name="{0}"/>',
    '<transform name="{0}"><matrix value="1 0 0 0 0 1 0 0 0 {1} 1 0 0 0 0 1"/></transform>',
)  # fmt: skip


def properties(folder: Path):
    """A scene with every plugin, and the names that each has."""
    import mitsuba as mi
    from helpers import scenes

    import mi_ntf.render
    from mi_ntf.render.plugins import properties

    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    mi_ntf.render.register()
    path = scenes.write_blobs(folder)
    mi.load_string(SCENE.format(integrator="", emitter="", medium="", path=path))
    return path, {"integrator": properties.INTEGRATOR, "medium": properties.MEDIUM, "emitter": properties.EMITTER}


def properties_case(rng, _folder: Path, base):
    import mitsuba as mi

    path, names = base
    plugin = str(rng.choice(sorted(names)))
    made = []
    for _ in range(rng.choice([1, 1, 2])):
        name = str(rng.choice([n for n in names[plugin] if n != "filename"]))
        kind = rng.random()
        if kind < 0.1:
            name = str(rng.choice(["foo", "seed", "", "type", "id", "filename", name + "s", name[:-1], "to_world"]))
        elif kind < 0.2:
            name = str(rng.choice(sorted({*names["integrator"], *names["medium"]} - {"filename"})))
        shape = SHAPES[rng.integers(0, 4 if rng.random() < 0.7 else len(SHAPES))]
        made.append(shape.format(name, rng.choice(TEXTS)))
    text = SCENE.format(**{p: "" for p in names} | {plugin: "".join(made)}, path=path)

    def attempt():
        try:
            mi.load_string(text)
        except Exception as error:  # out of C++, which knows one type alone
            told = errors.sentence(error)
            raise (RuntimeError if "MI_NTF_DEBUG" in told else MiNtfError)(told) from None

    return f"{plugin} {''.join(made)[:200]}", attempt


# --- maps: files of `mi-ntf bake`, and what is cached -----------------------------------------------------------------


def maps(folder: Path):
    """``(medium, map file, its numbers, cached file, its numbers)``."""
    import mitsuba as mi
    from helpers import scenes
    from helpers.maps import OPTIONS, build, find_medium, table, texels

    import mi_ntf.render
    from mi_ntf.render.maps import map_file

    os.environ |= {"XDG_CACHE_HOME": str(folder / "cache"), "MI_NTF_CACHE": "on"}
    mi.set_variant(VARIANT)
    mi.set_log_level(mi.LogLevel.Error)
    mi_ntf.render.register()
    medium = find_medium(scenes.write_blobs(folder, log_density=3.0))
    map_file.write(folder / "maps.exr", medium, table(), OPTIONS, [build(medium)])
    (cached,) = (folder / "cache").rglob("maps/*.safetensors")
    baked = folder / "maps.exr"
    return medium, baked, map_file.read(baked, medium, table(), OPTIONS, 2), cached, texels(medium)


def maps_case(rng, folder: Path, base):
    from helpers.maps import OPTIONS, table, texels

    from mi_ntf.render.maps import map_cache, map_file

    medium, baked, expected, cached, kept = base
    if rng.random() < 0.4:
        good = cached.read_bytes()
        damaged = pickled(folder) if rng.random() < 0.2 else mutate.blob(rng, good, head=64)

        def look_up():
            cached.write_bytes(damaged)
            map_cache.forget()
            assert np.array_equal(texels(medium), kept), "another map"
            assert cached.read_bytes() == good, "a damaged map is not made anew"

        return "cached", look_up
    path = folder / "case.exr"
    if rng.random() < 0.5:
        path.write_bytes(mutate.blob(rng, baked.read_bytes(), head=2000))
    else:
        rewrite(baked, path, lambda about: mutate.tree(rng, about))

    def read():
        assert np.array_equal(map_file.read(path, medium, table(), OPTIONS, 2), expected), "another map"

    return "baked", read


def rewrite(source: Path, path: Path, change) -> None:
    """Write the map file `source` again, `change` made to what it says of each light."""
    import OpenEXR

    from mi_ntf.render.maps import map_file

    parts = []
    for part in OpenEXR.File(str(source)).parts:
        header = {k: v for k, v in part.header.items() if k not in ("channels", "dataWindow")}
        header[map_file.ATTRIBUTE] = json.dumps(change(json.loads(header[map_file.ATTRIBUTE])))
        parts.append(OpenEXR.Part(header, {name: c.pixels.copy() for name, c in part.channels.items()}))
    OpenEXR.File(parts).write(str(path))


# --- the batch --------------------------------------------------------------------------------------------------------

KINDS = {"field": (field, field_case), "voxels": (voxels, voxels_case), "grid": (grid, grid_case),
         "dataset": (dataset, dataset_case), "colmap": (colmap, colmap_case),
         "properties": (properties, properties_case), "maps": (maps, maps_case)}


def run(kind: str, seed: int, first: int, last: int, folder: Path) -> None:
    make, case = KINDS[kind]
    base = make(folder)
    limit_memory()
    warnings.simplefilter("error")
    for k in range(first, last):
        name, attempt = case(np.random.default_rng([seed, k]), folder, base)
        print(json.dumps({"case": k, "name": name}), flush=True)
        start, text = time.monotonic(), ""
        try:
            attempt()
            outcome = "read"
        except MiNtfError as error:
            outcome, text = "refused", str(error)
        except Exception as error:
            outcome, text = type(error).__name__, str(error)
        print(json.dumps({"outcome": outcome, "text": text, "seconds": time.monotonic() - start}), flush=True)


def limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * resource.getpagesize() + ROOM
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


if __name__ == "__main__":
    faulthandler.enable()
    run(sys.argv[1], *map(int, sys.argv[2:5]), Path(tempfile.mkdtemp(dir=sys.argv[5])))

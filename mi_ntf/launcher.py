"""`mi-ntf render`: the stock program `mitsuba` in Python, for machines without a C++ compiler.

It follows `src/mitsuba/mitsuba.cpp` of Mitsuba 3.9.1: parse, instantiate, render without developing, let the film write
the file. The stock program has no ``--watch``, no PNG files, and no options for the environment
(:mod:`mi_ntf.render.scene.environment_option`).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import os
import re
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from mi_ntf.commands.options import SceneOptions
from mi_ntf.core import files, ops, progress, srgb
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import enough_threads
from mi_ntf.render import log
from mi_ntf.render.scene import scene_file
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.watch import Tev, printed, watch

SUFFIXES = {"OpenEXR": ".exr", "RGBE": ".rgbe", "PFM": ".pfm"}
"""Suffix of the files that a film writes, by its ``file_format``."""


def main(args: argparse.Namespace) -> None:
    """Render as :func:`mi_ntf.commands.render_line.parsed` says.

    Raises MiNtfError, OSError or RuntimeError if the work failed and UsageError on bad usage.
    """
    options = SceneOptions(args.mode, tuple(args.define), args.env, args.env_rotate, args.env_scale)
    parameters = options.parameters()
    output = Path(args.output) if args.output else None
    _set_log_level(args.verbose)
    environment = options.environment()
    _apply_settings(args)
    render = partial(render_file, parameters=parameters, sensor_index=args.sensor, output=output,
                     environment=environment, exposure=args.exposure)
    if args.watch:
        _watch(Path(args.scenes[0]), output, render, args.tev)
        return
    if output and len(args.scenes) > 1:
        raise MiNtfError(f"-o {output} is one image, but {len(args.scenes)} scenes are given; leave it out, or render "
                         "one at a time")
    for scene in args.scenes:
        with progress.Stage(f"rendering {scene}", shown=False):  # Mitsuba's log shows the progress
            render(Path(scene))


def _watch(scene: Path, output: Path | None, render: Callable[..., mi.Film], address: str) -> None:
    """Render `scene` after each change of its files, see :mod:`mi_ntf.watch`."""
    tev = Tev(address, printed)
    if not scene.is_file():
        raise MiNtfError(f"scene {scene} does not exist")

    def render_and_show(note: Callable[[Path], None]) -> None:
        film = render(scene, note=note)
        tev.show(str((output or scene).resolve().with_suffix(".exr")), film.bitmap())

    watch(render_and_show, printed)


def render_file(path: Path, parameters: dict[str, str], *, sensor_index: int = 0, output: Path | None = None,
                environment: Environment | None = None, note: Callable[[Path], None] | None = None,
                exposure: float = 0.0) -> mi.Film:
    """Render a scene file in the current variant, write the image, and return the film.

    `parameters` are values of $names, `environment` changes the scene's, and `note` is called with each file before it
    is read. The image is `output`, a PNG file with an `exposure` in stops or a file of the film's format, and lies
    beside the scene by default. Raises MiNtfError if the scene cannot be rendered or the image not be written.
    """
    scene = scene_file.load(path, parameters, environment, note)
    if not 0 <= sensor_index < len(scene.sensors()):
        raise MiNtfError(f"{path} has {len(scene.sensors())} sensors, so there is no sensor {sensor_index}")
    if scene.integrator() is None:
        raise MiNtfError(f"{path}: no integrator specified")

    sensor = scene.sensors()[sensor_index]
    film: mi.Film = sensor.film()
    image = _destination(film, path, output)
    scene_file.render_to_film(scene, sensor)
    if image.suffix.lower() == ".png":
        _write_png(film, image, exposure)
    else:
        _write_film(film, image, getattr(scene.integrator(), "achieved", {}))
    return film


def _destination(film: mi.Film, scene: Path, output: Path | None) -> Path:
    """Return the image file of a scene file. Raises MiNtfError if it cannot be written."""
    file_format = re.search(r"file_format = (\w+)", str(film))
    suffix = SUFFIXES.get(file_format[1] if file_format else "", ".exr")
    image = scene.with_suffix(suffix) if output is None else output if output.suffix else output.with_suffix(suffix)
    files.check(image, (suffix, ".png"))
    return image


def _write_film(film: mi.Film, path: Path, achieved: Mapping[str, object]) -> None:
    """Write a film in its own format, and an EXR with what `achieved` holds."""
    with files.replacing(path) as temporary:
        named = temporary.with_suffix(path.suffix)  # film plugins replace other suffixes
        try:
            film.write(str(named))
            if path.suffix.lower() == ".exr":
                _annotate(named, achieved)
            os.replace(named, temporary)
        finally:
            named.unlink(missing_ok=True)


def _write_png(film: mi.Film, path: Path, exposure: float) -> None:
    """Write the colours of a film, without other channels, as 8 bits a channel in sRGB."""
    bitmap = film.bitmap()
    names = [field.name for field in bitmap.struct_()]  # type: ignore[attr-defined]  # not in the stub
    chosen = [names.index(name) for name in ("RGB" if set("RGB") <= set(names) else "YYY")]
    pixels = np.array(bitmap, np.float32).reshape(bitmap.height(), bitmap.width(), len(names))[..., chosen]
    levels = np.round(255 * srgb.encode(ops, np.nan_to_num(pixels) * 2.0**exposure)).astype(np.uint8)
    with files.replacing(path) as temporary:
        mi.Bitmap(levels).write(str(temporary), mi.Bitmap.FileFormat.PNG)


def _annotate(path: Path, achieved: Mapping[str, object]) -> None:
    """Write the results of an ``nrf`` integrator's limits into the header of an EXR file, as JSON under ``mi_ntf``."""
    if not achieved:
        return
    # JSON has no NaN and no infinity.
    text = json.dumps(json.loads(json.dumps(achieved), parse_constant=lambda _: None))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = {name: value for name, value in file.header().items() if name != "channels"}
        with files.replacing(path) as temporary:
            OpenEXR.File(header | {"mi_ntf": text}, file.channels()).write(str(temporary))


def _set_log_level(verbose: int) -> None:
    level = min(verbose, 2)
    mi.set_log_level((mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)[level])
    dr.set_log_level((dr.LogLevel.Error, dr.LogLevel.Warn, dr.LogLevel.Info)[level])


def _apply_settings(args: argparse.Namespace) -> None:
    """Set threads, search path, Dr.Jit flags and vector width."""
    log.info(f'Rendering using the "{mi.variant()}" variant.')
    if args.threads is not None:
        if args.threads < 1:
            raise MiNtfError(f"-t {args.threads}: at least one thread is needed")
        dr.set_thread_count(args.threads)
    enough_threads(dr)
    for folder in filter(None, args.append.split(";")):
        mi.file_resolver().append(folder)  # type: ignore[operator]  # an object in the stub

    if args.optimise is not None:
        flags = (dr.JitFlag.MergeFunctions, dr.JitFlag.ConstantPropagation, dr.JitFlag.ValueNumbering,
                 dr.JitFlag.OptimizeCalls, dr.JitFlag.OptimizeLoops)
        for position, flag in enumerate(flags):
            dr.set_flag(flag, args.optimise > position)
    if args.wavefront:
        dr.set_flag(dr.JitFlag.SymbolicLoops, False)
    if args.wavefront > 1:
        dr.set_flag(dr.JitFlag.SymbolicCalls, False)
    dr.set_flag(dr.JitFlag.PrintIR, args.print_ir)
    if args.width is not None:
        _set_vector_width(args.width)


def _set_vector_width(width: int) -> None:
    """Set the vector width of LLVM kernels, by the C++ function of Dr.Jit's library, since Python has none."""
    if width < 1 or width & (width - 1):
        raise MiNtfError(f"-V {width}: the vector width must be a power of two, such as 8")
    if not str(mi.variant()).startswith("llvm"):
        return  # as the stock program
    library = ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))
    get_processor, get_features = library._Z19jit_llvm_target_cpuv, library._Z24jit_llvm_target_featuresv
    get_processor.restype = get_features.restype = ctypes.c_char_p
    library._Z19jit_llvm_set_targetPKcS0_j(get_processor(), get_features(), width)

"""`mi-ntf render`: the stock program `mitsuba` in Python, for machines without a C++ compiler.

It follows `src/mitsuba/mitsuba.cpp` of Mitsuba 3.9.1: parse, instantiate, render without developing, let the film write
the file. The stock program has no ``--watch``, no PNG files, and no options for the environment
(:mod:`mi_ntf.render.scene.environment_option`).
"""

from __future__ import annotations

import argparse
import ctypes
import json
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NoReturn

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR

from mi_ntf.commands.options import SCENE_HELP, SceneOptions, UsageError
from mi_ntf.core import files, ops, progress, srgb
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import enough_threads
from mi_ntf.render import log
from mi_ntf.render.scene import scene_file
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.watch import TEV, Tev, printed, watch

SUFFIXES = {"OpenEXR": ".exr", "RGBE": ".rgbe", "PFM": ".pfm"}
"""Suffix of the files that a film writes, by its ``file_format``."""


class _Parser(argparse.ArgumentParser):
    """Parser that answers bad usage with one sentence, without the line of usage."""

    def error(self, message: str) -> NoReturn:
        """Raise UsageError."""
        raise UsageError(f"{message}; `{self.prog} -h` describes the options")


def parser() -> argparse.ArgumentParser:
    """Return the parser of the stock program's command line and of further options."""
    p = _Parser("mi-ntf render", description="Render Mitsuba scenes with the flags of the program "
                                "`mitsuba` and some more.")
    p.add_argument("scenes", nargs="+", metavar="SCENE.xml", help="Scenes to render, one after the other.")
    p.add_argument("-m", "--mode", default="", metavar="VARIANT", help=SCENE_HELP["mode"])
    p.add_argument("-v", "--verbose", action="count", default=0, help="More messages; may be given twice.")
    p.add_argument("-t", "--threads", type=int, metavar="COUNT", help="Number of CPU threads (1 counts as 2).")
    p.add_argument("-D", "--define", action="append", default=[], metavar="KEY=VALUE",
                   help=SCENE_HELP["define"])
    p.add_argument("-s", "--sensor", type=int, default=0, metavar="INDEX", help="Sensor to render (default 0).")
    p.add_argument("-a", "--append", default="", metavar="PATH;PATH", help="Folders to search for resources.")
    p.add_argument("-o", "--output", metavar="FILE",
                   help="Image to write: .exr, or .png, which has 8 bits, sRGB's curve and a black background. The "
                        "default is an EXR file beside the scene.")
    p.add_argument("-O", type=int, choices=range(6), dest="optimise", metavar="0-5",
                   help="Optimisation level of Dr.Jit.")
    p.add_argument("-S", action="store_true", dest="print_ir", help="Print the intermediate representation.")
    p.add_argument("-V", type=int, dest="width", metavar="WIDTH", help="Vector width of LLVM kernels, a power of two.")
    p.add_argument("-W", action="count", default=0, dest="wavefront", help="Wavefronts in place of a megakernel.")
    extra = p.add_argument_group("options that the program `mitsuba` does not have")
    extra.add_argument("--env", type=Path, metavar="FILE",
                       help=SCENE_HELP["env"])
    extra.add_argument("--env-rotate", type=float, default=0.0, metavar="DEG",
                       help=SCENE_HELP["env_rotate"])
    extra.add_argument("--env-scale", type=float, default=1.0, metavar="S", help=SCENE_HELP["env_scale"])
    extra.add_argument("--exposure", type=float, default=0.0, metavar="STOPS",
                       help="Exposure of a PNG image (default 0).")
    extra.add_argument("--watch", action="store_true",
                       help="Render again when a file of the scene changes, until Ctrl-C, and send pictures to tev.")
    extra.add_argument("--tev", default=TEV, metavar="HOST:PORT", help=f"Address of tev (default {TEV}).")
    return p


def main(arguments: Sequence[str]) -> None:
    """Run the command line `arguments` (without the program's name).

    Raises MiNtfError, OSError or RuntimeError if the work failed and UsageError on bad usage.
    """
    p = parser()
    args = p.parse_args(arguments)
    options = SceneOptions(args.mode, tuple(args.define), args.env, args.env_rotate, args.env_scale)
    parameters = options.parameters()
    output = Path(args.output) if args.output else None
    if args.exposure and (output is None or output.suffix.lower() != ".png"):
        p.error("--exposure is for PNG images: give -o IMAGE.png")
    if args.watch and len(args.scenes) > 1:
        p.error(f"--watch takes one scene, found {len(args.scenes)}")
    _set_log_level(args.verbose)
    environment = options.environment()
    _apply_settings(args)
    render = partial(render_file, parameters=parameters, sensor_index=args.sensor, output=output,
                     environment=environment, exposure=args.exposure)
    if args.watch:
        _watch(Path(args.scenes[0]), output, render, args.tev)
        return
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
        film.write(str(image))
    if image.suffix.lower() == ".exr":
        _annotate(image, getattr(scene.integrator(), "achieved", {}))
    return film


def _destination(film: mi.Film, scene: Path, output: Path | None) -> Path:
    """Return the image file of a scene file. Raises MiNtfError if it cannot be written."""
    file_format = re.search(r"file_format = (\w+)", str(film))
    suffix = SUFFIXES.get(file_format[1] if file_format else "", ".exr")
    image = scene.with_suffix(suffix) if output is None else output if output.suffix else output.with_suffix(suffix)
    files.check(image, (suffix, ".png"))
    return image


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

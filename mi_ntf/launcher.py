"""`mi-ntf render`: the stock program `mitsuba` in Python, for machines without a C++ compiler.

It takes the stock program's flags and does what `src/mitsuba/mitsuba.cpp` of Mitsuba 3.9.1 does:
parse, instantiate, render without developing, let the film write the file. Flags of its own: ``--watch``, and those of
another environment (:mod:`mi_ntf.render.scene.environment_option`).
"""

import argparse
import ctypes
import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import OpenEXR

from mi_ntf import bridge
from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS, enough_threads
from mi_ntf.render.scene import scene_file
from mi_ntf.render.scene.environment_option import Environment
from mi_ntf.watch import TEV, Tev, printed, watch

MTIME = 2.0
"""Seconds that a file system's clock may be behind."""


def parser() -> argparse.ArgumentParser:
    """The stock program's command line."""
    p = argparse.ArgumentParser(
        prog="mi-ntf render", description="Render Mitsuba scenes; same flags as the program `mitsuba`, and some more."
    )
    p.add_argument("scenes", nargs="+", metavar="SCENE.xml")
    p.add_argument(
        "-m", "--mode", metavar="VARIANT", help="default: the first available of " + ", ".join(VARIANTS)
    )
    p.add_argument("-v", "--verbose", action="count", default=0, help="more messages; may be given twice")
    p.add_argument("-t", "--threads", type=int, metavar="COUNT", help="number of CPU threads (1 counts as 2)")
    p.add_argument(
        "-D", "--define", action="append", default=[], metavar="KEY=VALUE", help="value of $KEY in the scene"
    )
    p.add_argument("-s", "--sensor", type=int, default=0, metavar="INDEX", help="sensor to render (default 0)")
    p.add_argument("-a", "--append", default="", metavar="PATH;PATH", help="folders to search for resources")
    p.add_argument("-o", "--output", metavar="FILE", help="image to write (default: beside the scene)")
    p.add_argument("-O", type=int, choices=range(6), dest="optimise", metavar="0-5", help="Dr.Jit optimisation level")
    p.add_argument("-S", action="store_true", dest="print_ir", help="print the intermediate representation")
    p.add_argument("-V", type=int, dest="width", metavar="WIDTH", help="vector width of LLVM kernels, a power of two")
    p.add_argument("-W", action="count", default=0, dest="wavefront", help="wavefronts in place of a megakernel")
    own = p.add_argument_group("not of the program `mitsuba`")
    own.add_argument("--env", type=Path, metavar="FILE", help="latitude-longitude image in place of the environment's")
    own.add_argument("--env-rotate", type=float, default=0.0, metavar="DEG",
                     help="turn the environment about the world's up axis, further than the scene does")
    own.add_argument("--env-scale", type=float, default=1.0, metavar="S", help="factor of the environment's radiance")
    own.add_argument("--watch", action="store_true",
                     help="render again when a file of the scene changes, until Ctrl-C; sends pictures to tev")
    own.add_argument("--tev", default=TEV, metavar="HOST:PORT", help=f"where tev may listen (default {TEV})")
    return p


def main(arguments: Sequence[str]) -> None:
    """Run the command line `arguments` (without the program's name).

    Raises MiNtfError, OSError or RuntimeError if the work failed and SystemExit(2) on bad usage.
    """
    p = parser()
    args = p.parse_args(arguments)
    parameters = {}
    for item in args.define:
        key, separator, value = item.partition("=")
        if not separator:
            p.error(f"-D {item}: expected KEY=VALUE")
        parameters[key] = value

    if args.watch and len(args.scenes) > 1:
        p.error(f"--watch takes one scene, found {len(args.scenes)}")
    _apply_settings(args)
    environment = Environment(args.env, args.env_rotate, args.env_scale)
    common: dict[str, Any] = {"sensor_index": args.sensor, "output": args.output and Path(args.output),
                              "environment": environment}
    if args.watch:
        _watch(Path(args.scenes[0]), parameters, args.tev, common)
        return
    for scene in args.scenes:
        render_file(Path(scene), parameters, **common)


def _watch(scene: Path, parameters: dict[str, str], address: str, options: dict[str, Any]) -> None:
    """Render `scene` again and again, see :mod:`mi_ntf.watch`."""
    tev = Tev(address, printed)
    if not scene.is_file():
        raise MiNtfError(f"scene {scene} does not exist")

    def render(seen: Callable[[Path], None]) -> None:
        film = render_file(scene, parameters, seen=seen, **options)
        tev.show(str((options["output"] or scene).resolve().with_suffix(".exr")), film.bitmap())

    watch(render, printed)


def render_file(path: Path, parameters: dict[str, str], *, sensor_index: int = 0, output: Path | None = None,
                environment: Environment | None = None, seen: Callable[[Path], None] | None = None) -> Any:
    """Render one scene file in the current variant, write the image with the film, and return the film.

    `parameters` are the values of `$key` in the scene, `environment` is laid over its own, `seen` is called with each
    file before it is read. The image goes to `output` or, by default, beside the scene; the film sets the extension.
    Raises MiNtfError if the scene cannot be rendered.
    """
    scene = scene_file.load(path, parameters, environment, seen)
    if not 0 <= sensor_index < len(scene.sensors()):
        raise MiNtfError(f"{path} has {len(scene.sensors())} sensors, so there is no sensor {sensor_index}")
    if scene.integrator() is None:
        raise MiNtfError(f"{path}: no integrator specified")

    sensor = scene.sensors()[sensor_index]
    scene_file.render_to_film(scene, sensor)
    begun = time.time()
    sensor.film().write(str(output or path))
    written = (output or path).with_suffix(".exr")  # of EXR films
    if written.is_file() and written.stat().st_mtime > begun - MTIME:
        _annotate(written, getattr(scene.integrator(), "achieved", {}))
    return sensor.film()


def _annotate(path: Path, achieved: dict) -> None:
    """Write what came of the limits of an ``nrf`` integrator into the header of the EXR `path`, as JSON under
    ``mi_ntf``; pixels stay as they are. The stock program has no place for it."""
    if not achieved:
        return
    # What is not a number is none in JSON.
    text = json.dumps(json.loads(json.dumps(achieved), parse_constant=lambda _: None))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        header = {name: value for name, value in file.header().items() if name != "channels"}
        with files.replacing(path) as temporary:
            OpenEXR.File(header | {"mi_ntf": text}, file.channels()).write(str(temporary))


def _apply_settings(args: argparse.Namespace) -> None:
    """Variant, plugins, threads, log level, search path, Dr.Jit flags and vector width."""
    level = min(args.verbose, 2)
    mi.set_log_level((mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)[level])
    dr.set_log_level((dr.LogLevel.Error, dr.LogLevel.Warn, dr.LogLevel.Info)[level])

    if args.mode and args.mode not in mi.variants():
        raise MiNtfError(f"unknown variant {args.mode!r}; this Mitsuba has {', '.join(mi.variants())}")
    try:
        mi.set_variant(*([args.mode] if args.mode else VARIANTS))
    except ImportError as error:
        raise MiNtfError(
            f"this machine cannot run {args.mode or 'any of ' + ', '.join(VARIANTS)}: "
            f"`mi-ntf doctor` names the remedy ({error})"
        ) from error
    variant = str(mi.variant())
    log: Any = mi.Log  # an object in the stub
    log(mi.LogLevel.Info, f'Rendering using the "{variant}" variant.')
    bridge.register_all(variant)

    if args.threads is not None:
        if args.threads < 1:
            raise MiNtfError(f"-t {args.threads}: at least one thread is needed")
        dr.set_thread_count(args.threads)
    enough_threads(dr)
    for folder in filter(None, args.append.split(";")):
        mi.file_resolver().append(folder)  # type: ignore[operator]  # an object in the stub

    flags = (
        dr.JitFlag.MergeFunctions,
        dr.JitFlag.ConstantPropagation,
        dr.JitFlag.ValueNumbering,
        dr.JitFlag.OptimizeCalls,
        dr.JitFlag.OptimizeLoops,
    )
    if args.optimise is not None:
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
    """Let LLVM kernels handle `width` numbers at a time. Python has no function for it, so that of Dr.Jit's library is
    called."""
    if width < 1 or width & (width - 1):
        raise MiNtfError(f"-V {width}: the vector width must be a power of two, such as 8")
    if not str(mi.variant()).startswith("llvm"):
        return  # as the stock program
    library = ctypes.CDLL(str(Path(dr.__file__).with_name("libdrjit-core.so")))
    get_processor, get_features = library._Z19jit_llvm_target_cpuv, library._Z24jit_llvm_target_featuresv
    get_processor.restype = get_features.restype = ctypes.c_char_p
    library._Z19jit_llvm_set_targetPKcS0_j(get_processor(), get_features(), width)

"""`mi-ntf render`: the stock program `mitsuba` in Python, for machines without a C++ compiler.

It takes the stock program's flags and does what `src/mitsuba/mitsuba.cpp` of Mitsuba 3.9.1 does:
parse, instantiate, render without developing, let the film write the file.
"""

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import OpenEXR

from mi_ntf import bridge
from mi_ntf.core import files
from mi_ntf.core.errors import MiNtfError

VARIANT_PRIORITY = ("cuda_ad_rgb", "llvm_ad_rgb")
"""Without `-m`, the first of these that this machine can run, as in the stock program."""

MTIME = 2.0
"""Seconds that a file system's clock may be behind."""


def parser() -> argparse.ArgumentParser:
    """The stock program's command line."""
    p = argparse.ArgumentParser(
        prog="mi-ntf render", description="Render Mitsuba scenes; same flags as the program `mitsuba`."
    )
    p.add_argument("scenes", nargs="+", metavar="SCENE.xml")
    p.add_argument(
        "-m", "--mode", metavar="VARIANT", help="default: the first available of " + ", ".join(VARIANT_PRIORITY)
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
    p.add_argument("-W", action="count", default=0, dest="wavefront", help="wavefronts in place of a megakernel")
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

    _apply_settings(args)
    for scene in args.scenes:
        render_file(Path(scene), parameters, sensor_index=args.sensor, output=args.output and Path(args.output))


def render_file(path: Path, parameters: dict[str, str], *, sensor_index: int = 0, output: Path | None = None) -> None:
    """Render one scene file in the current variant and write the image with the film.

    `parameters` are the values of `$key` in the scene. The image goes to `output` or, by default,
    beside the scene; the film sets the extension. Raises MiNtfError if the scene cannot be rendered.
    """
    if not path.is_file():
        raise MiNtfError(f"scene {path} does not exist")
    scene = mi.load_file(str(path), **parameters)  # type: ignore[arg-type]  # they are $names
    if not isinstance(scene, mi.Scene):
        raise MiNtfError(f"{path}: the root element must be a <scene>")
    if not 0 <= sensor_index < len(scene.sensors()):
        raise MiNtfError(f"{path} has {len(scene.sensors())} sensors, so there is no sensor {sensor_index}")
    if scene.integrator() is None:
        raise MiNtfError(f"{path}: no integrator specified")

    sensor = scene.sensors()[sensor_index]
    scene.integrator().render(scene, sensor, develop=False)
    begun = time.time()
    sensor.film().write(str(output or path))
    written = (output or path).with_suffix(".exr")  # of EXR films
    if written.is_file() and written.stat().st_mtime > begun - MTIME:
        _annotate(written, getattr(scene.integrator(), "achieved", {}))


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
    """Variant, plugins, threads, log level, search path and Dr.Jit flags."""
    level = min(args.verbose, 2)
    mi.set_log_level((mi.LogLevel.Info, mi.LogLevel.Debug, mi.LogLevel.Trace)[level])
    dr.set_log_level((dr.LogLevel.Error, dr.LogLevel.Warn, dr.LogLevel.Info)[level])

    if args.mode and args.mode not in mi.variants():
        raise MiNtfError(f"unknown variant {args.mode!r}; this Mitsuba has {', '.join(mi.variants())}")
    try:
        mi.set_variant(*([args.mode] if args.mode else VARIANT_PRIORITY))
    except ImportError as error:
        raise MiNtfError(
            f"this machine cannot run {args.mode or 'any of ' + ', '.join(VARIANT_PRIORITY)}: "
            f"`mi-ntf doctor` names the remedy ({error})"
        ) from error
    variant = str(mi.variant())
    log: Any = mi.Log  # an object in the stub
    log(mi.LogLevel.Info, f'Rendering using the "{variant}" variant.')
    bridge.register_all(variant)

    if args.threads is not None:
        if args.threads < 1:
            raise MiNtfError(f"-t {args.threads}: at least one thread is needed")
        # The film writes EXR from a worker thread and waits for it for ever if there is none.
        dr.set_thread_count(max(args.threads, 2))
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

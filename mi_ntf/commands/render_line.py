"""Command line of `mi-ntf render`: flags of the program `mitsuba`, and some more. It imports no renderer."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import NoReturn

from mi_ntf.commands.options import SCENE_HELP, UsageError, definitions
from mi_ntf.watch import TEV


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


def parsed(arguments: Sequence[str]) -> argparse.Namespace:
    """Return the options of a command line without the program's name. Raises UsageError."""
    p = parser()
    args = p.parse_args(arguments)
    definitions(tuple(args.define))
    if args.exposure and not (args.output and args.output.lower().endswith(".png")):
        p.error("--exposure is for PNG images: give -o IMAGE.png")
    if args.watch and len(args.scenes) > 1:
        p.error(f"--watch takes one scene, found {len(args.scenes)}")
    return args

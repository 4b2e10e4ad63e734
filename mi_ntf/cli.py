"""Command line of mi-ntf: capture, train and render neural reflectance fields.

Exit code 0: done, 1: the work failed, 2: bad usage. An error is one sentence. The environment variable MI_NTF_DEBUG=1
adds Python's traceback.
"""

import sys
import traceback
from collections.abc import Sequence
from typing import Annotated, Protocol, cast

import tyro
from tyro.conf import subcommand

from mi_ntf.commands.analysis import Compare, Explain, Tradeoff
from mi_ntf.commands.fields import Capture, Export, Info, Inspect, Train
from mi_ntf.commands.machine import Bridge, Doctor
from mi_ntf.commands.options import UsageError
from mi_ntf.commands.scenes import Bake, Cache, Render, RenderSequence, Swap, View
from mi_ntf.core import errors

Commands = (
    Annotated[Capture, subcommand("capture")]
    | Annotated[Inspect, subcommand("inspect")]
    | Annotated[Train, subcommand("train")]
    | Annotated[Swap, subcommand("swap")]
    | Annotated[Render, subcommand("render")]
    | Annotated[Compare, subcommand("compare")]
    | Annotated[Explain, subcommand("explain")]
    | Annotated[Tradeoff, subcommand("tradeoff")]
    | Annotated[View, subcommand("view")]
    | Annotated[Bake, subcommand("bake")]
    | Annotated[Cache, subcommand("cache")]
    | Annotated[Export, subcommand("export")]
    | Annotated[RenderSequence, subcommand("sequence")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Bridge, subcommand("bridge")]
    | Annotated[Doctor, subcommand("doctor")]
)


class Command(Protocol):
    """A parsed command line."""

    def run(self) -> int | None:
        """Do the work and return the exit code. None stands for 0."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: sys.argv) and return the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        return parse(words).run() or 0
    except SystemExit as leave:  # argument parsers end this way, with 0 after help and 2 on bad usage
        return leave.code if isinstance(leave.code, int) else 2
    except UsageError as error:
        print(f"mi-ntf: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        return 130
    except Exception as error:
        if errors.debug():
            traceback.print_exc()
        remedy = "; `mi-ntf doctor` names the package to install" if isinstance(error, ImportError) else ""
        print(f"mi-ntf: error: {errors.sentence(error)}{remedy}", file=sys.stderr)
    return 1


def parse(words: list[str]) -> Command:
    """Return the command of a command line. Raises SystemExit as argparse does."""
    if words[:1] == ["render"]:  # its flags belong to another parser
        return Render(tuple(words[1:]))
    config = (tyro.conf.FlagCreatePairsOff,)
    return cast(Command, tyro.cli(Commands, prog="mi-ntf", description=__doc__, args=words, config=config))


if __name__ == "__main__":
    sys.exit(main())

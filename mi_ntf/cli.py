"""Command line of mi-ntf: capture, train and render neural reflectance fields.

Exit code 0: done, 1: the work failed, 2: bad usage. An error is one sentence. The environment variable MI_NTF_DEBUG=1
adds Python's traceback.
"""

import sys
import traceback
from collections.abc import Callable, Sequence
from typing import Protocol, cast

from tyro.conf import FlagCreatePairsOff
from tyro.extras import subcommand_cli_from_dict

from mi_ntf.commands import analysis, fields, machine, scenes
from mi_ntf.commands.options import UsageError
from mi_ntf.core import errors


class Command(Protocol):
    """A parsed command line."""

    def run(self) -> int | None:
        """Do the work and return the exit code. None stands for 0."""


COMMANDS: dict[str, Callable[..., Command]] = {
    "capture": fields.Capture, "inspect": fields.Inspect, "train": fields.Train, "swap": scenes.Swap,
    "render": scenes.Render, "compare": analysis.Compare, "explain": analysis.Explain, "tradeoff": analysis.Tradeoff,
    "view": scenes.View, "bake": scenes.Bake, "cache": scenes.Cache, "export": fields.Export,
    "sequence": scenes.RenderSequence, "info": fields.Info, "bridge": machine.Bridge, "doctor": machine.Doctor,
}


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
        return scenes.Render(tuple(words[1:]))
    return cast(Command, subcommand_cli_from_dict(COMMANDS, prog="mi-ntf", description=__doc__, args=words,
                                                  config=(FlagCreatePairsOff,)))


if __name__ == "__main__":
    sys.exit(main())

"""The command line `mi-ntf`.

Exit code 0: done, 1: the work failed, 2: bad usage. An error is one sentence. The environment variable MI_NTF_DEBUG=1
adds Python's traceback.
"""

import difflib
import io
import re
import shutil
import signal
import sys
import textwrap
import traceback
from collections.abc import Sequence
from contextlib import redirect_stderr, redirect_stdout, suppress
from typing import Protocol

import tyro
from tyro.conf import FlagCreatePairsOff

from mi_ntf import __version__
from mi_ntf.commands import analysis, fields, machine, refining, scenes, usage
from mi_ntf.commands.options import UsageError
from mi_ntf.core import errors, interruption, progress


class Command(Protocol):
    """A parsed command line."""

    def run(self) -> int | None:
        """Do the work and return the exit code. None stands for 0."""


GROUPS: dict[str, dict[str, type[Command]]] = {
    "From an object to a field": {
        "capture": fields.Capture, "inspect": fields.Inspect, "train": fields.Train, "refine": refining.Refine,
        "info": fields.Info, "import": fields.Import, "swap": scenes.Swap, "export": fields.Export},
    "Pictures": {
        "render": scenes.Render, "view": scenes.View, "sequence": scenes.RenderSequence, "bake": scenes.Bake},
    "Accuracy and time": {
        "explain": analysis.Explain, "compare": analysis.Compare, "tradeoff": analysis.Tradeoff},
    "This machine": {"doctor": machine.Doctor, "bridge": machine.Bridge, "cache": scenes.Cache},
}
"""The commands by name, in the groups of `mi-ntf --help`."""
COMMANDS = {name: command for group in GROUPS.values() for name, command in group.items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command line (default: sys.argv) and return the exit code."""
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        with interruption.noticed():
            command = parse(words)
            with (progress.silent(bool(getattr(command, "json", False))),
                  progress.before_imports(f"starting {words[0]}")):
                return command.run() or 0
    except SystemExit as leave:  # argument parsers end this way, with 0 after help and 2 on bad usage
        return leave.code if isinstance(leave.code, int) else 2
    except UsageError as error:
        print(f"mi-ntf: error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as error:
        if arguments is None:  # Mitsuba's handler, in whatever thread, may raise the signal again while Python ends
            signal.signal(signal.SIGINT, signal.SIG_IGN)
        print(f"mi-ntf: {str(error) or 'stopped'}", file=sys.stderr)
        return 130
    except Exception as error:
        if errors.debug():
            traceback.print_exc()
        remedy = "; `mi-ntf doctor` names the package to install" if isinstance(error, ImportError) else ""
        print(f"mi-ntf: error: {errors.sentence(error)}{remedy}", file=sys.stderr)
    return 1


def parse(words: list[str]) -> Command:
    """Return the command of a command line. Raises UsageError, or SystemExit after a help."""
    name = words[0] if words else ""
    if name in ("", "-h", "--help"):
        print(overview(), file=sys.stdout if name else sys.stderr)
        raise SystemExit(0 if name else 2)
    if name == "--version":
        print(f"mi-ntf {__version__}")
        raise SystemExit(0)
    if name not in COMMANDS:
        near = difflib.get_close_matches(name, COMMANDS, 1)
        raise UsageError(f"there is no command {errors.shown(name)}; " +
                         (f"did you mean {near[0]}?" if near else "`mi-ntf --help` lists them"))
    if name == "render":  # its flags belong to another parser
        return scenes.Render(tuple(words[1:]))
    if {"-h", "--help"} & set(words):
        print(description(name))
        raise SystemExit(0)
    box = io.StringIO()
    try:
        with redirect_stderr(box):
            return _parsed(name, words[1:])
    except SystemExit:
        raise UsageError(usage.sentence(name, words[1:], box.getvalue(), description(name))) from None


def overview() -> str:
    """Return the text of `mi-ntf --help`."""
    lines = ["usage: mi-ntf COMMAND [options]", "",
             "Relight captured objects in Mitsuba 3. `mi-ntf COMMAND -h` describes a command."]
    for title, group in GROUPS.items():
        lines += ["", title]
        for name, command in group.items():
            text = (command.__doc__ or "").partition("\n")[0]
            lines += textwrap.wrap(f"  {name:<9} {text}", shutil.get_terminal_size().columns,
                                   subsequent_indent=" " * 12)
    return "\n".join([*lines, "", "`mi-ntf --version` prints the version, `mi-ntf doctor` checks the installation."])


def description(name: str) -> str:
    """Return the help of a command, whose line of usage is wrapped: tyro does not wrap it."""
    text = io.StringIO()
    with suppress(SystemExit), redirect_stdout(text):
        _parsed(name, ["-h"])
    usage, _, rest = text.getvalue().partition("\n\n")
    whole = re.sub(r"\[[^]]*\]", lambda part: part[0].replace(" ", "\xa0"), usage)  # no break within an option
    wrapped = textwrap.fill(whole, shutil.get_terminal_size().columns, subsequent_indent=" " * 7,
                            break_on_hyphens=False)
    return wrapped.replace("\xa0", " ") + "\n\n" + re.sub(" +$", "", rest.rstrip(), flags=re.M)


def _parsed(name: str, words: list[str]) -> Command:
    return tyro.cli(COMMANDS[name], prog=f"mi-ntf {name}", args=words, config=(FlagCreatePairsOff,))


if __name__ == "__main__":
    sys.exit(main())

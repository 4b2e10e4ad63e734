"""Options and output that several commands share."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

from tyro.conf import Positional, UseAppendAction, arg

from mi_ntf.core import progress
from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.variants import VARIANTS
from mi_ntf.jobs.options import Workers

if TYPE_CHECKING:
    from mi_ntf.render.scene.environment_option import Environment

Report = TypeVar("Report")


class UsageError(Exception):
    """Arguments that parse but do not fit together (exit code 2)."""


def named(metavar: str | None = None, text: str | None = None, aliases: tuple[str, ...] = (), name: str | None = None
          ) -> object:
    """Return the annotation of an option: the name of its value, its help, and no default where there is none.

    `name` is the option's, where Python does not allow it.
    """

    def default(label: str) -> str:
        return "" if label in ("None", "False", "''") else f"(default: {label.removesuffix('.0')})"

    return arg(name=name, metavar=metavar, help=text, aliases=aliases or None, help_behavior_hint=default)


Scene = Annotated[Positional[Path], named("SCENE.xml")]
FieldFile = Annotated[Positional[Path], named("FIELD", "Field file, .safetensors.")]
DataSet = Annotated[Positional[Path], named("DIR")]
Count = Annotated[int, named("N")]
OptionalCount = Annotated[int | None, named("N")]
OptionalNumber = Annotated[float | None, named("X")]
Flag = Annotated[bool, named()]
OptionalFile = Annotated[Path | None, named("FILE")]
OptionalFolder = Annotated[Path | None, named("DIR")]
Output = Annotated[Path, named("FILE", aliases=("-o",))]
OptionalOutput = Annotated[Path | None, named("FILE", aliases=("-o",))]
OutputFolder = Annotated[Path, named("DIR", aliases=("-o",))]
Overwrite = Annotated[bool, named(text="Replace the file if it exists.")]
Json = Annotated[bool, named(text="Print JSON in place of tables and progress.")]
Shapes = Annotated[str, named("NAMES")]
Masks = Annotated[Path | None, named("DIR", "Folder of masks with the names of the photographs (white: object).")]
Background = Annotated[Literal["black"] | None, named(
    "{black}", "For photographs without masks that were taken with a flash in a dark room.")]
FlashOffset = Annotated[str | None, named("R,U,F")]
FlashOrEstimate = Annotated[str | None, named(
    "R,U,F", "Offset of the flash from the lens: right,up,forward in the data set's lengths, or `estimate`.")]

SCENE_HELP = {
    "mode": "Mitsuba's variant. The default is the first available of " + " and ".join(VARIANTS) + ".",
    "define": "Value of $KEY in the scene; may be repeated.",
    "env": "Latitude-longitude image in place of the environment's.",
    "env_rotate": "Turn the environment about the world's up axis, in addition to the scene.",
    "env_scale": "Factor of the environment's radiance.",
}
"""Help of :class:`SceneOptions`, for the parser of `mi-ntf render`, too."""
Mode = Annotated[str, named("VARIANT", SCENE_HELP["mode"], ("-m",))]
Define = Annotated[UseAppendAction[tuple[str, ...]], named("KEY=VALUE", SCENE_HELP["define"], ("-D",))]


@dataclass(frozen=True)
class SceneOptions:
    """Options of every command that renders a scene: Mitsuba's variant, values of $names, and the environment."""

    mode: Mode = ""
    define: Define = ()
    env: Annotated[Path | None, named("FILE", SCENE_HELP["env"])] = None
    env_rotate: Annotated[float, named("DEG", SCENE_HELP["env_rotate"])] = 0.0
    env_scale: Annotated[float, named("S", SCENE_HELP["env_scale"])] = 1.0

    def parameters(self) -> dict[str, str]:
        """Return the values of ``$names`` by name. Raises UsageError."""
        return definitions(self.define)

    def environment(self) -> "Environment":
        """Set the variant, register the plugins, and return the changes of the environment. Raises MiNtfError."""
        from mi_ntf import bridge
        from mi_ntf.render.scene.environment_option import Environment

        bridge.start(self.mode)
        return Environment(self.env, self.env_rotate, self.env_scale)


InScene = Annotated[SceneOptions, arg(name="")]


def definitions(items: tuple[str, ...]) -> dict[str, str]:
    """Return the values of words KEY=VALUE by name. Raises UsageError."""
    for item in items:
        if "=" not in item:
            raise UsageError(f"-D needs KEY=VALUE, got {item}")
    return dict(item.split("=", 1) for item in items)


def _workers(
    engine: Annotated[Literal["local", "submitit", "dask"], named(
        text="local: processes of this machine. submitit: a Slurm array, or subprocesses where there is no Slurm. "
             "dask: the workers of --scheduler, or of this machine.")] = "local",
    workers: Annotated[int | None, named("N", "Number of processes that work at the same time.")] = None,
    threads: Annotated[int | None, named(
        "N", "Threads of each worker. The default is the number of cores divided by that of workers.")] = None,
    scheduler: Annotated[str | None, named(
        "ADDRESS", "Address of a running Dask scheduler, as tcp://HOST:8786.")] = None,
) -> Workers:
    return Workers(engine, workers, threads, scheduler)


WorkerOptions = Annotated[Workers, arg(name="", constructor=_workers)]


def check_workers(workers: Workers) -> None:
    """Raise UsageError for options of workers that do not fit together, MiNtfError for an engine without packages."""
    try:
        workers.check()
    except MiNtfError as error:
        raise UsageError(str(error)) from None
    workers.check_installed()


def parse_offset(text: str | None) -> tuple[float, float, float] | None:
    """Return the offset "right,up,forward" of the flash from the lens as numbers."""
    if text is None:
        return None
    try:
        right, up, forward = map(float, text.split(","))
    except ValueError:
        raise UsageError(f"--flash-offset is '{text}', expected three numbers right,up,forward (write "
                         "--flash-offset=-1,2,0 where the first is negative)") from None
    return right, up, forward


def flash_of(text: str | None) -> tuple[float, float, float] | Literal["estimate"] | None:
    """Return an offset as :func:`parse_offset` does, or "estimate"."""
    return "estimate" if text == "estimate" else parse_offset(text)


def print_report(report: Report, as_json: bool, print_table: Callable[[Report], None]) -> None:
    """Print the result of a command as JSON, or for a reader by `print_table`."""
    progress.give_way()
    if as_json:
        data = asdict(report) if is_dataclass(report) and not isinstance(report, type) else report
        text = json.dumps(data, default=str)
        # JSON has no NaN and no infinity.
        print(json.dumps(json.loads(text, parse_constant=lambda _: None), indent=2))
    else:
        print_table(report)


def print_pairs(values: Mapping[str, object], indent: str = "") -> None:
    """Print a mapping, one `key  value` a line, nested mappings indented."""
    width = max((len(str(key)) for key in values), default=0)
    for key, value in values.items():
        if isinstance(value, dict):
            print(f"{indent}{key}")
            print_pairs(value, indent + "  ")
        else:
            print(f"{indent}{key:<{width}}  {_rounded(value)}")


def _rounded(value: object) -> object:
    """Return numbers with six significant digits, other values as they are."""
    if isinstance(value, list | tuple):
        return ", ".join(str(_rounded(v)) for v in value)
    return f"{value:.6g}" if isinstance(value, float) else value

"""The command `mi-ntf`. Exit code 0: done, 1: the work failed, 2: bad usage. An error is one sentence; the environment
variable MI_NTF_DEBUG=1 adds Python's frames.

Each command imports what it needs when it runs, so that `info` needs no renderer and
`render` no PyTorch.
"""

import json
import sys
import traceback
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional, UseAppendAction, arg, subcommand

from mi_ntf.core import errors
from mi_ntf.evaluate.limits import Limits, broken, given
from mi_ntf.jobs.options import Workers

Shared = Annotated[Workers, arg(name="")]
Output = Annotated[Path, arg(aliases=("-o",), metavar="FILE")]


class UsageError(Exception):
    """Arguments that parse but do not fit together (exit code 2)."""


@dataclass
class Capture:
    """Photograph a mesh scene with the light at the camera, as training data for a field."""

    scene: Positional[Path]
    """Mitsuba scene made of meshes."""
    folder: Positional[Path]
    """Data set to write; an interrupted capture goes on where it stopped."""
    views: int = 100
    """Photographs for training and validation."""
    size: int = 128
    """Width and height in pixels."""
    test_views: int = 20
    """Photographs held back for tests."""
    spp: int = 64
    """Samples per pixel."""
    seed: int = 0
    """Seed of view directions and samples."""
    flash_offset: Annotated[str | None, arg(metavar="R,U,F")] = None
    """Flash beside the lens: right,up,forward of it in scene lengths."""
    workers: Shared = field(default_factory=Workers)

    def run(self) -> None:
        _fitting(self.workers)
        from mi_ntf.data.capture import capture

        capture(
            self.scene,
            self.folder,
            views=self.views,
            size=self.size,
            test_views=self.test_views,
            spp=self.spp,
            seed=self.seed,
            flash_offset=_offset(self.flash_offset) or (0.0, 0.0, 0.0),
            workers=self.workers,
        )


@dataclass
class Train:
    """Train a field and its transmittance network on a data set."""

    dataset: Positional[Path]
    """Photographs: a capture, NeRF-synthetic, NRHints, nerfstudio (transforms.json), LLFF or COLMAP."""
    output: Output
    """Field file to write."""
    preset: str = "fast"
    """Architecture and schedule."""
    minutes: float | None = None
    """Stop after so many minutes."""
    steps: int | None = None
    """Stop after so many steps."""
    seed: int = 0
    """Seed of weights and samples."""
    ntf: str | None = None
    """Transmittance network in place of the preset's: mixture2, logistic, ray or paper."""
    no_augmentation: bool = False
    """Learn transmittance on camera rays alone."""
    no_colour_loss: bool = False
    """Do not compare pixels lit by the learned transmittance with the photographs."""
    size: int | None = None
    """Scale photographs to so many pixels along their longer side, in linear light."""
    masks: Path | None = None
    """Folder of masks, named as the photographs (white: object)."""
    background: str | None = None
    """black: no masks, the photographs were taken with a flash in a dark room."""
    flash_offset: Annotated[str | None, arg(metavar="R,U,F")] = None
    """Flash beside the lens: right,up,forward of it in the data set's lengths, or `estimate`."""
    no_gains: bool = False
    """All photographs have one exposure and white balance, although the flash's intensity is not known."""
    no_bounces: bool = False
    """The photographs hold no light that the object throws on itself, as renderings with one bounce."""
    no_fresnel: bool = False
    """The photographed materials have no Fresnel effect: renderings of lobes of fixed weight."""
    visibility_mlp: bool = False
    """Also train NeRV's visibility network, of a point and a direction, on the same transmittance."""
    field: Path | None = None
    """Field file to keep; its transmittance networks alone are trained, anew."""
    tensorboard: Path | None = None
    """Folder for TensorBoard events: losses, validation, speed, preview pictures."""
    view: bool = False
    """Show the field in a browser while it learns; needs the extra `view`."""
    baked: bool = False
    """Put the field's voxels into the file as well, so that it loads without a bake or a cache."""
    json: bool = False
    """Print the whole report as JSON in place of a summary."""

    def run(self) -> None:
        if self.minutes is not None and self.steps is not None:
            raise UsageError("give --minutes or --steps, not both")
        estimate = self.flash_offset == "estimate"
        offset = None if estimate else _offset(self.flash_offset)
        reading = {"size": self.size, "masks": self.masks, "background": self.background, "flash_offset": offset}
        from mi_ntf.train import train

        report = train(self.dataset, self.output, preset=self.preset, minutes=self.minutes, steps=self.steps,
                       seed=self.seed, tensorboard=self.tensorboard, field=self.field, ntf=self.ntf,
                       augmentation=not self.no_augmentation, colour_loss=not self.no_colour_loss,
                       reading=reading, estimate=estimate, gains=not self.no_gains,
                       visibility_mlp=self.visibility_mlp, bounces=not self.no_bounces,
                       fresnel=not self.no_fresnel, view=self.view)
        if report:  # under torchrun, only the first process has one
            if self.baked:
                from mi_ntf.render.commands.bake import bake_fields

                bake_fields(self.output, {})
            _report(report, self.json, _print_training)


@dataclass
class Inspect:
    """Show a data set before training: cameras, masks, brightness, and what will harm."""

    dataset: Positional[Path]
    """Folder of photographs, in any form that `train` reads."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """HTML page to write; DIR-inspect.html here unless given."""
    size: int | None = None
    """Scale photographs to so many pixels along their longer side."""
    masks: Path | None = None
    """Folder of masks, named as the photographs (white: object)."""
    background: str | None = None
    """black: no masks, a flash in a dark room."""
    flash_offset: Annotated[str | None, arg(metavar="R,U,F")] = None
    """Flash beside the lens: right,up,forward of it."""
    json: bool = False
    """Print JSON in place of a summary."""

    def run(self) -> None:
        offset = _offset(self.flash_offset)
        from mi_ntf.data.inspect import inspect, print_table

        _report(inspect(self.dataset, self.output, size=self.size, masks=self.masks, background=self.background,
                        flash_offset=offset), self.json, print_table)


@dataclass
class Swap:
    """Write a copy of a scene in which a field takes the place of the meshes."""

    scene: Positional[Path]
    """Mitsuba scene made of meshes."""
    field_file: Annotated[Positional[Path], arg(metavar="FIELD")]
    """Trained field."""
    output: Output
    """Scene to write."""

    def run(self) -> None:
        from mi_ntf.swap import swap

        for note in swap(self.scene, self.field_file, self.output):
            print(f"mi-ntf: {note}", file=sys.stderr)


@dataclass
class Render:
    """Render a scene; takes the flags of the program `mitsuba` (see `mi-ntf render -h`)."""

    arguments: Positional[tuple[str, ...]] = ()
    """Flags and scene files of the program `mitsuba`."""

    def run(self) -> None:
        from mi_ntf.launcher import main as launch

        launch(self.arguments)


@dataclass
class Compare:
    """Measure an image against a reference. Exit code 1 where a limit is broken."""

    image: Positional[Path]
    """Image to judge, EXR or PNG."""
    reference: Positional[Path]
    """Image taken as truth, EXR or PNG."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """PNG to write: both images, their difference, HDR-FLIP."""
    limits: Annotated[Any, arg(name="", constructor=Limits)] = field(default_factory=Limits)
    masked: bool = False
    """Limits judge the object's own pixels, where the reference's alpha is above 0.5, not the whole picture."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> int:
        if self.masked and not given(self.limits):
            raise UsageError("--masked says what limits judge; give one, as --max-relative-rmse 0.05")
        from mi_ntf.evaluate.compare import compare, print_table

        result = compare(self.image, self.reference, self.output)
        failures = broken(result, self.limits, self.masked)
        _report(result | ({"exceeded": failures} if given(self.limits) else {}), self.json, print_table)
        for failure in failures:
            print(f"mi-ntf: {failure['says']}", file=sys.stderr)
        return 1 if failures else 0


@dataclass
class Explain:
    """Say how a scene would be rendered, why, and what it costs."""

    scene: Positional[Path]
    """Scene with an nrf medium."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=("-D",), metavar="KEY=VALUE")] = field(
        default_factory=tuple
    )
    """Value of $KEY in the scene."""
    measure: bool = False
    """Render the scene, and show the real seconds beside those that a pilot predicts."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> None:
        parameters = _definitions(self.define)
        from mi_ntf.render.commands.explain import explain, print_table

        _report(explain(self.scene, parameters, self.measure), self.json, print_table)


@dataclass
class Tradeoff:
    """Show what accuracy costs on a scene: the error of every method over seconds, as a page of curves."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("tradeoff")
    """Folder for index.html, tradeoff.csv and tradeoff.json; an interrupted study goes on there."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=("-D",), metavar="KEY=VALUE")] = field(
        default_factory=tuple
    )
    """Value of $KEY in the scene."""
    budget: str = "5m"
    """Time that the study may take: 90s, 5m, 1h."""
    reference: Annotated[Path | None, arg(metavar="FILE")] = None
    """The path-traced mesh, an EXR picture or the XML file of its scene; shipped scenes have theirs."""
    json: bool = False
    """Print JSON in place of a table, and no progress."""

    def run(self) -> None:
        parameters = _definitions(self.define)
        from mi_ntf.evaluate.budget import seconds
        from mi_ntf.evaluate.tradeoff import study

        try:
            budget = seconds(self.budget)
        except ValueError as error:
            raise UsageError(str(error)) from None
        _report(study.tradeoff(self.scene, self.output, parameters, budget, self.reference, self.json),
                self.json, study.print_table)


@dataclass
class View:
    """Show a scene in a browser: orbit, drag lights, turn environments, compare methods, save what was changed."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=("-D",), metavar="KEY=VALUE")] = field(
        default_factory=tuple
    )
    """Value of $KEY in the scene."""
    size: int = 256
    """The picture has about SIZE² pixels."""
    samples: int = 64
    """Samples a pixel of a picture at rest."""
    host: str = "127.0.0.1"
    """Address to serve; 0.0.0.0: to everyone who reaches this machine."""
    port: int = 8080
    """Port to serve at; a later one if it is taken."""

    def run(self) -> None:
        parameters = _definitions(self.define)
        from mi_ntf.view import view

        view(self.scene, parameters, self.size, self.samples, self.host, self.port)


@dataclass
class Bake:
    """Write the transmittance maps of a scene's lights into an EXR file, or the fields' voxels into their files."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator; the integrator's property map_file reads the result. With --baked: also
    a field file."""
    output: Annotated[Path | None, arg(aliases=("-o",), metavar="FILE")] = None
    """EXR to write."""
    baked: bool = False
    """Put the voxels of the scene's fields into their files, so that they load without a bake or a cache."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=("-D",), metavar="KEY=VALUE")] = field(
        default_factory=tuple
    )
    """Value of $KEY in the scene."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> None:
        if self.baked == (self.output is not None):
            raise UsageError("give -o FILE for maps, or --baked for the fields' voxels")
        from mi_ntf.render.commands.bake import bake, bake_fields

        parameters = _definitions(self.define)
        done = bake(self.scene, self.output, parameters) if self.output else bake_fields(self.scene, parameters)
        _report(done, self.json, _print_pairs)


@dataclass
class Cache:
    """Show what is kept for later renders: baked fields, patches between which light bounces, transmittance maps."""

    clear: bool = False
    """Remove it."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> None:
        from mi_ntf.render.commands.cache import report

        _report(report(self.clear), self.json, _print_pairs)


@dataclass
class Export:
    """Write a field's surface as a mesh with albedo and roughness, for Blender and others."""

    field_file: Annotated[Positional[Path], arg(metavar="FIELD")]
    """Trained field."""
    output: Output
    """Mesh to write: .ply (all attributes), .obj, .glb (colours), .stl."""
    resolution: int = 256
    """Voxels per side in which the surface is found, 32 to 512."""
    level: float | None = None
    """Density of the surface, 1/(radius of the field's sphere); 10 unless given, less in thin matter."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> None:
        from mi_ntf.export import export

        _report(export(self.field_file, self.output, self.resolution, self.level), self.json, _print_pairs)


@dataclass
class Sequence_:
    """Render many frames of a scene in one process: a timeline, or a table of parameters. Run again, it goes on."""

    scene: Positional[Path]
    """Mitsuba scene."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")]
    """Folder for frame_0000.exr and so on."""
    timeline: Annotated[Path | None, arg(metavar="T.toml")] = None
    """What changes over the frames: $names, camera, lights, environment at key frames."""
    parameters: Annotated[Path | None, arg(metavar="P.csv")] = None
    """Values of $names, one line a frame."""
    define: Annotated[UseAppendAction[tuple[str, ...]], arg(aliases=("-D",), metavar="KEY=VALUE")] = field(
        default_factory=tuple
    )
    """Value of $KEY in all frames."""
    env: Annotated[Path | None, arg(metavar="FILE")] = None
    """Latitude-longitude image in place of the environment's."""
    env_rotate: Annotated[float, arg(metavar="DEG")] = 0.0
    """Turn the environment about the world's up axis, further than scene and timeline do."""
    env_scale: Annotated[float, arg(metavar="S")] = 1.0
    """Factor of the environment's radiance."""
    shard: Annotated[str, arg(metavar="i/n")] = "1/1"
    """Render the i-th of n shards, counted from 1."""
    lights: Annotated[int, arg(metavar="N")] = 1
    """Render each frame in N parts by its lights, which shards share; when all are there, they become the frame."""
    film: Annotated[Path | None, arg(metavar="FILE")] = None
    """MP4 or WebM of all frames at the end: linear values, clipped to 0..1, with sRGB's curve (extra `video`)."""
    exposure: float = 0.0
    """Of the film, in stops."""
    check: bool = False
    """Render nothing; name the frames that are missing, broken or of other parameters (exit code 1)."""
    mode: Annotated[str, arg(aliases=("-m",), metavar="VARIANT")] = ""
    """Mitsuba's variant; the first available of cuda_ad_rgb and llvm_ad_rgb unless given."""
    workers: Shared = field(default_factory=Workers)
    json: bool = False
    """Print JSON in place of a summary, and no progress."""

    def run(self) -> int:
        if self.timeline is not None and self.parameters is not None:
            raise UsageError("give --timeline or --parameters, not both")
        _fitting(self.workers)
        fixed = _definitions(self.define)
        from mi_ntf.render.scene.environment_option import Environment
        from mi_ntf.sequence import command

        try:
            i, n = command.shard(self.shard)
        except ValueError as error:
            raise UsageError(str(error)) from None
        if self.film and (n > 1 or self.check):
            raise UsageError("--film shows all frames: give it without --shard and --check when they are there")
        if self.lights < 1:
            raise UsageError(f"--lights is {self.lights}, expected the number of parts, 1 or more")
        line = command.frames_of(self.timeline, self.parameters, fixed)
        environment = Environment(self.env, self.env_rotate, self.env_scale)
        tasks = command.tasks_of(self.scene, self.output, line.frames, self.lights, self.mode, environment)[i - 1 :: n]
        if self.check:
            found = command.check(tasks)
            faults = command.faults(found)
            _report(found, self.json, lambda found: print(f"{found['done']} of {found['images']} images are there"))
            for text in faults:
                print(f"mi-ntf: {text}", file=sys.stderr)
            return 1 if faults else 0
        film = (self.film, line.fps, self.exposure) if self.film else None
        _report(command.run(tasks, quiet=self.json, film=film, workers=self.workers), self.json, command.print_summary)
        return 0


@dataclass
class Info:
    """Describe a field file."""

    field_file: Annotated[Positional[Path], arg(metavar="FIELD")]
    """Trained field."""
    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> None:
        from mi_ntf.core.field_file import describe

        _report(describe(self.field_file), self.json, _print_pairs)


@dataclass
class Doctor:
    """Check Python, Mitsuba, LLVM, CUDA, the bridge and the extras; name the remedy of each fault."""

    json: bool = False
    """Print JSON in place of a table."""

    def run(self) -> int:
        from mi_ntf.doctor import examine, print_table

        report = examine()
        _report(report, self.json, print_table)
        return 0 if report["ok"] else 1


Command = (
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
    | Annotated[Sequence_, subcommand("sequence")]
    | Annotated[Info, subcommand("info")]
    | Annotated[Doctor, subcommand("doctor")]
)


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


def parse(words: list[str]) -> Any:
    """The command object for a command line. Raises SystemExit as argparse does."""
    if words[:1] == ["render"]:  # its flags belong to another parser
        return Render(tuple(words[1:]))
    return tyro.cli(Command, prog="mi-ntf", description=__doc__, args=words, config=(tyro.conf.FlagCreatePairsOff,))


def _offset(text: str | None) -> tuple[float, float, float] | None:
    """Right, up, forward of the lens."""
    if text is None:
        return None
    try:
        right, up, forward = map(float, text.split(","))
    except ValueError:
        raise UsageError(f"--flash-offset is '{text}', expected three numbers right,up,forward (write "
                         "--flash-offset=-1,2,0 where the first is negative)") from None
    return right, up, forward


def _fitting(workers: Workers) -> None:
    """Raise the UsageError of options that do not fit together."""
    try:
        workers.check()
    except errors.MiNtfError as error:
        raise UsageError(str(error)) from None


def _definitions(items: Sequence[str]) -> dict[str, str]:
    """Values by name, of words KEY=VALUE."""
    if not all("=" in item for item in items):
        raise UsageError(f"-D needs KEY=VALUE, got {' '.join(items)}")
    return dict(item.partition("=")[::2] for item in items)


def _report(result: Any, as_json: bool, print_table: Any) -> None:
    if as_json:
        print(json.dumps(result, indent=2, default=str))
    else:
        print_table(result)


def _print_training(report: dict[str, Any]) -> None:
    """Return the length of a training run and the quality of its field, from the report in the field's provenance."""
    wanted = ("steps_done", "seconds", "kept", "faults", "val", "test", "transmittance")
    _print_pairs({key: report[key] for key in wanted if report.get(key)})


def _print_pairs(values: dict[str, Any], indent: str = "") -> None:
    """Print a mapping, one `key  value` a line, nested mappings indented."""
    width = max((len(str(key)) for key in values), default=0)
    for key, value in values.items():
        if isinstance(value, dict):
            print(f"{indent}{key}")
            _print_pairs(value, indent + "  ")
        else:
            print(f"{indent}{key:<{width}}  {value}")


if __name__ == "__main__":
    sys.exit(main())

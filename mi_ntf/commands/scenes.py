"""Commands that render scenes or prepare them: swap, render, view, bake, cache, sequence."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ntf.commands import options
from mi_ntf.commands.options import Define, Json, OptionalOutput, Output, UsageError, WorkerOptions
from mi_ntf.jobs.options import Workers


@dataclass
class Swap:
    """Write a copy of a scene in which a field replaces the meshes."""

    scene: Positional[Path]
    """Mitsuba scene made of meshes."""
    field_file: Annotated[Positional[Path], arg(metavar="FIELD")]
    """Trained field."""
    output: Output
    """Scene to write."""
    shapes: str = ""
    """Shapes to replace, as cow,grass, or all but some, as not:floor. The default is all but lights."""

    def run(self) -> None:
        """Write the scene, and print what was replaced and what stays."""
        from mi_ntf.swap import swap

        report = swap(self.scene, self.field_file, self.output, self.shapes)
        for note in report.notes:
            print(f"mi-ntf: {note}", file=sys.stderr)
        print(report, f"scene: {self.output}", f"next: mitsuba -m llvm_ad_rgb {self.output}", sep="\n")


@dataclass
class Render:
    """Render a scene. The flags are those of the program `mitsuba` (see `mi-ntf render -h`)."""

    arguments: Positional[tuple[str, ...]] = ()
    """Flags and scene files of the program `mitsuba`."""

    def run(self) -> None:
        """Render the scenes."""
        from mi_ntf.launcher import main as launch

        launch(self.arguments)


@dataclass
class View:
    """Show a scene in a browser: move the camera and lights, turn environments, compare methods, save the scene."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator."""
    define: Define = ()
    size: int = 256
    """The picture has about SIZE² pixels."""
    samples: int = 64
    """Samples per pixel of a picture in which nothing moves."""
    host: str = "127.0.0.1"
    """Address to serve. 0.0.0.0 serves everyone who reaches this machine."""
    port: int = 8080
    """Port to serve at. If it is taken, a later one is used."""

    def run(self) -> None:
        """Serve the page until Ctrl-C."""
        parameters = options.definitions(self.define)
        from mi_ntf.view import view

        view(self.scene, parameters, self.size, self.samples, self.host, self.port)


@dataclass
class Bake:
    """Write the transmittance maps of a scene's lights to an EXR file, or the fields' voxels to their files."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator, whose property map_file reads the result. With --baked, a field file
    will do."""
    output: OptionalOutput = None
    """EXR to write."""
    baked: bool = False
    """Put the voxels of the scene's fields into their files, so that they load without a bake or a cache."""
    define: Define = ()
    json: Json = False

    def run(self) -> None:
        """Write the files and print their sizes."""
        if self.baked == (self.output is not None):
            raise UsageError("give -o FILE for maps, or --baked for the fields' voxels")
        from mi_ntf.render.commands.bake import bake, bake_fields

        parameters = options.definitions(self.define)
        report = bake(self.scene, self.output, parameters) if self.output else bake_fields(self.scene, parameters)
        options.print_report(report, self.json, options.print_pairs)


@dataclass
class Cache:
    """Show the files that speed up later renders: baked fields, patches for bounced light, transmittance maps."""

    clear: bool = False
    """Remove them."""
    json: Json = False

    def run(self) -> None:
        """Print the cache's contents."""
        from mi_ntf.render.commands.cache import report

        options.print_report(report(self.clear), self.json, options.print_pairs)


@dataclass
class RenderSequence:
    """Render many frames of a scene from a timeline or a table of parameters. A second run renders what is missing."""

    scene: Positional[Path]
    """Mitsuba scene."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")]
    """Folder for frame_0000.exr and so on."""
    timeline: Annotated[Path | None, arg(metavar="T.toml")] = None
    """Values over the frames at key frames: $names, camera, lights, environment."""
    parameters: Annotated[Path | None, arg(metavar="P.csv")] = None
    """Values of $names, one line per frame."""
    define: Define = ()
    env: Annotated[Path | None, arg(metavar="FILE")] = None
    """Latitude-longitude image in place of the environment's."""
    env_rotate: Annotated[float, arg(metavar="DEG")] = 0.0
    """Turn the environment about the world's up axis, in addition to scene and timeline."""
    env_scale: Annotated[float, arg(metavar="S")] = 1.0
    """Factor of the environment's radiance."""
    shard: Annotated[str, arg(metavar="i/n")] = "1/1"
    """Render the i-th of n shards, counted from 1."""
    film: Annotated[Path | None, arg(metavar="FILE")] = None
    """MP4 or WebM of all frames: linear values, clipped to 0..1, with sRGB's curve. It needs the extra `video`."""
    exposure: float = 0.0
    """Exposure of the film in stops."""
    check: bool = False
    """Render nothing. Name the frames that are missing, broken or of other parameters (exit code 1)."""
    mode: Annotated[str, arg(aliases=("-m",), metavar="VARIANT")] = ""
    """Mitsuba's variant. The default is the first available of cuda_ad_rgb and llvm_ad_rgb."""
    workers: WorkerOptions = field(default_factory=Workers)
    json: Json = False

    def run(self) -> int:
        """Render or check the frames of this shard."""
        if self.timeline is not None and self.parameters is not None:
            raise UsageError("give --timeline or --parameters, not both")
        options.check_workers(self.workers)
        fixed = options.definitions(self.define)
        from mi_ntf.render.scene.environment_option import Environment
        from mi_ntf.sequence import command
        from mi_ntf.sequence.film import Film

        try:
            i, n = command.shard(self.shard)
        except ValueError as error:
            raise UsageError(str(error)) from None
        if self.film and (n > 1 or self.check):
            raise UsageError("--film shows all frames: give it without --shard and --check when they are there")
        frames = command.frames_of(self.timeline, self.parameters, fixed)
        environment = Environment(self.env, self.env_rotate, self.env_scale)
        tasks = command.tasks_of(self.scene, self.output, frames.frames, self.mode, environment)[i - 1 :: n]
        if self.check:
            result = command.check(tasks)
            options.print_report(result, self.json, command.print_check)
            for text in result.faults:
                print(f"mi-ntf: {text}", file=sys.stderr)
            return 1 if result.faults else 0
        film = Film(self.film, frames.fps, self.exposure) if self.film else None
        summary = command.run(tasks, quiet=self.json, film=film, workers=self.workers)
        options.print_report(summary.as_data(), self.json, lambda _: command.print_summary(summary))
        return 0

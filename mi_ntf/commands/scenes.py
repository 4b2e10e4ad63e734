"""Commands that render scenes or prepare them: swap, render, view, bake, cache, sequence."""

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from mi_ntf.commands import options, render_line
from mi_ntf.core import extras, files, progress
from mi_ntf.jobs.options import Workers


@dataclass
class Swap:
    """Write a copy of a scene in which a field replaces the meshes."""

    scene: options.Scene
    """Mitsuba scene made of meshes."""
    field_file: options.FieldFile
    output: options.Output
    """Scene to write, .xml."""
    shapes: options.Shapes = ""
    """Shapes to replace, as cow,grass, or all but some, as not:floor. The default is all but lights."""
    define: options.Define = ()
    overwrite: options.Overwrite = False

    def run(self) -> None:
        """Write the scene, and print what was replaced and what stays."""
        parameters = options.definitions(self.define)
        files.check(self.output, (".xml",), self.overwrite)
        from mi_ntf.swap import swap

        report = swap(self.scene, self.field_file, self.output, self.shapes, parameters)
        for note in report.notes:
            print(f"mi-ntf: {note}", file=sys.stderr)
        command = shlex.join(["mitsuba", "-m", "llvm_ad_rgb", str(self.output)])
        print(report, f"scene: {self.output}", f"next: {command}", sep="\n")


@dataclass
class Render:
    """Render a scene. The flags are those of the program `mitsuba` (see `mi-ntf render -h`)."""

    arguments: Positional[tuple[str, ...]] = ()
    """Flags and scene files of the program `mitsuba`."""

    def run(self) -> None:
        """Render the scenes."""
        args = render_line.parsed(self.arguments)
        from mi_ntf.launcher import main as launch

        progress.give_way()  # Mitsuba's log shows the progress
        launch(args)


@dataclass
class View:
    """Show a scene in a browser: move camera and lights, compare methods, save it."""

    scene: options.Scene
    """Scene with an nrf medium and integrator."""
    size: options.Count = 512
    """The picture has the size of the window, but at most about N² pixels."""
    samples: options.Count = 64
    """Samples per pixel of a picture in which nothing moves."""
    host: Annotated[str, options.named("ADDRESS")] = "127.0.0.1"
    """Address to serve. 0.0.0.0 serves everyone who reaches this machine."""
    port: options.Count = 8080
    """Port to serve at. If it is taken, a later one is used."""
    loading: options.InScene = field(default_factory=options.SceneOptions)

    def run(self) -> None:
        """Serve the page until Ctrl-C."""
        parameters = self.loading.parameters()
        extras.need("view", "a view")
        from mi_ntf.view import view

        view(self.scene, parameters, self.size, self.samples, self.host, self.port, self.loading.environment())


@dataclass
class Bake:
    """Write the transmittance maps of a scene's lights to a file, or voxels to fields."""

    scene: options.Scene
    """Scene with an nrf medium and integrator, whose property map_file reads the result. With --baked, a field file
    will do."""
    output: options.OptionalOutput = None
    """Map file to write, .exr."""
    baked: options.Flag = False
    """Put the voxels of the scene's fields into their files, so that they load without a bake or a cache."""
    overwrite: options.Overwrite = False
    loading: options.InScene = field(default_factory=options.SceneOptions)
    json: options.Json = False

    def run(self) -> None:
        """Write the files and print their sizes."""
        if self.baked == (self.output is not None):
            raise options.UsageError("give -o FILE for maps, or --baked for the fields' voxels")
        parameters = self.loading.parameters()
        if self.output:
            files.check(self.output, (".exr",), self.overwrite)
        from mi_ntf.render.commands import bake

        environment = self.loading.environment()
        if self.output:
            maps = bake.bake(self.scene, self.output, parameters, environment)
            options.print_report(maps, self.json, bake.print_maps)
        else:
            fields = bake.bake_fields(self.scene, parameters, environment)
            options.print_report(fields, self.json, bake.print_fields)


@dataclass
class Cache:
    """Show the files that speed up later renders: voxels, maps, patches."""

    clear: options.Flag = False
    """Remove them."""
    json: options.Json = False

    def run(self) -> None:
        """Print the cache's contents."""
        from mi_ntf.render.commands.cache import print_table, report

        options.print_report(report(self.clear), self.json, print_table)


@dataclass
class RenderSequence:
    """Render many frames of a scene from a timeline or a table of parameters."""

    scene: options.Scene
    """Mitsuba scene."""
    output: options.OutputFolder
    """Folder for frame_0000.exr and so on. A second run renders the frames that are missing there."""
    timeline: Annotated[Path | None, options.named("T.toml")] = None
    """Values over the frames at key frames: $names, camera, lights, environment."""
    parameters: Annotated[Path | None, options.named("P.csv")] = None
    """Values of $names, one line per frame."""
    loading: options.InScene = field(default_factory=options.SceneOptions)
    shard: Annotated[str, options.named("i/n")] = "1/1"
    """Render the i-th of n shards, counted from 1."""
    film: options.OptionalFile = None
    """MP4 or WebM of all frames: linear values, clipped to 0..1, with sRGB's curve. It needs the extra `video`."""
    exposure: Annotated[float, options.named("STOPS")] = 0.0
    """Exposure of the film in stops."""
    check: options.Flag = False
    """Render nothing. Name the frames that are missing, broken or of other parameters (exit code 1)."""
    workers: options.WorkerOptions = field(default_factory=Workers)
    json: options.Json = False

    def run(self) -> int:
        """Render or check the frames of this shard."""
        if self.timeline is not None and self.parameters is not None:
            raise options.UsageError("give --timeline or --parameters, not both")
        options.check_workers(self.workers)
        fixed = self.loading.parameters()
        from mi_ntf.sequence import command
        from mi_ntf.sequence.film import Film

        try:
            i, n = command.shard(self.shard)
        except ValueError as error:
            raise options.UsageError(str(error)) from None
        if self.film and (n > 1 or self.check):
            raise options.UsageError("--film shows all frames: give it without --shard and --check when they are there")
        frames = command.frames_of(self.timeline, self.parameters, fixed)
        tasks = command.tasks_of(self.scene, self.output, frames.frames, self.loading.mode,
                                 self.loading.environment())[i - 1 :: n]
        if self.check:
            result = command.check(tasks)
            options.print_report(result, self.json, command.print_check)
            for text in result.faults:
                print(f"mi-ntf: {text}", file=sys.stderr)
            return 1 if result.faults else 0
        film = Film(self.film, frames.fps, self.exposure) if self.film else None
        summary = command.run(tasks, film=film, workers=self.workers)
        options.print_report(summary.as_data(), self.json, lambda _: command.print_summary(summary))
        return 0

"""Commands that make and describe fields: capture, inspect, train, export, info."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from mi_ntf.commands import options
from mi_ntf.commands.options import (
    Background,
    Count,
    DataSet,
    Define,
    FieldFile,
    Flag,
    FlashOffset,
    Json,
    Masks,
    Mode,
    OptionalCount,
    OptionalFile,
    OptionalFolder,
    OptionalNumber,
    OptionalOutput,
    Output,
    Overwrite,
    Scene,
    Shapes,
    WorkerOptions,
    named,
)
from mi_ntf.core import extras, files
from mi_ntf.jobs.options import Workers


@dataclass
class Capture:
    """Photograph a mesh scene with a flash, as training data for a field."""

    scene: Scene
    """Mitsuba scene made of meshes."""
    folder: DataSet
    """Folder of the data set. An interrupted capture continues in it."""
    views: Count = 100
    """Number of photographs for training and validation."""
    size: Count = 128
    """Width and height in pixels."""
    test_views: Count = 20
    """Number of photographs that are held back for tests."""
    spp: Count = 64
    """Samples per pixel."""
    seed: Count = 0
    """Seed of view directions and samples."""
    flash_offset: FlashOffset = None
    """Offset of the flash from the lens: right,up,forward in scene lengths."""
    shapes: Shapes = ""
    """Shapes to photograph, as cow,grass, or all but some, as not:floor. The default is all but lights."""
    mode: Mode = ""
    define: Define = ()
    workers: WorkerOptions = field(default_factory=Workers)

    def run(self) -> None:
        """Render the photographs."""
        options.check_workers(self.workers)
        parameters = options.definitions(self.define)
        offset = options.parse_offset(self.flash_offset) or (0.0, 0.0, 0.0)
        from mi_ntf import bridge
        from mi_ntf.data.capture import capture

        bridge.start(self.mode)
        report = capture(self.scene, self.folder, views=self.views, size=self.size, test_views=self.test_views,
                         spp=self.spp, seed=self.seed, flash_offset=offset, shapes=self.shapes, parameters=parameters,
                         workers=self.workers)
        earlier = f", {report['kept']} of them from an earlier run" if report["kept"] else ""
        print(f"photographs: {self.folder} ({report['rendered'] + report['kept']}{earlier})",
              f"next: mi-ntf train {self.folder} -o field.safetensors --minutes 10", sep="\n")


@dataclass
class Inspect:
    """Show a data set before training: cameras, masks, brightness, and warnings."""

    dataset: DataSet
    """Folder of photographs, in any form that `train` reads."""
    output: OptionalOutput = None
    """HTML page to write. The default is DIR-inspect.html in the working folder."""
    size: OptionalCount = None
    """Scale photographs to this many pixels along their longer side."""
    masks: Masks = None
    background: Background = None
    flash_offset: FlashOffset = None
    """Offset of the flash from the lens: right,up,forward."""
    json: Json = False

    def run(self) -> None:
        """Write the page and print the summary."""
        offset = options.parse_offset(self.flash_offset)
        if self.output is not None:
            files.check(self.output, (".html",))
        extras.need("train", "the page of a data set", "matplotlib", "PIL")
        from mi_ntf.data.inspect import inspect, print_table

        report = inspect(self.dataset, self.output, size=self.size, masks=self.masks, background=self.background,
                         flash_offset=offset)
        options.print_report(report, self.json, print_table)


@dataclass
class Train:
    """Train a field and its transmittance network on a data set."""

    dataset: DataSet
    """Photographs: a capture, NeRF-synthetic, NRHints, nerfstudio (transforms.json), LLFF or COLMAP."""
    output: Output
    """Field file to write."""
    preset: Annotated[Literal["fast", "paper"], named()] = "fast"
    """Architecture and schedule."""
    minutes: OptionalNumber = None
    """Stop after this many minutes."""
    steps: OptionalCount = None
    """Stop after this many steps."""
    seed: Count = 0
    """Seed of weights and samples."""
    ntf: Annotated[Literal["mixture2", "logistic", "ray", "paper"] | None,
                   named("{mixture2,logistic,ray,paper}")] = None
    """Transmittance network in place of the preset's."""
    no_augmentation: Flag = False
    """Learn transmittance on camera rays alone."""
    no_colour_loss: Flag = False
    """Do not compare pixels lit by the learned transmittance with the photographs."""
    size: OptionalCount = None
    """Scale photographs to this many pixels along their longer side, in linear light."""
    masks: Masks = None
    background: Background = None
    flash_offset: FlashOffset = None
    """Offset of the flash from the lens: right,up,forward in the data set's lengths, or `estimate`."""
    no_gains: Flag = False
    """Assume one exposure and white balance for all photographs, although the flash's intensity is not known."""
    no_bounces: Flag = False
    """Assume that the photographs hold no light that the object throws on itself, as in renderings of one bounce."""
    no_fresnel: Flag = False
    """Assume that the materials have no Fresnel effect, as in renderings with lobes of fixed weight."""
    visibility_mlp: Flag = False
    """Also train NeRV's visibility network, a function of a point and a direction, on the same transmittance."""
    field: OptionalFile = None
    """Field file whose radiance networks stay. Only its transmittance networks are trained, from new weights."""
    tensorboard: OptionalFolder = None
    """Folder for TensorBoard events: losses, validation, speed, preview pictures."""
    view: Flag = False
    """Show the field in a browser during training. It needs the extra `view`."""
    baked: Flag = False
    """Also put the field's voxels into the file, so that it loads without a bake or a cache."""
    json: Json = False

    def run(self) -> None:
        """Train, write the field file, and print the report."""
        if self.minutes is not None and self.steps is not None:
            raise options.UsageError("give --minutes or --steps, not both")
        estimate = self.flash_offset == "estimate"
        offset = None if estimate else options.parse_offset(self.flash_offset)
        files.check(self.output, (".safetensors",))
        extras.need("train", "training", "torch", "matplotlib", "PIL")
        if self.view:
            extras.need("view", "--view")
        from mi_ntf.train import train

        report = train(self.dataset, self.output, preset=self.preset, minutes=self.minutes, steps=self.steps,
                       seed=self.seed, tensorboard=self.tensorboard, field=self.field, ntf=self.ntf,
                       augmentation=not self.no_augmentation, colour_loss=not self.no_colour_loss,
                       reading={"size": self.size, "masks": self.masks, "background": self.background,
                                "flash_offset": offset}, estimate=estimate, gains=not self.no_gains,
                       visibility_mlp=self.visibility_mlp, bounces=not self.no_bounces,
                       fresnel=not self.no_fresnel, view=self.view)
        if report:  # under torchrun, only the first process has one
            if self.baked:
                from mi_ntf.render.commands.bake import bake_fields

                bake_fields(self.output, {})
            options.print_report(report, self.json, _print_training)


def _print_training(report: Mapping[str, object]) -> None:
    """Print the length of a training run and the quality of its field."""
    keys = ("steps_done", "seconds", "kept", "faults", "val", "test", "transmittance")
    options.print_pairs({key: report[key] for key in keys if report.get(key)})


@dataclass
class Export:
    """Write a field's surface as a mesh with albedo and roughness, as for Blender."""

    field_file: FieldFile
    output: Output
    """Mesh to write: .ply (all attributes), .obj, .glb (colours), .stl."""
    resolution: Count = 256
    """Voxels per side of the grid that the surface is extracted from, 32 to 512."""
    level: OptionalNumber = None
    """Density of the surface, 1/(radius of the field's sphere). The default is 10, or less in thin matter."""
    overwrite: Overwrite = False
    json: Json = False

    def run(self) -> None:
        """Write the mesh and print its figures."""
        extras.need("mesh", "a mesh")
        from mi_ntf.export import SUFFIXES, export, print_summary

        files.check(self.output, SUFFIXES, self.overwrite)
        mesh = export(self.field_file, self.output, self.resolution, self.level)
        options.print_report(mesh, self.json, print_summary)


@dataclass
class Info:
    """Describe a field file."""

    field_file: FieldFile
    full: Flag = False
    """Also print the networks' shapes and the whole record of the training."""
    json: Json = False

    def run(self) -> None:
        """Print the description."""
        from mi_ntf.core.field_file import describe, print_summary

        options.print_report(describe(self.field_file), self.json, options.print_pairs if self.full else print_summary)

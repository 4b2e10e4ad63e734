"""Commands that make and describe fields: capture, inspect, train, export, info."""

import json
import os
import shlex
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional

from mi_ntf.commands import options
from mi_ntf.core import extras, files
from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs.options import Workers


@dataclass
class Capture:
    """Photograph a mesh scene with a flash, as training data for a field."""

    scene: options.Scene
    """Mitsuba scene made of meshes."""
    folder: options.DataSet
    """Folder of the data set. An interrupted capture continues in it."""
    views: options.Count = 100
    """Number of photographs for training. A twentieth as many, at least 4, are added for validation."""
    size: options.Count = 128
    """Width and height in pixels."""
    test_views: options.Count = 20
    """Number of photographs that are held back for tests."""
    spp: options.Count = 64
    """Samples per pixel."""
    seed: options.Count = 0
    """Seed of view directions and samples."""
    flash_offset: options.FlashOffset = None
    """Offset of the flash from the lens: right,up,forward in scene lengths."""
    shapes: options.Shapes = ""
    """Shapes to photograph, as cow,grass, or all but some, as not:floor. The default is all but lights."""
    mode: options.Mode = ""
    define: options.Define = ()
    workers: options.WorkerOptions = field(default_factory=Workers)

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
              f"next: mi-ntf train {shlex.quote(str(self.folder))} -o field.safetensors --minutes 10", sep="\n")


@dataclass
class Inspect:
    """Show a data set before training: cameras, masks, brightness, and warnings."""

    dataset: options.DataSet
    """Folder of photographs, in any form that `train` reads."""
    output: options.OptionalOutput = None
    """HTML page to write. The default is DIR-inspect.html in the working folder."""
    size: options.OptionalCount = None
    """Scale photographs to this many pixels along their longer side."""
    masks: options.Masks = None
    background: options.Background = None
    flash_offset: options.FlashOrEstimate = None
    json: options.Json = False

    def run(self) -> None:
        """Write the page and print the summary."""
        offset = options.flash_of(self.flash_offset)
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

    dataset: options.DataSet
    """Photographs: a capture, NeRF-synthetic, NRHints, nerfstudio (transforms.json), LLFF or COLMAP."""
    output: options.Output
    """Field file to write."""
    preset: Annotated[Literal["fast", "paper"], options.named()] = "fast"
    """Architecture and schedule."""
    minutes: options.OptionalNumber = None
    """Stop after this many minutes. The default is 10."""
    steps: options.OptionalCount = None
    """Stop after this many steps."""
    seed: options.Count = 0
    """Seed of weights and samples."""
    ntf: Annotated[Literal["mixture2", "logistic", "ray", "paper"] | None,
                   options.named("{mixture2,logistic,ray,paper}")] = None
    """Transmittance network in place of the preset's."""
    no_augmentation: options.Flag = False
    """Learn transmittance on camera rays alone."""
    no_colour_loss: options.Flag = False
    """Do not compare pixels lit by the learned transmittance with the photographs."""
    size: options.OptionalCount = None
    """Scale photographs to this many pixels along their longer side, in linear light."""
    masks: options.Masks = None
    background: options.Background = None
    flash_offset: options.FlashOrEstimate = None
    no_gains: options.Flag = False
    """Assume one exposure and white balance for all photographs, although the flash's intensity is not known."""
    no_bounces: options.Flag = False
    """Assume that the photographs hold no light that the object throws on itself, as in renderings of one bounce."""
    no_fresnel: options.Flag = False
    """Assume that the materials have no Fresnel effect, as in renderings with lobes of fixed weight."""
    smoke: options.Flag = False
    """Learn smoke: a density that scatters light by a phase function, without normals and highlights."""
    asymmetry: options.OptionalNumber = None
    """Mean cosine of deflection in --smoke, -1 (back) to 1 (forward). The default is 0: even in all directions."""
    visibility_mlp: options.Flag = False
    """Also train NeRV's visibility network, a function of a point and a direction, on the same transmittance."""
    field: options.OptionalFile = None
    """Field file whose radiance networks stay. Only its transmittance networks are trained, from new weights."""
    tensorboard: options.OptionalFolder = None
    """Folder for TensorBoard events: losses, validation, speed, preview pictures."""
    view: options.Flag = False
    """Show the field in a browser during training. It needs the extra `view`."""
    baked: options.Flag = False
    """Also put the field's voxels into the file, so that it loads without a bake or a cache."""
    further: Annotated[bool, options.named(name="continue")] = False
    """Train the field in FILE further, and replace it. It becomes no worse in validation."""
    overwrite: options.Overwrite = False
    json: options.Json = False

    def run(self) -> None:
        """Train, write the field file, and print the report."""
        began = time.monotonic() - time.process_time()  # the minutes count the start of the program
        if self.minutes is not None and self.steps is not None:
            raise options.UsageError("give --minutes or --steps, not both")
        if self.further and self.overwrite:
            raise options.UsageError("give --continue or --overwrite, not both")
        offset = options.flash_of(self.flash_offset)
        if self.asymmetry is not None and not self.smoke:
            raise options.UsageError("--asymmetry is that of smoke; add --smoke")
        files.check(self.output, (".safetensors",))
        if self.output.exists() and not (self.further or self.overwrite):
            raise MiNtfError(f"{self.output} exists; add --continue to train it further or --overwrite to replace it, "
                             "or choose another name")
        extras.need("train", "training", "torch", "matplotlib", "PIL")
        if self.view:
            extras.need("view", "--view")
        from mi_ntf.train import train

        report = train(self.dataset, self.output, preset=self.preset, minutes=self.minutes, steps=self.steps,
                       seed=self.seed, tensorboard=self.tensorboard, field=self.field, further=self.further,
                       ntf=self.ntf, began=began,
                       augmentation=not self.no_augmentation, colour_loss=not self.no_colour_loss,
                       reading={"size": self.size, "masks": self.masks, "background": self.background,
                                "flash_offset": offset}, estimate=offset == "estimate", gains=not self.no_gains,
                       visibility_mlp=self.visibility_mlp, bounces=not self.no_bounces,
                       fresnel=not self.no_fresnel, smoke=(self.asymmetry or 0.0) if self.smoke else None,
                       view=self.view)
        if report:  # under torchrun, only the first process has one
            if self.baked:
                from mi_ntf.render.commands.bake import bake_fields

                bake_fields(self.output, {})
            options.print_report(report, self.json, self._print_summary)

    def _print_summary(self, report: Mapping[str, object]) -> None:
        """Print where the field and its page are, how good the field is, and the next command."""
        print(f"field: {self.output}", f"page: {self.output.with_suffix('.html')} (open it in a browser)",
              report.get("verdict", ""), f"next: {self._following()}", sep="\n")

    def _following(self) -> str:
        """Return the command that puts the field into its scene, for the working folder; for photographs, another."""
        try:
            capture = json.loads((self.dataset / "capture.json").read_bytes())
        except (OSError, ValueError):
            capture = {}
        folder = [self.dataset.resolve(), capture["folder"]] if "folder" in capture else []
        scene = Path(os.path.relpath(Path(*folder, capture.get("scene", ""))))
        if not scene.is_file():
            return shlex.join(["mi-ntf", "info", str(self.output)])
        words = ["mi-ntf", "swap", str(scene), str(self.output), "-o", "nrf.xml"]
        words += ["--shapes", capture["shapes"]] if capture.get("shapes") else []
        for name, value in capture.get("parameters", {}).items():
            words += ["-D", f"{name}={value}"]
        return shlex.join(words)


SPLATS_LACK = {"scale": 1.0, "albedo": None, "phase": 0.0, "order": "zyx"}
SPLATS_HAVE = {"emissive": False, "resolution": None}
"""Defaults of the options of `mi-ntf import` for either form of files."""


@dataclass
class Import:
    """Make a field of a grid of density or of Gaussian splats."""

    source: Annotated[Positional[Path], options.named("FILE", "Grid, .vol, .npz, .npy, .vdb; or splats, .ply, .spz.")]
    output: options.Output
    """Field file to write."""
    scale: Annotated[float, options.named("X")] = 1.0
    """Factor of the extinction, which is in 1/scene unit."""
    albedo: Annotated[str | None, options.named("A")] = None
    """Number, r,g,b, or .vol or .npy file. The default is the file's own colours, or 1."""
    phase: Annotated[float, options.named("G")] = 0.0
    """Asymmetry of the phase function, of Henyey and Greenstein: -1 backward, 0 isotropic, 1 forward."""
    bounds: Annotated[str | None, options.named("BOX")] = None
    """Corners x0,y0,z0,x1,y1,z1 in place of a grid's. Splats outside are left out."""
    order: Annotated[Literal["zyx", "xyz"], options.named("{zyx,xyz}")] = "zyx"
    """Axes of arrays of NumPy; many NeRF programs have x first."""
    emissive: options.Flag = False
    """Splats keep their colours as emitted light. The default takes them as the albedo of a surface."""
    resolution: options.OptionalCount = None
    """Voxels of splats along the longest side, 16 to 2048. The default follows from the splats' sizes."""
    overwrite: options.Overwrite = False
    json: options.Json = False

    def run(self) -> None:
        """Write the field and print its figures."""
        from mi_ntf import importing_splats
        from mi_ntf.data import splat_files
        from mi_ntf.importing import import_grid, print_summary

        files.check(self.output, (".safetensors",), self.overwrite)
        splats = self.source.suffix.lower() in splat_files.SUFFIXES
        for name, default in (SPLATS_LACK if splats else SPLATS_HAVE).items():
            if getattr(self, name) != default:
                raise MiNtfError(f"--{name} is for {'grids' if splats else 'Gaussian splats'}, and {self.source} "
                                 f"holds {'splats' if splats else 'a grid'}; leave it out")
        if splats:
            field = importing_splats.import_splats(self.source, self.output, self.resolution, self.emissive,
                                                   self.bounds)
            return options.print_report(field, self.json, importing_splats.print_summary)
        report = import_grid(self.source, self.output, self.scale, self.albedo, self.phase, self.bounds, self.order)
        options.print_report(report, self.json, print_summary)


@dataclass
class Export:
    """Write a field's surface as a mesh, as for Blender, or its density as a grid."""

    field_file: options.FieldFile
    output: options.Output
    """Mesh to write: .ply (all attributes), .obj, .glb (colours), .stl; or grid of density: .vol, .vdb."""
    resolution: options.Count = 256
    """Voxels per side of the grid, 32 to 512. A field of voxels keeps its own in .vol and .vdb."""
    level: options.OptionalNumber = None
    """Density of the surface, 1/(radius of the field's sphere). The default is 10, or less in thin matter."""
    overwrite: options.Overwrite = False
    json: options.Json = False

    def run(self) -> None:
        """Write the mesh or grid and print its figures."""
        from mi_ntf import exported_grid
        from mi_ntf.export import SUFFIXES, export, print_summary

        files.check(self.output, SUFFIXES + exported_grid.SUFFIXES, self.overwrite)
        if self.output.suffix.lower() in exported_grid.SUFFIXES:
            grid = exported_grid.export(self.field_file, self.output, self.resolution)
            return options.print_report(grid, self.json, exported_grid.print_summary)
        extras.need("mesh", "a mesh")
        mesh = export(self.field_file, self.output, self.resolution, self.level)
        options.print_report(mesh, self.json, print_summary)


@dataclass
class Info:
    """Describe a field file."""

    field_file: options.FieldFile
    full: options.Flag = False
    """Also print the networks' shapes and the whole record of the training."""
    json: options.Json = False

    def run(self) -> None:
        """Print the description."""
        from mi_ntf.core.field_file import describe, print_summary

        options.print_report(describe(self.field_file), self.json, options.print_pairs if self.full else print_summary)

"""Command that takes a trained field further by photographs under any light."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional

from mi_ntf.commands import options
from mi_ntf.core import extras, files


@dataclass
class Refine:
    """Refine a field by photographs under a known light."""

    scene: Annotated[Positional[Path], options.named(
        "SCENE.xml|FIELD", "Scene with the field and the light of the photographs; a field file alone is lit by each "
                           "photograph's flash.")]
    dataset: options.DataSet
    """Photographs, in any form that `train` reads, in the coordinates of the field's own."""
    output: options.Output
    """Field file to write."""
    parameters: Annotated[str, options.named("NAMES")] = "albedo"
    """What may change, as albedo,log_density: albedo, specular, roughness, log_density (of imported fields density), or
    emission in fields that emit light."""
    minutes: options.OptionalNumber = None
    """Stop after this many minutes. The default is 2."""
    steps: options.OptionalCount = None
    """Stop after this many steps."""
    seed: options.Count = 0
    """Seed of samples."""
    no_gains: options.Flag = False
    """Assume one exposure and white balance for all photographs, that of the scene's light."""
    size: options.OptionalCount = None
    """Scale photographs to this many pixels along their longer side, in linear light."""
    masks: options.Masks = None
    background: options.Background = None
    loading: options.InScene = field(default_factory=options.SceneOptions)
    overwrite: options.Overwrite = False
    json: options.Json = False

    def run(self) -> None:
        """Refine, write the field file and its page, and print the figures."""
        if self.minutes is not None and self.steps is not None:
            raise options.UsageError("give --minutes or --steps, not both")
        defined = self.loading.parameters()
        files.check(self.output, (".safetensors",), self.overwrite)
        extras.need("train", "a refinement's page", "matplotlib", "PIL")
        environment = self.loading.environment()
        from mi_ntf.refine import print_summary, refine

        report = refine(self.scene, self.dataset, self.output, parameters=tuple(self.parameters.split(",")),
                        minutes=self.minutes, steps=self.steps, seed=self.seed, gains=not self.no_gains,
                        size=self.size, masks=self.masks, background=self.background, defined=defined,
                        environment=environment)
        options.print_report(report, self.json, print_summary)

"""Commands that judge pictures and methods: compare, explain, tradeoff."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ntf.commands import options
from mi_ntf.core import extras, progress
from mi_ntf.evaluate.limits import Limits, broken, given


@dataclass
class Compare:
    """Measure an image against a reference; the exit code is 1 beyond a limit."""

    image: Annotated[Positional[Path], options.named("IMAGE")]
    """Image to judge, EXR or PNG."""
    reference: Annotated[Positional[Path], options.named("REFERENCE")]
    """Image taken as truth, EXR or PNG."""
    output: options.OptionalOutput = None
    """Picture to write, .png: both images, their difference, HDR-FLIP."""
    limits: Annotated[object, arg(name="", constructor=Limits)] = field(default_factory=Limits)
    masked: options.Flag = False
    """Apply the limits to the object's pixels, where the reference's alpha is above 0.5, not to the whole picture."""
    json: options.Json = False

    def run(self) -> int:
        """Print the metrics, and the exceeded limits to standard error."""
        if self.masked and not given(self.limits):
            raise options.UsageError("--masked says what limits judge; give one, as --max-relative-rmse 0.05")
        extras.need("eval", "a comparison", "skimage", "flip_evaluator", *(["matplotlib"] if self.output else []))
        with progress.Stage(f"comparing {self.image}"):
            from mi_ntf.evaluate.compare import compare, print_table

            result = compare(self.image, self.reference, self.output)
        failures = broken(result, self.limits, self.masked)
        options.print_report(result | ({"exceeded": failures} if given(self.limits) else {}), self.json, print_table)
        for failure in failures:
            print(f"mi-ntf: {failure['says']}", file=sys.stderr)
        return 1 if failures else 0


@dataclass
class Explain:
    """Describe how a scene would be rendered, why, and at which cost."""

    scene: options.Scene
    """Scene with an nrf medium."""
    measure: options.Flag = False
    """Render the scene, and show the measured seconds beside those that a pilot predicts."""
    loading: options.InScene = field(default_factory=options.SceneOptions)
    json: options.Json = False

    def run(self) -> None:
        """Print the description."""
        parameters = self.loading.parameters()
        from mi_ntf.render.commands.explain import explain, print_table

        report = explain(self.scene, parameters, self.measure, self.loading.environment())
        options.print_report(report, self.json, print_table)


@dataclass
class Tradeoff:
    """Study error over time on a scene: a page with the curve of every method."""

    scene: options.Scene
    """Scene with an nrf medium and integrator."""
    output: options.OutputFolder = Path("tradeoff")
    """Folder for index.html, tradeoff.csv and tradeoff.json. An interrupted study continues in it."""
    budget: Annotated[str, options.named("TIME")] = "5m"
    """Time that the study may take: 90s, 5m, 1h."""
    reference: options.OptionalFile = None
    """The path-traced mesh: an EXR picture or the XML file of its scene. Shipped scenes have theirs."""
    loading: options.InScene = field(default_factory=options.SceneOptions)
    json: options.Json = False

    def run(self) -> None:
        """Measure, write the page, and print the table."""
        parameters = self.loading.parameters()
        extras.need("eval", "the page of a study", "matplotlib", "PIL")
        from mi_ntf.evaluate.budget import seconds
        from mi_ntf.evaluate.tradeoff import study

        try:
            budget = seconds(self.budget)
        except ValueError as error:
            raise options.UsageError(str(error)) from None
        report = study.tradeoff(self.scene, self.output, parameters, budget, self.reference,
                                environment=self.loading.environment())
        options.print_report(report, self.json, lambda result: study.print_table(result, self.output))

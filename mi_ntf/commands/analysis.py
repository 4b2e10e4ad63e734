"""Commands that judge pictures and methods: compare, explain, tradeoff."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from mi_ntf.commands import options
from mi_ntf.commands.options import Define, Json, OptionalOutput, UsageError
from mi_ntf.evaluate.limits import Limits, broken, given


@dataclass
class Compare:
    """Measure an image against a reference. The exit code is 1 if a limit is exceeded."""

    image: Positional[Path]
    """Image to judge, EXR or PNG."""
    reference: Positional[Path]
    """Image taken as truth, EXR or PNG."""
    output: OptionalOutput = None
    """PNG to write: both images, their difference, HDR-FLIP."""
    limits: Annotated[object, arg(name="", constructor=Limits)] = field(default_factory=Limits)
    masked: bool = False
    """Apply the limits to the object's pixels, where the reference's alpha is above 0.5, not to the whole picture."""
    json: Json = False

    def run(self) -> int:
        """Print the metrics, and the exceeded limits to standard error."""
        if self.masked and not given(self.limits):
            raise UsageError("--masked says what limits judge; give one, as --max-relative-rmse 0.05")
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

    scene: Positional[Path]
    """Scene with an nrf medium."""
    define: Define = ()
    measure: bool = False
    """Render the scene, and show the measured seconds beside those that a pilot predicts."""
    json: Json = False

    def run(self) -> None:
        """Print the description."""
        parameters = options.definitions(self.define)
        from mi_ntf.render.commands.explain import explain, print_table

        options.print_report(explain(self.scene, parameters, self.measure), self.json, print_table)


@dataclass
class Tradeoff:
    """Study error against time on a scene: the curve of every method, as a page."""

    scene: Positional[Path]
    """Scene with an nrf medium and integrator."""
    output: Annotated[Path, arg(aliases=("-o",), metavar="DIR")] = Path("tradeoff")
    """Folder for index.html, tradeoff.csv and tradeoff.json. An interrupted study continues in it."""
    define: Define = ()
    budget: str = "5m"
    """Time that the study may take: 90s, 5m, 1h."""
    reference: Annotated[Path | None, arg(metavar="FILE")] = None
    """The path-traced mesh: an EXR picture or the XML file of its scene. Shipped scenes have theirs."""
    json: Json = False

    def run(self) -> None:
        """Measure, write the page, and print the table."""
        parameters = options.definitions(self.define)
        from mi_ntf.evaluate.budget import seconds
        from mi_ntf.evaluate.tradeoff import study

        try:
            budget = seconds(self.budget)
        except ValueError as error:
            raise UsageError(str(error)) from None
        options.print_report(study.tradeoff(self.scene, self.output, parameters, budget, self.reference, self.json),
                     self.json, study.print_table)

"""Write docs/plugins.md: every plugin and its parameters, further outputs, visibility methods.

    python tools/plugin_reference.py

All of it stands in the package: in the docstrings of the modules of the plugins and of the outputs, whose tables and
examples are reStructuredText, and in the registry of visibility methods. Needs no variant of Mitsuba.
"""

import ast
import itertools
import re
import textwrap
from pathlib import Path

from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.infer.visibility.method import Method

CODE = ".. code-block:: "
ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "plugins.md"
PACKAGE = ROOT / "mi_ntf" / "render"

PLUGINS = {
    "Integrator `nrf`": "plugins/integrator.py",
    "Medium `nrf`": "plugins/medium.py",
    "Emitter `ntf`": "plugins/emitter.py",
    "Phase function `nrf`": "plugins/phase.py",
    "Further outputs (`aovs`)": "transport/aovs.py",
}
"""Heading → file whose docstring is the text below it."""

INTRODUCTION = """# Plugins

This page is generated from the docstrings of the plugins by `python tools/plugin_reference.py`.
[Lights and effects](guides/lights.md) says how the plugins work together.

- Derivatives: [what can be differentiated](guides/lights.md#derivatives), [notebook](notebooks/derivatives.md).
- Stock `path`: [a field's shadow](notebooks/stock_path.md) with the emitter `ntf`.
- Further outputs: [table](#further-outputs-aovs), [notebook](notebooks/outputs.md).
"""
METHODS = """## Visibility methods

These are the values of `visibility`. Discrete lights are point, spot and directional lights and the cells of
environments. Other lights, such as area lights, are sampled at random.
[Accuracy and time](guides/accuracy.md#choose-a-visibility-method) says which one to choose.
"""


def page() -> str:
    """The text of docs/plugins.md."""
    parts = [f"## {heading}\n\n{markdown(docstring(file))}\n" for heading, file in PLUGINS.items()]
    return "\n".join([INTRODUCTION, *parts, METHODS, methods(), ""])


def docstring(file: str) -> str:
    """Return the docstring of a module in the folder of the renderer."""
    return ast.get_docstring(ast.parse((PACKAGE / file).read_text(encoding="utf-8"))) or ""


def examples(text: str) -> dict[str, str]:
    """Return the code blocks of reStructuredText: language → code."""
    blocks = text.split("\n\n")
    return {before.removeprefix(CODE): textwrap.dedent(block)
            for before, block in itertools.pairwise(blocks) if before.startswith(CODE)}


def markdown(text: str) -> str:
    """Convert reStructuredText with simple tables and code blocks to Markdown."""
    parts = []
    for block in text.split("\n\n"):
        lines = block.splitlines()
        if block.startswith(CODE):
            parts.append(f"```{block.removeprefix(CODE)}")
        elif block.startswith(" "):
            parts[-1] += f"\n{textwrap.dedent(block)}\n```"
        else:
            parts.append(inline(table(simple_table(lines)) if is_border(lines[0]) else block))
    return "\n\n".join(parts)


def inline(text: str) -> str:
    """Literals and references as Markdown's code."""
    return re.sub(r":\w+:`~?([^`]+)`", r"`\1`", text).replace("``", "`")


def is_border(line: str) -> bool:
    """Return True if `line` is the first one of a simple table."""
    return re.fullmatch(r"=+( +=+)+", line) is not None


def simple_table(lines: list[str]) -> list[list[str]]:
    """Cells of a simple table of reStructuredText, its head first. A line whose first column is empty goes on with the
    row above."""
    starts = [found.start() for found in re.finditer("=+", lines[0])]
    rows = []
    for line in lines:
        if is_border(line):
            continue
        cells = [line[a:b].strip() for a, b in zip(starts, [*starts[1:], None], strict=True)]
        if cells[0]:
            rows.append(cells)
        else:
            rows[-1] = [f"{above} {cell}".strip() for above, cell in zip(rows[-1], cells, strict=True)]
    return rows


def table(rows: list[list[str]]) -> str:
    """A Markdown table of `rows`, the head first. Names, which the first column holds, are set as code."""
    head, *body = ([cell.replace("|", r"\|") for cell in row] for row in rows)
    named = ([f"`{name}`" if name.isidentifier() else name, *rest] for name, *rest in body)
    return "\n".join(f"| {' | '.join(row)} |" for row in (head, ["---"] * len(head), *named))


def methods() -> str:
    """The table of visibility methods."""
    automatic = ", ".join(f"`{method.name}`" for method in REGISTRY.values() if method.automatic)
    auto = ["auto", "of the integrator: `transmittance_atlas` or `raymarch`, by the number of rays; under a limit by a "
            f"pilot one of {automatic}", "", "", ""]
    head = ["name", "what it does", "holds per light", "lights", "parameters that it reads"]
    return table([head, *(described(method) for method in REGISTRY.values()), auto])


def described(method: Method) -> list[str]:
    """The row of a visibility method."""
    return [
        method.name,
        method.summary,
        "nothing" if not method.numbers else "maps, for the field" if method.per_field else "a table",
        f"discrete, others by `{method.sampled}`" if method.sampled else "any",
        ", ".join(f"`{dial}`" for dial in method.dials),
    ]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)

"""Write docs/plugins.md: every plugin and its parameters, further outputs, visibility methods.

    python tools/plugin_reference.py

All of it stands in the package: in the docstrings of the plugins' classes and of the outputs' module, whose tables are
reStructuredText, and in the registry of visibility methods. Needs no variant of Mitsuba.
"""

import ast
import re
from pathlib import Path

from mi_ntf.infer.visibility import REGISTRY
from mi_ntf.infer.visibility.method import Method

ROOT = Path(__file__).resolve().parent.parent
PAGE = ROOT / "docs" / "plugins.md"
PACKAGE = ROOT / "mi_ntf" / "render"

PLUGINS = {
    "Integrator `nrf`": ("plugins/integrator.py", "NRFIntegrator"),
    "Medium `nrf`": ("plugins/medium.py", "NRFMedium"),
    "Emitter `ntf`": ("plugins/emitter.py", "NTFEmitter"),
    "Phase function `nrf`": ("plugins/phase.py", "NRFPhase"),
}
"""Heading → file and class of a plugin."""
OUTPUTS = "transport/aovs.py"

EXAMPLES = {
    "Integrator `nrf`": (
        """<integrator type="nrf">
    <string name="visibility" value="transmittance_map"/>
    <integer name="max_depth" value="4"/>
</integrator>""",
        """{"type": "nrf", "visibility": "transmittance_map", "max_depth": 4}""",
    ),
    "Medium `nrf`": (
        """<shape type="sphere">
    <point name="center" x="0.101624" y="0.794786" z="0.000442"/> <float name="radius" value="1.002768"/>
    <bsdf type="null"/>
    <medium type="nrf" name="interior">
        <string name="filename" value="scenes/statue/field.safetensors"/>
    </medium>
</shape>""",
        """{
    "type": "sphere",
    "center": [0.101624, 0.794786, 0.000442],
    "radius": 1.002768,
    "bsdf": {"type": "null"},
    "interior": {"type": "nrf", "filename": "scenes/statue/field.safetensors"},
}""",
    ),
    "Emitter `ntf`": (
        """<emitter type="ntf">
    <emitter type="point"> <point name="position" x="1.5" y="2.6" z="2.7"/> </emitter>
    <medium type="nrf"> <string name="filename" value="scenes/statue/field.safetensors"/> </medium>
</emitter>""",
        """{
    "type": "ntf",
    "light": {"type": "point", "position": [1.5, 2.6, 2.7]},
    "field": {"type": "nrf", "filename": "scenes/statue/field.safetensors"},
}""",
    ),
}
"""Heading → the plugin as XML and as dictionary of `mi.load_dict`."""

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
    parts = [INTRODUCTION]
    for heading, (file, name) in PLUGINS.items():
        summary, _, rest = markdown(docstring(PACKAGE / file, name)).partition("\n\n")
        parts.append("\n\n".join([f"## {heading}", summary, *example(heading), rest, ""]).rstrip("\n") + "\n")
    parts.append(f"## Further outputs (`aovs`)\n\n{markdown(docstring(PACKAGE / OUTPUTS))}\n")
    return "\n".join([*parts, METHODS, methods(), ""])


def example(heading: str) -> list[str]:
    """Return code blocks with the plugin as XML and as dictionary."""
    blocks = zip(("xml", "python"), EXAMPLES.get(heading, ()), strict=False)
    return [f"```{language}\n{code}\n```" for language, code in blocks]


def docstring(file: Path, name: str | None = None) -> str:
    """The docstring of the class `name` in `file`, wherever it is defined there, or that of the module."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    if name is None:
        return ast.get_docstring(tree)
    classes = (node for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    return next(ast.get_docstring(node) for node in classes if node.name == name)


def markdown(text: str) -> str:
    """reStructuredText with simple tables as Markdown."""
    blocks = (block.splitlines() for block in text.split("\n\n"))
    return inline("\n\n".join(table(simple_table(b)) if is_border(b[0]) else "\n".join(b) for b in blocks))


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
        f"discrete, others by `{method.drawn}`" if method.drawn else "any",
        ", ".join(f"`{dial}`" for dial in method.dials),
    ]


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
    print(PAGE)

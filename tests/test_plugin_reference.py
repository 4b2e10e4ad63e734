"""docs/plugins.md says what the docstrings and the registry say."""

import ast
import re
import sys
from pathlib import Path

import mitsuba as mi
import pytest
from helpers.variants import VARIANT

import mi_ntf
from mi_ntf.infer.visibility import names
from mi_ntf.render.plugins import properties

ROOT = Path(__file__).parents[1]
PAGE = ROOT / "docs" / "plugins.md"


@pytest.fixture(scope="module")
def reference():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import plugin_reference
    finally:
        sys.path.pop(0)
    return plugin_reference


def section(heading: str) -> str:
    """The text below a heading of the page."""
    return PAGE.read_text(encoding="utf-8").split(f"## {heading}\n")[1].split("\n## ")[0]


def test_the_page_is_up_to_date(reference):
    same = reference.page() == PAGE.read_text(encoding="utf-8")
    assert same, "docs/plugins.md is old; write it anew: python tools/plugin_reference.py"


@pytest.mark.parametrize(
    ("heading", "legal"),
    [
        ("Integrator `nrf`", properties.INTEGRATOR),
        ("Medium `nrf`", properties.MEDIUM),
        ("Emitter `ntf`", properties.EMITTER),
        ("Visibility methods", names()),
    ],
)
def test_every_name_has_a_row(heading, legal):
    for name in legal:
        assert f"\n| `{name}` | " in section(heading)


def test_examples_load_and_agree(reference, monkeypatch):
    """The XML and the dictionary of each example make the same object."""
    monkeypatch.chdir(ROOT)
    mi.set_variant(VARIANT)
    mi_ntf.register()
    found = [reference.examples(reference.docstring(file)) for file in reference.PLUGINS.values()]
    assert sum(map(bool, found)) == 3
    for example in filter(None, found):
        from_xml = mi.load_string(_versioned(example["xml"]))
        from_dict = mi.load_dict(ast.literal_eval(example["python"]))
        assert type(from_xml) is type(from_dict)
        assert _described(from_xml) == _described(from_dict)


def _versioned(xml: str) -> str:
    """Return a fragment of a scene as a document of its own."""
    return re.sub(r"^(<\w+)", r'\1 version="3.9.0"', xml)


def _described(plugin: mi.Object) -> str:
    """Return the text of a plugin without identifiers and addresses."""
    return re.sub(r'id = "[^"]*"|0x[0-9a-f]+|_arg_\d+|__root__[\w.]*', "", str(plugin))


def test_tables_become_markdown(reference):
    """Long cells go on below, blank ones stay, signs of Markdown's own are kept."""
    text = "A ``b``.\n\n== ==== =====\nx  kind value\n== ==== =====\none     a | b\n        c\n(2)d    e\n== ==== ====="
    lines = ["| x | kind | value |", "| --- | --- | --- |", r"| `one` |  | a \| b c |", "| (2) | d | e |"]
    code = "\n\n.. code-block:: xml\n\n    <a>\n        ``b``\n    </a>"
    blocks = ["", "```xml", "<a>", "    ``b``", "</a>", "```"]
    assert reference.markdown(text + code).splitlines() == ["A `b`.", "", *lines, *blocks]

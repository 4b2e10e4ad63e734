"""docs/plugins.md says what the docstrings and the registry say."""

import sys
from pathlib import Path

import pytest

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


def test_tables_become_markdown(reference):
    """Long cells go on below, blank ones stay, signs of Markdown's own are kept."""
    text = "A ``b``.\n\n== ==== =====\nx  kind value\n== ==== =====\none     a | b\n        c\n(2)d    e\n== ==== ====="
    lines = ["| x | kind | value |", "| --- | --- | --- |", r"| `one` |  | a \| b c |", "| (2) | d | e |"]
    assert reference.markdown(text).splitlines() == ["A `b`.", "", *lines]

"""Optional packages: one sentence where they are missing."""

import sys

import pytest

from mi_ntf.core import extras
from mi_ntf.core.errors import MiNtfError


def test_a_missing_package_is_named_with_the_line_that_installs_it(monkeypatch):
    extras.need("eval", "a picture", "json")
    monkeypatch.setitem(sys.modules, "json", None)
    monkeypatch.setitem(sys.modules, "csv", None)
    with pytest.raises(MiNtfError) as error:
        extras.need("eval", "a picture", "json", "csv", "re")
    assert str(error.value) == "a picture needs the extra `eval` (json, csv missing): run pip install 'mi-ntf[eval]'"

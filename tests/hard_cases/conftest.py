"""The catalogue of hard cases: each check is a row, and ``pytest tests/hard_cases --catalogue`` prints them all."""

from collections import Counter

import mitsuba as mi
import numpy as np
import pytest
from helpers import hard_cases, scenes
from helpers.maps import find_medium
from helpers.variants import VARIANT
from hypothesis import settings

import mi_ntf.render
from mi_ntf.render import user_cache
from mi_ntf.render.maps import map_cache

# Properties are deterministic: the same examples in every run, no deadline, since the machine may be busy.
# The catalogue takes more of them; `pytest_configure` comes before the tests are imported.
settings.register_profile("hard", deadline=None, derandomize=True, max_examples=4, print_blob=True)


def pytest_configure(config):
    if config.getoption("--catalogue", False):
        settings.register_profile("hard", settings.get_profile("hard"), max_examples=12)


def pytest_addoption(parser):
    parser.addoption("--catalogue", action="store_true", help="print every check of the hard cases as a table")


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="session")
def blobs(tmp_path_factory):
    """A field file of the asymmetric object, σ = 20."""
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0, visibility=True)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


@pytest.fixture
def medium(path):
    return find_medium(path)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """The folder of maps, not yet made."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    map_cache.forget()
    user_cache._warned.clear()
    yield tmp_path / "cache" / "mi-ntf" / "maps"
    map_cache.forget()


@pytest.fixture
def warnings(monkeypatch):
    """Texts of the warnings that are logged."""
    texts = []
    monkeypatch.setattr(user_cache.mi, "Log", lambda level, text: level < mi.LogLevel.Warn or texts.append(text))
    return texts


@pytest.fixture
def check(record_property):
    """``check(case, method, what, error, bound)``: one row of the catalogue.

    `error`: what was measured, a number or an array, whose largest absolute value counts; NaN fails.
    """

    def row(case, method, what, error, bound):
        worst = float(np.max(np.abs(np.asarray(error, np.float64)), initial=0.0))
        good = bool(worst <= bound)
        record_property(hard_cases.PROPERTY, [case, method, what, f"{worst:.2g}", f"{bound:.2g}", good])
        assert good, f"{case} by {method}: {what} is off by {worst:.3g}, allowed {bound:.3g}"

    return row


def pytest_terminal_summary(terminalreporter, config):
    """The table, from the reports: so it is whole also where several processes ran the tests."""
    reports = [r for kind in ("passed", "failed", "error") for r in terminalreporter.getreports(kind)]
    rows, cases = [], Counter()
    for report in reports:
        if "hard_cases" not in report.nodeid or (report.when != "call" and report.outcome == "passed"):
            continue
        cases[report.outcome] += 1
        found = [v for k, v in getattr(report, "user_properties", []) if k == hard_cases.PROPERTY]
        if report.outcome == "failed" and all(row[-1] for row in found):
            found.append([report.nodeid.split("/")[-1], "", "raised an error", "", "", False])
        rows += found or [[report.nodeid.split("/")[-1], "", "as expected", "", "", True]]
    if config.getoption("catalogue", False):
        terminalreporter.section("catalogue of hard cases")
        terminalreporter.write_line(hard_cases.table(rows))
    if rows:
        open_ = sum(not row[-1] for row in rows)
        terminalreporter.write_line(
            f"hard cases: {sum(cases.values())} cases, {len(rows)} values checked, {open_} of them open"
        )

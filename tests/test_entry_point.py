"""The entry point by which Mitsuba 3.10 finds the plugins."""

from importlib.metadata import entry_points
from pathlib import Path

from helpers.programs import run_program

LOADER = """
import importlib, importlib.metadata, sys, warnings
warnings.simplefilter("error")
import mitsuba as mi

found = sorted(importlib.metadata.entry_points(group="mitsuba"), key=lambda entry: entry.name)
modules = {}

def variant(name):
    # What mitsuba.set_variant of 3.10 does after a change.
    mi.set_variant(name)
    for entry in found:
        known = modules.get(entry.value)
        modules[entry.value] = importlib.reload(known) if known else importlib.import_module(entry.value)

"""


def test_it_names_a_module_of_the_package():
    [entry] = [entry for entry in entry_points(group="mitsuba") if entry.name == "mi_ntf"]
    assert entry.value == "mi_ntf.mitsuba_plugin"  # Mitsuba imports the value as it stands


def test_loading_it_as_mitsuba_does_registers_the_plugins_in_every_variant_that_they_run_in(tmp_path: Path):
    code = LOADER + """
for name in ("scalar_rgb", "llvm_ad_spectral", "llvm_ad_rgb", "scalar_rgb", "llvm_ad_rgb"):
    variant(name)
    assert ("mi_ntf.render" in sys.modules) == ("registered" in globals() or name == "llvm_ad_rgb"), name
    if name == "llvm_ad_rgb":
        registered = True
        assert type(mi.load_dict({"type": "nrf", "visibility": "raymarch"})).__name__ == "NRFIntegrator"
        light = {"type": "ntf", "light": {"type": "point"}}
        try:
            mi.load_dict(light)
        except Exception as error:
            assert "needs exactly one: an nrf medium" in str(error), error
        else:
            raise AssertionError
"""
    done = run_program("python", "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


def test_twenty_changes_of_the_variant_change_nothing(tmp_path: Path):
    """Mitsuba reloads the module at each change."""
    code = LOADER + """
from mi_ntf.render.plugins import registration

variant("llvm_ad_rgb")
scene = {"type": "nrf", "visibility": "raymarch"}
first, count = type(mi.load_dict(scene)), []
callback = registration._on_variant
registration._on_variant = lambda *names: count.append(names)
for _ in range(10):
    variant("scalar_rgb")
    variant("llvm_ad_rgb")
assert type(mi.load_dict(scene)) is first
assert len(registration._classes) == 1
"""
    done = run_program("python", "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr

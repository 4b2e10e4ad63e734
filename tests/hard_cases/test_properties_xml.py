"""Every property of every plugin, given as each type of XML element and out of its range: one error that names the
plugin, the property, the value and what belongs there."""

import re

import mitsuba as mi
import pytest
from helpers import scenes
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core.errors import sentence
from mi_ntf.render.plugins import properties

SCENE = """<scene version="3.9.0"><integrator type="nrf">{integrator}</integrator>
  <emitter type="ntf">{emitter}<emitter type="point"/><ref id="m"/></emitter>
  <medium type="nrf" id="m">{filename}<integer name="resolution" value="16"/>{medium}</medium></scene>"""
PLUGINS = {"integrator": properties.INTEGRATOR, "medium": properties.MEDIUM, "emitter": properties.EMITTER}
CALLED = {"integrator": "nrf integrator", "medium": "nrf medium", "emitter": "ntf emitter"}
KINDS = {
    "Integer": '<integer name="{}" value="4"/>', "Float": '<float name="{}" value="4.5"/>',
    "String": '<string name="{}" value="4"/>', "Bool": '<boolean name="{}" value="true"/>',
    "Vector": '<vector name="{}" x="1" y="2" z="3"/>', "Color": '<rgb name="{}" value="1 2 3"/>',
    "Transform": '<transform name="{}"><scale value="4"/></transform>', "Object": '<bsdf type="diffuse" name="{}"/>',
}  # fmt: skip
NUMBERS = {"timeout", "map_memory", "scale", "sampling_weight", "noise_threshold", "max_error", "time_budget"}
WORDS = {"visibility", "bounces", "map_source", "representation", "aovs", "filename", "map_file", "shadow_gradients"}
FLAGS = {"hide_emitters", "sample_emitters", "shadow_catcher", "unbiased"}
RANGES = {
    "samples": (8, 8192), "light_samples": (0, 65536), "environment_lights": (1, 65536), "map_resolution": (0, 4096),
    "map_components": (0, 2), "map_memory": (0.0, 2.0**24), "max_depth": (-1, 1 << 20), "rr_depth": (1, 1 << 20),
    "resolution": (16, 1024),
    "scale": (1e-12, 1e12), "sampling_weight": (0.0, 1e30), "noise_threshold": (0.0, 1e6), "max_error": (0.0, 1e6),
}  # fmt: skip
CASES = [(plugin, name) for plugin, names in PLUGINS.items() for name in names]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"))


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()


def wanted(name: str) -> set[str]:
    """The types that a property takes."""
    if name in NUMBERS:
        return {"Integer", "Float"}
    return {"String"} if name in WORDS else {"Bool"} if name in FLAGS else {"Transform"} if name == "to_world" else {
        "Integer"}


def load(path, plugin: str, elements: str, own: str = "") -> str:
    """Return the error message of the scene, or nothing if it loads. `own`: the property under test."""
    parts = {p: "" for p in PLUGINS} | {plugin: elements}
    scene = SCENE if own != "resolution" else SCENE.replace('<integer name="resolution" value="16"/>', "")
    filename = "" if own == "filename" else f'<string name="filename" value="{path}"/>'
    try:
        mi.load_string(scene.format(**parts, filename=filename))
    except Exception as error:
        return sentence(error)
    return ""


@pytest.mark.parametrize(("plugin", "name"), CASES, ids=lambda v: str(v))
def test_types(path, plugin, name):
    kinds = dict(KINDS)
    if name in WORDS:  # a word that is none of the legal ones is another fault
        kinds.pop("String")
    for kind, element in kinds.items():
        said = load(path, plugin, element.format(name), name)
        if kind in wanted(name):
            refused = name in ("samples", "map_components", "resolution")  # 4 is out of their range
            emitting = name == "shadow_catcher" and "emits no light of its own" in said  # the field of this test
            expected = emitting or (refused and "expected an integer" in said)
            assert not said or expected or name == "filename", (kind, said)
        else:
            found = rf"(the (integer|number|text|boolean) .+|of type {kind.lower()})"
            assert re.search(rf"{CALLED[plugin]}: {name} is {found}, expected", said) and "\n" not in said, (kind, said)


@pytest.mark.parametrize(("plugin", "name"), [c for c in CASES if c[1] in RANGES], ids=lambda v: str(v))
def test_ranges(path, plugin, name):
    """The ends of a range are legal. One step beyond is refused, and so is text that is no number."""
    whole = name not in NUMBERS
    low, high = RANGES[name]
    element = '<integer name="{}" value="{}"/>' if whole else '<float name="{}" value="{!r}"/>'
    # A baked grid of 1024³ takes half a minute: its upper end is left out.
    for value in [low] if name == "resolution" else [low, high]:
        said = load(path, plugin, element.format(name, value), name)
        # Of a scene as a whole: the scale times the field's radius, the one light's weight.
        assert not said or "single precision reckons with" in said or "no probability mass" in said, said
    below, above = (low - 1, high + 1) if whole else (low - max(1e-13, abs(low) / 2), high * 1.01)
    for value in [below, above] + ([] if whole else [float("nan"), float("inf"), -float("inf")]):
        said = load(path, plugin, element.format(name, value), name)
        zero = "0 or " if name in ("samples", "resolution") else ""  # the default, outside of the range
        kind = "an integer" if whole else "a finite number"
        assert f"{name} is {value}, expected {kind}, {zero}{low:g}" in said, said


@pytest.mark.parametrize("plugin", PLUGINS)
def test_misspelt_names(path, plugin):
    """Every name with a letter too many or too few: the right one is suggested and all are listed."""
    for name in PLUGINS[plugin]:
        for wrong in (name + "s", name[:-1], name.replace("_", "") if "_" in name else name.upper()):
            if wrong in PLUGINS[plugin]:
                continue
            said = load(path, plugin, f'<integer name="{wrong}" value="1"/>')
            assert f'{CALLED[plugin]}: unknown property "{wrong}"' in said, said
            assert wrong.isupper() or f'did you mean "{name}"?' in said or f'"{wrong}", which belongs' in said, said
            assert f"It has {', '.join(PLUGINS[plugin])}" in said


def test_tables_of_the_docstrings_list_every_name():
    from mi_ntf.render.plugins.emitter import emitter_class
    from mi_ntf.render.plugins.integrator import integrator_class
    from mi_ntf.render.plugins.medium import medium_class
    from mi_ntf.render.plugins.phase import phase_class

    classes = {"integrator": integrator_class(), "medium": medium_class(phase_class()), "emitter": emitter_class()}
    for plugin, names in PLUGINS.items():
        table = re.findall(r"^(\w+) +(?:string|integer|float|boolean|transform) ", classes[plugin].__doc__, re.M)
        assert sorted(table) == sorted(names)

"""`mi-ntf swap` on XML alone: replaced and unchanged elements, rewritten paths, error texts."""

from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from helpers.variants import VARIANT

from mi_ntf import cli
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Architecture, Encoding, Header, Network, Similarity
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import capture_scene
from mi_ntf.render.transport import aovs
from mi_ntf.swap import _DEPTHS, swap

MESH = """<scene version="3.9.0">
    <default name="spp" value="64"/>
    <default name="light" value="point"/>
    <integrator type="path">
        <integer name="max_depth" value="6"/>
        <boolean name="hide_emitters" value="true"/>
    </integrator>
    <include filename="sensor.xml"/>
    <include filename="light_$light.xml"/>
    <texture type="bitmap" id="wood"><string name="filename" value="wood.png"/></texture>
    <bsdf type="diffuse" id="skin"><ref id="wood" name="reflectance"/></bsdf>
    <bsdf type="diffuse" id="lamp"/>
    <shape type="ply"><string name="filename" value="meshes/a.ply"/><ref id="skin"/></shape>
    <shape type="cube"><ref id="skin"/></shape>
    <shape type="rectangle"><ref id="lamp"/><emitter type="area"/></shape>
    <emitter type="envmap"><string name="filename" value="env.exr"/></emitter>
</scene>
"""
SENSOR = (
    '<scene version="3.9.0"><sensor type="perspective"><sampler type="independent">'
    '<integer name="sample_count" value="$spp"/></sampler></sensor></scene>'
)
LIGHT = '<scene version="3.9.0"><emitter type="envmap"><string name="filename" value="env.exr"/></emitter></scene>'


@pytest.fixture
def folder(tmp_path):
    return write(tmp_path)


def write(tmp_path):
    """Write the scene with its files, and return its folder."""
    scene = tmp_path / "scene"
    (scene / "meshes").mkdir(parents=True)
    for name in ("wood.png", "env.exr", "meshes/a.ply"):
        (scene / name).touch()
    (scene / "mesh.xml").write_text(MESH)
    (scene / "sensor.xml").write_text(SENSOR)
    (scene / "light_point.xml").write_text(LIGHT)
    net = Network(Encoding("frequency", octaves=1), (2,))
    header = Header(Architecture(net, net, net), Similarity((0.25, -1.0, 3.0), 1.75))
    tensors = {k: np.zeros(s, np.float32) for k, s in header.architecture.skeleton().items()}
    field_file.save(scene / "f.safetensors", header, tensors)
    return scene


def _swap(folder, out):
    swap(folder / "mesh.xml", folder / "f.safetensors", out)
    return ET.parse(out).getroot()


def test_meshes_become_one_sphere_with_the_field(folder):
    root = _swap(folder, folder / "scene.xml")
    spheres = [s for s in root.findall("shape") if s.get("type") == "sphere"]
    assert len(spheres) == 1 and len(root.findall("shape")) == 2
    sphere = spheres[0]
    assert sphere.get("id") == "field"
    assert {k: float(sphere.find("point").get(k)) for k in "xyz"} == {"x": 0.25, "y": -1.0, "z": 3.0}
    assert sphere.find("point").get("name") == "center"
    assert (sphere.find("float").get("name"), float(sphere.find("float").get("value"))) == ("radius", 1.75)
    assert sphere.find("bsdf").get("type") == "null"
    medium = sphere.find("medium")
    assert (medium.get("type"), medium.get("name")) == ("nrf", "interior")
    assert medium.find("string").attrib == {"name": "filename", "value": "f.safetensors"}


def test_the_sphere_has_a_name_of_its_own(folder):
    """Sensors and lights of includes count, as do values of $names."""
    (folder / "sensor.xml").write_text(SENSOR.replace("<sensor ", '<sensor id="field" '))
    (folder / "mesh.xml").write_text(MESH.replace('id="wood"', 'id="field_$n"').replace(
        "<integrator", '<default name="n" value="2"/><integrator'))
    sphere = _swap(folder, folder / "scene.xml").find("shape[@type='sphere']")
    assert sphere.get("id") == "field_3"


def test_integrator_is_replaced_and_keeps_depth_and_hide_emitters(folder):
    root = _swap(folder, folder / "scene.xml")
    (integrator,) = root.findall("integrator")
    assert integrator.get("type") == "nrf"
    assert [(e.tag, e.get("name"), e.get("value")) for e in integrator] == [
        ("string", "visibility", "$visibility"),
        ("integer", "max_depth", "6"),
        ("boolean", "hide_emitters", "true"),
    ]
    assert {d.get("name"): d.get("value") for d in root.findall("default")} == {
        "visibility": "auto",
        "spp": "64",
        "light": "point",
    }


def integrator(folder, *elements, version="3.9.0"):
    """Return the properties of the integrator that replaces `elements`, and the notes of the swap."""
    shape = '<shape type="cube"/>'
    text = f'<scene version="{version}"><default name="i" value="path"/>{"".join(elements)}{shape}</scene>'
    (folder / "mesh.xml").write_text(text)
    notes = swap(folder / "mesh.xml", folder / "f.safetensors", folder / "scene.xml").notes
    (properties,) = ET.parse(folder / "scene.xml").getroot().findall("integrator")
    return {e.get("name"): e.get("value") for e in properties if e.get("name") != "visibility"}, notes


def test_camel_case_of_old_versions_is_read(folder):
    old = '<integrator type="path"><integer name="maxDepth" value="4"/><boolean name="hideEmitters" value="true"/>' \
          '</integrator>'
    assert integrator(folder, old, version="0.6.0") == ({"max_depth": "4", "hide_emitters": "true"}, [])
    inner = '<scene version="0.5.0">' + old + "</scene>"
    (folder / "inner.xml").write_text(inner)
    assert integrator(folder, '<include filename="inner.xml"/>') == ({"max_depth": "4", "hide_emitters": "true"}, [])


@pytest.mark.parametrize(("old", "depth"), [
    ('<integrator type="path"/>', "-1"),
    ('<integrator type="$i"/>', "-1"),
    ('<integrator type="volpath"><integer name="rr_depth" value="3"/></integrator>', "-1"),
    ('<integrator type="path"><integer name="max_depth" value="-1"/></integrator>', "-1"),
    ('<integrator type="aov"><integrator type="path"/></integrator>', "-1"),
    ('<integrator type="prb"/>', "6"),
    ('<integrator type="direct"/>', None),  # 2, as nrf itself
    ("", None),
])
def test_a_depth_that_is_not_written_stays_the_old_integrators(folder, old, depth):
    assert integrator(folder, old)[0].get("max_depth") == depth


def test_depths_without_a_number_are_those_of_mitsuba():
    """Integrators in Python have the attribute, those in C++ do not."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(VARIANT)
    for name in ("prb", "prb_basic", "prb_projective", "prbvolpath"):
        assert mi.load_dict({"type": name}).max_depth == _DEPTHS[name] == 6


def test_channels_of_aov_stay_where_nrf_has_them(folder):
    channels = "dd.y:depth, nn:sh_normal,gn:geo_normal, pp:position,albedo:albedo,uv:uv"
    old = f'<integrator type="aov"><string name="aovs" value="{channels}"/><integrator type="path" name="image">' \
          '<integer name="max_depth" value="5"/></integrator></integrator>'
    properties, notes = integrator(folder, old)
    assert properties == {"max_depth": "5", "aovs": "depth, normal, albedo"}
    assert notes == ["left out pp:position, uv:uv of the integrator aov: nrf has depth, albedo, normal"]
    assert aovs.parse(properties["aovs"]) == ("depth", "normal", "albedo")
    with_parameter = '<default name="c" value="pp:position"/><integrator type="aov"><string name="aovs" value="$c"/>' \
                     '</integrator>'
    assert integrator(folder, with_parameter)[0] == {}
    assert cli.main(["swap", *(str(folder / name) for name in ("mesh.xml", "f.safetensors")), "-o",
                     str(folder / "o.xml")]) == 0


OWN = """<scene version="3.9.0">
    <default name="light" value="point"/> <default name="mat" value="hide"/>
    <path value="parts"/>
    <include filename="props.xml"/>
    <include filename="light_$light.xml"/>
    <emitter type="area" id="glow"/>
    <shape type="merge">
        <shape type="obj"><string name="filename" value="meshes/cow.obj"/>
            <bsdf type="diffuse" id="hide"><texture type="checkerboard" id="spots" name="reflectance"/></bsdf></shape>
        <shape type="merge"><shape type="rectangle" id="lamp"><include filename="lamp.xml"/></shape></shape>
    </shape>
    <shape type="merge"><shape type="cube"/></shape>
    <shape type="shapegroup" id="grass"><shape type="cylinder"><ref id="blade"/></shape></shape>
    <shape type="shapegroup" id="moss"><shape type="sphere"/></shape>
    <shape type="instance"><ref id="grass"/></shape>
    <shape type="instance"><ref id="moss"/></shape>
    <shape type="disk"><ref id="glow"/></shape>
    <shape type="rectangle" id="floor"><ref id="hide"/></shape>
    <bsdf type="diffuse" id="blade"/>
    <bsdf type="diffuse" id="unused"/>
    <bsdf type="diffuse" id="flame"/>
</scene>"""
PARTS = {
    "parts/props.xml": """<scene version="0.6.0">
        <shape type="cube" id="table"><bsdf type="diffuse"><texture type="bitmap" name="diffuseReflectance">
            <string name="filename" value="wood.png"/>
            <float name="uscale" value="2"/> <float name="voffset" value="0.5"/>
        </texture></bsdf></shape></scene>""",
    "parts/lamp.xml": '<emitter version="3.0.0" type="area"/>',
    "light_point.xml": '<scene version="3.0.0"><emitter type="point" id="sun"/></scene>',
    "light_fire.xml": """<scene version="3.0.0">
        <shape type="disk"><ref id="flame"/><emitter type="area"/></shape></scene>""",
}


@pytest.fixture
def own(folder):
    """A scene with a floor, lights and groups in a scene whose parts are in many places."""
    (folder / "parts").mkdir()
    for name, text in {"mesh.xml": OWN, **PARTS}.items():
        (folder / name).write_text(text)
    return folder


def _shapes(root):
    return [s.get("id") or s.get("type") for s in root.iter("shape")]


def test_chosen_shapes_are_replaced_and_all_others_stay(own):
    report = swap(own / "mesh.xml", own / "f.safetensors", own / "scene.xml", "cow,instance2")
    assert str(report) == (
        "replaced: cow (obj), instance2; kept: table (cube), cube, instance1, floor (rectangle), lamp (area light), "
        "disk (area light), glow (area), sun (point)")
    root = ET.parse(own / "scene.xml").getroot()
    assert _shapes(root) == ["table", "field", "merge", "merge", "lamp", "merge", "cube", "grass", "cylinder",
                             "instance", "disk", "floor"]


def test_all_but_a_floor_is_replaced(own):
    report = swap(own / "mesh.xml", own / "f.safetensors", own / "scene.xml", "not:floor")
    assert report.replaced == ["table (cube)", "cow (obj)", "cube", "instance1", "instance2"]
    root = ET.parse(own / "scene.xml").getroot()
    assert _shapes(root) == ["field", "merge", "merge", "lamp", "disk", "floor"]


def test_materials_that_others_refer_to_are_kept_out_of_replaced_shapes(own):
    """Everything that a floor's material given as $name may refer to stays; light_fire.xml needs the flame."""
    assert [b.get("id") for b in _swap(own, own / "scene.xml").findall("bsdf")] == ["flame"]
    for floor, bsdfs, textures in (("hide", ["hide", "flame"], []), ("spots", ["flame"], ["spots"]),
                                   ("$mat", ["hide", "blade", "unused", "flame"], [])):
        (own / "mesh.xml").write_text(OWN.replace('floor"><ref id="hide"', f'floor"><ref id="{floor}"'))
        swap(own / "mesh.xml", own / "f.safetensors", own / "scene.xml", "not:floor")
        root = ET.parse(own / "scene.xml").getroot()
        assert [b.get("id") for b in root.findall("bsdf")] == bsdfs
        assert [t.get("id") for t in root.findall("texture")] == textures
        assert not any(e.get("name") for e in root.findall("texture"))  # the scene has no property of that name


def test_includes_are_found_by_paths_and_old_ones_are_upgraded(own):
    """Mitsuba's own upgrade is the standard. It is by the version of each file."""
    swap(own / "mesh.xml", own / "f.safetensors", own / "out" / "scene.xml", "cow")
    root = ET.parse(own / "out" / "scene.xml").getroot()
    (texture,) = root.find("shape[@id='table']/bsdf")
    assert texture.get("name") == "reflectance"
    assert [(e.tag, e.attrib) for e in texture.find("transform[@name='to_uv']")] == [
        ("translate", {"y": "0.5"}), ("scale", {"x": "2"})]
    assert not texture.findall("float")
    assert root.find(".//shape[@id='lamp']/include").get("filename") == "../parts/lamp.xml"


def test_a_wrong_name_of_a_shape_lists_the_names(own):
    command = ["swap", str(own / "mesh.xml"), str(own / "f.safetensors"), "-o", str(own / "scene.xml"), "--shapes"]
    with pytest.raises(MiNtfError, match=r"no shape is called 'lawn'; the scene has table, cow, cube, instance1, "):
        swap(own / "mesh.xml", own / "f.safetensors", own / "scene.xml", "not:lawn")
    assert cli.main([*command, "not:lawn"]) == 1 and not (own / "scene.xml").exists()


def test_capture_and_swap_give_shapes_the_same_names(folder):
    """Capture reads Mitsuba's own parse, and swap reads the XML."""
    mi = pytest.importorskip("mitsuba")
    mi.set_variant(VARIANT)
    (folder / "mesh.xml").write_text("""<scene version="3.9.0"> <default name="name" value="b"/>
        <shape type="cube"/> <include filename="part.xml"/> <shape type="sphere" id="$name"/>
        <shape type="rectangle"><emitter type="area"/></shape>
        <shape type="merge"><shape type="cube"/> <shape type="rectangle"/></shape>
        <shape type="shapegroup" id="g"><shape type="cube"/></shape> <shape type="instance"><ref id="g"/></shape>
        <shape type="instance"><ref id="g"/></shape></scene>""")
    (folder / "part.xml").write_text('<scene version="2.0.0"><shape type="cube"/> <shape type="disk" id="d"/></scene>')
    (note,) = capture_scene.load(folder / "mesh.xml", "not:b").notes
    report = swap(folder / "mesh.xml", folder / "f.safetensors", folder / "scene.xml", "not:b")
    names = "cube1, cube2, d (disk), cube3, rectangle, instance1, instance2"
    assert note == f"photographed: {names}; left out: b (sphere), rectangle (area light)"
    assert str(report) == f"replaced: {names}; kept: b (sphere), rectangle (area light)"


def test_values_of_names_become_their_defaults(folder):
    """Capture and swap see the same shapes with the same -D; the other default stays."""
    (folder / "mesh.xml").write_text("""<scene version="3.9.0"> <default name="name" value="b"/>
        <default name="spp" value="4"/> <shape type="cube"/> <shape type="sphere" id="$name"/></scene>""")
    report = swap(folder / "mesh.xml", folder / "f.safetensors", folder / "scene.xml", "cube", {"name": "ball"})
    assert str(report) == "replaced: cube; kept: ball (sphere)"
    defaults = {d.get("name"): d.get("value") for d in ET.parse(folder / "scene.xml").getroot().iter("default")}
    assert defaults == {"name": "ball", "spp": "4", "visibility": "auto"}


def test_the_command_prints_what_is_replaced_and_what_comes_next(own, capsys):
    out = own / "scene.xml"
    assert cli.main(["swap", str(own / "mesh.xml"), str(own / "f.safetensors"), "-o", str(out), "--shapes",
                     "not:floor"]) == 0
    first, *rest = capsys.readouterr().out.splitlines()
    assert first.startswith("replaced: table (cube), ") and "; kept: floor (rectangle), " in first
    assert rest == [f"scene: {out}", f"next: mitsuba -m llvm_ad_rgb {out}"]


def test_emitters_includes_and_what_they_use_stay(folder):
    root = _swap(folder, folder / "scene.xml")
    assert [e.get("filename") for e in root.findall("include")] == ["sensor.xml", "light_$light.xml"]
    assert [b.get("id") for b in root.findall("bsdf")] == ["lamp"]  # used by the emitting rectangle
    assert root.findall("texture") == []  # used by a dropped BSDF alone
    assert root.find("emitter/string").get("value") == "env.exr"
    assert (folder / "scene.xml").read_text().count("\n    <") > 6  # formatted
    assert not list(folder.glob("*.part"))


def test_includes_with_shapes_are_inlined_recursively(folder):
    (folder / "parts").mkdir()
    (folder / "parts" / "all.xml").write_text(
        '<scene version="3.9.0"><include filename="inner.xml"/><include filename="lights.xml"/></scene>'
    )
    (folder / "parts" / "inner.xml").write_text(
        '<scene version="3.9.0"><bsdf type="diffuse" id="b"/><shape type="cube"><ref id="b"/></shape></scene>'
    )
    (folder / "parts" / "lights.xml").write_text(
        '<scene version="3.9.0"><shape type="rectangle"><emitter type="area"/></shape></scene>'
    )
    (folder / "mesh.xml").write_text(
        '<scene version="3.9.0"><default name="p" value="all"/><include filename="parts/$p.xml"/></scene>'
    )
    root = _swap(folder, folder / "scene.xml")
    assert [s.get("type") for s in root.findall("shape")] == ["sphere"]
    assert root.findall("bsdf") == []
    assert [e.get("filename") for e in root.findall("include")] == ["parts/lights.xml"]
    assert len(root.findall("integrator")) == 1


def test_the_shipped_scene(folder):
    source = Path(__file__).parents[2] / "scenes" / "statue" / "mesh.xml"
    out = folder / "statue.xml"
    swap(source, folder / "f.safetensors", out)
    root = ET.parse(out).getroot()
    assert [s.get("type") for s in root.findall("shape")] == ["sphere"]
    assert all((folder / e.get("filename").replace("$light", "point")).is_file() for e in root.findall("include"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("no xml", r"mesh.xml is not XML .*give the XML file of a Mitsuba scene"),
        ("<shape/>", r"root element is <shape>, expected <scene>"),
        ('<scene><shape type="cube"><emitter type="area"/></shape></scene>', r"no shape that a field could replace"),
        ('<!DOCTYPE scene [<!ENTITY a "b">]><scene>&a;</scene>', r"mesh.xml declares the entity 'a', which Mits"),
        ('<scene><include filename="gone.xml"/></scene>', r"included file 'gone.xml' does not exist beside it$"),
        (
            '<scene><include filename="a_$b.xml"/></scene>',
            r"included file 'a_\$b.xml' .*give its \$parameters a <default>",
        ),
    ],
)
def test_errors(folder, text, message):
    (folder / "mesh.xml").write_text(text)
    with pytest.raises(MiNtfError, match=message):
        _swap(folder, folder / "scene.xml")
    assert not (folder / "scene.xml").exists()


def test_entities_are_refused_before_they_fill_the_memory(folder):
    """A few lines expand to a gigabyte. Includes are checked as well."""
    lines = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "x" * 10}">' for i in range(9))
    (folder / "sensor.xml").write_text(f"<!DOCTYPE scene [{lines}]><scene><path value='&e8;'/></scene>")
    with pytest.raises(MiNtfError, match=r"sensor.xml declares the entity 'e0'"):
        _swap(folder, folder / "scene.xml")


def test_errors_of_files(folder):
    with pytest.raises(MiNtfError, match=r"is the mesh scene itself; choose another name"):
        _swap(folder, folder / "mesh.xml")
    with pytest.raises(MiNtfError, match=r"scene .*none.xml does not exist"):
        swap(folder / "none.xml", folder / "f.safetensors", folder / "o.xml")
    with pytest.raises(MiNtfError, match=r"field file .*none.safetensors does not exist"):
        swap(folder / "mesh.xml", folder / "none.safetensors", folder / "o.xml")


def test_an_nrf_integrator_stays(folder):
    """Another object of a scene with a field becomes a field too."""
    kept, notes = integrator(folder, '<integrator type="nrf"><float name="max_error" value="0.02"/></integrator>')
    assert kept == {"max_error": "0.02"} and not notes

"""Field files: round trip, and errors that name the fault and its remedy."""

import dataclasses
import json
import re
import struct

import numpy as np
import pytest
import safetensors.numpy

from mi_ntf.core import field_file
from mi_ntf.core.architecture import FAST, Architecture, Encoding, Header, Network, Similarity, header_from_json
from mi_ntf.core.errors import MiNtfError

SMALL = Architecture(
    density=Network(Encoding("planes", (4, 6), 2), (5,)),
    reflectance=Network(Encoding("frequency", octaves=2), (4, 3)),
    transmittance=Network(Encoding("frequency", octaves=2), (7,), components=2),
)


def make_tensors(architecture, seed=0):
    rng = np.random.default_rng(seed)
    return {k: np.float32(rng.normal(size=s)) for k, s in architecture.skeleton().items()}


@pytest.fixture
def saved(tmp_path):
    path = tmp_path / "field.safetensors"
    tensors = make_tensors(SMALL)
    header = Header(SMALL, Similarity((0.5, -1.0, 2.0), 3.0), {"views": 7})
    field_file.save(path, header, tensors)
    return path, header, tensors


def test_skeleton_by_hand():
    shapes = SMALL.skeleton()
    assert shapes["density.planes.1"] == (3, 6, 6, 2)
    assert shapes["density.layers.0.weight"] == (5, 4)  # two resolutions of two channels
    assert shapes["density.layers.1.bias"] == (1,)
    assert shapes["reflectance.layers.0.weight"] == (4, 15)  # 3 + 2 octaves · (sin, cos) · 3
    assert shapes["reflectance.layers.2.weight"] == (8, 3)
    assert shapes["transmittance.layers.0.weight"] == (7, 30)  # the same of the six coordinates of a ray
    assert shapes["transmittance.layers.1.weight"] == (5, 7)  # two (a, b), one weight
    assert len(shapes) == 2 + 4 + 6 + 4


def test_round_trip(saved):
    path, header, tensors = saved
    header2, tensors2 = field_file.load(path)
    assert header2 == header
    assert field_file.load_header(path) == header
    assert set(tensors2) == set(tensors)
    for name, value in tensors.items():
        stored = value.astype(np.float16) if ".planes." in name else value  # planes are halved on purpose
        np.testing.assert_array_equal(tensors2[name], stored.astype(np.float32))
        assert tensors2[name].dtype == np.float32
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # no temporary left


def test_float32_planes_are_exact(tmp_path):
    tensors = make_tensors(SMALL)
    field_file.save(tmp_path / "f", Header(SMALL), tensors, dtype=np.float32)
    for name, value in field_file.load(tmp_path / "f")[1].items():
        np.testing.assert_array_equal(value, tensors[name])


def test_describe_counts_parameters(saved):
    path, _, tensors = saved
    info = field_file.describe(path)
    assert sum(info["parameters"].values()) == sum(v.size for v in tensors.values())
    assert info["parameters"]["reflectance"] == 15 * 4 + 4 + 4 * 3 + 3 + 3 * 8 + 8
    assert info["bytes"] == path.stat().st_size and info["similarity"]["radius"] == 3.0
    json.dumps(info)


@pytest.mark.parametrize(("provenance", "last"), [
    ({"preset": "fast", "views": {"train": 57}, "steps_done": 4654, "seconds": 1080.1, "val": {"srgb": 31.42},
      "test": {"srgb": 33.0}}, ["31.4 dB on validation photographs, 33.0 dB on test photographs",
                                "preset fast, 4654 steps in 18 min, 57 photographs"]),
    ({"field": {"steps_done": 900, "seconds": 60}, "steps_done": 8, "seconds": 3},
     ["not known", "900 steps in 60 s, 8 of transmittance alone"]),
    ({"views": 7, "val": None, "field": []}, ["not known", "not known"]),
])
def test_summary_has_six_lines_and_the_sphere_as_xml(tmp_path, capsys, provenance, last):
    header = Header(SMALL, Similarity((0.5, -1.0, 1 / 3), 3.0), provenance)
    field_file.save(tmp_path / "f", header, make_tensors(SMALL))
    field_file.print_summary(field_file.describe(tmp_path / "f"))
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 6 and re.search(r"/f, \d.* kB, \d.* parameters$", lines[0])
    assert lines[1:4] == ['sphere    <point name="center" x="0.5" y="-1" z="0.3333333"/>',
                          '          <float name="radius" value="3"/>', "networks  density, reflectance, transmittance"]
    assert [line[10:] for line in lines[4:]] == last


def test_fields_with_a_visibility_network_and_fresnel_effect_and_old_ones_without(tmp_path):
    both = dataclasses.replace(SMALL, visibility=Network(Encoding("frequency", octaves=1), (3,)), fresnel=True,
                               retro=True, tail=True)
    assert set(both.skeleton()) - set(SMALL.skeleton()) == {
        f"visibility.layers.{i}.{part}" for i in (0, 1) for part in ("weight", "bias")} | {
            "reflectance.retro", "reflectance.tail"}
    assert both.skeleton()["visibility.layers.0.weight"] == (3, 18)  # 6 + 1 octave · (sin, cos) · 6
    tensors = make_tensors(both)
    field_file.save(tmp_path / "f", Header(both), tensors)
    header, actual = field_file.load(tmp_path / "f")
    assert header.architecture == both and set(actual) == set(tensors)
    old = Header(SMALL).to_json()
    for name in ("visibility", "fresnel", "retro", "tail", "phase", "specular_channels"):
        del old["architecture"][name]
    assert header_from_json(json.loads(json.dumps(old)), "old").architecture == SMALL


def test_a_coloured_specular_weight_has_three_outputs_and_a_grey_one_has_one(tmp_path):
    colour = dataclasses.replace(SMALL, fresnel=True, specular_channels=3)
    outputs = [arch.skeleton()[f"reflectance.layers.{len(arch.reflectance.hidden)}.bias"] for arch in (SMALL, colour)]
    assert outputs == [(8,), (10,)]
    field_file.save(tmp_path / "f", Header(colour), make_tensors(colour))
    assert field_file.load(tmp_path / "f")[0].architecture == colour
    with pytest.raises(MiNtfError, match="does not match its architecture"):
        field_file.save(tmp_path / "g", Header(colour), make_tensors(SMALL))
    data = json.loads(json.dumps(Header(colour).to_json()))
    data["architecture"]["specular_channels"] = 2
    with pytest.raises(MiNtfError, match="the specular weight has 2 channels, expected 1 or 3"):
        header_from_json(data, "f")


def test_the_phase_function_of_smoke_survives_json():
    smoke = dataclasses.replace(FAST, phase=-0.25)
    assert header_from_json(json.loads(json.dumps(Header(smoke).to_json())), "x").architecture == smoke


def test_fast_preset_survives_json():
    assert header_from_json(json.loads(json.dumps(Header(FAST).to_json())), "x").architecture == FAST


@pytest.mark.parametrize(("change", "text"), [
    (lambda t: t.pop("density.planes.0"), "missing tensor density.planes.0"),
    (lambda t: t.update(extra=np.zeros(2, np.float32)), "unknown tensor extra"),
    (lambda t: t.update({"density.layers.0.bias": np.zeros(4, np.float32)}),
     r"density.layers.0.bias: expected shape \(5,\), found \(4,\)"),
    (lambda t: t["density.layers.0.bias"].__setitem__(slice(0, 2), np.nan),
     "density.layers.0.bias: 2 values are NaN or infinite"),
    (lambda t: t.update({"density.layers.0.bias": np.zeros(5, np.int32)}),
     "density.layers.0.bias: expected floating point, found int32"),
])
def test_wrong_tensors_are_named_on_saving_and_on_loading(tmp_path, change, text):
    tensors = make_tensors(SMALL)
    change(tensors)
    path = tmp_path / "field.safetensors"
    with pytest.raises(MiNtfError, match=text):
        field_file.save(path, Header(SMALL), tensors)
    assert not path.exists()
    safetensors.numpy.save_file(tensors, path, metadata={"mi_ntf": json.dumps(Header(SMALL).to_json())})
    with pytest.raises(MiNtfError, match=text) as caught:
        field_file.load(path)
    assert str(path) in str(caught.value) and "anew" in str(caught.value)


def test_all_faults_come_in_one_error(tmp_path):
    tensors = make_tensors(SMALL)
    del tensors["density.planes.0"], tensors["transmittance.layers.1.bias"]
    with pytest.raises(MiNtfError, match=r"tensor density.planes.0; missing tensor transmittance.layers.1.bias"):
        field_file.save(tmp_path / "f", Header(SMALL), tensors)


def test_planes_beyond_half_precision_are_stored_in_single(tmp_path):
    tensors = make_tensors(SMALL)
    tensors["density.planes.0"][0, 0, 0, 0] = 1e5
    field_file.save(tmp_path / "f", Header(SMALL), tensors)
    _, actual = field_file.load(tmp_path / "f")
    np.testing.assert_array_equal(actual["density.planes.0"], tensors["density.planes.0"])
    halved = tensors["density.planes.1"].astype(np.float16).astype(np.float32)
    np.testing.assert_array_equal(actual["density.planes.1"], halved)


def test_networks_that_leave_single_precision_are_refused(tmp_path):
    """Finite weights whose products overflow would show as NaN in a picture."""
    tensors = make_tensors(SMALL)
    tensors["reflectance.layers.1.weight"][0, 0] = 1e37
    with pytest.raises(MiNtfError, match=r"reflectance: its weights lead to values of .*e\+3., more than 1e\+36"):
        field_file.save(tmp_path / "f", Header(SMALL), tensors)


@pytest.mark.parametrize("kind", ["BF16", "F8_E4M3", "F64", "C64", "BOOL"])
def test_types_of_tensors_that_are_not_read(tmp_path, kind):
    """Types that NumPy lacks give a one-sentence error; float64 beyond single precision is infinite."""
    size = {"BF16": 2, "F64": 8, "C64": 8}.get(kind, 1)
    shapes = SMALL.skeleton()
    head, at, body = {"__metadata__": {"mi_ntf": json.dumps(Header(SMALL).to_json())}}, 0, b""
    for name, shape in shapes.items():
        count = int(np.prod(shape)) * size
        head[name] = {"dtype": kind, "shape": shape, "data_offsets": [at, at + count]}
        at += count
        body += b"\x7e" * count  # 10^300 in float64
    text = json.dumps(head).encode()
    (tmp_path / "f").write_bytes(struct.pack("<Q", len(text)) + text + body)
    with pytest.raises(MiNtfError, match=r"f is no field file|expected floating point|NaN or infinite in single"):
        field_file.load(tmp_path / "f")


def test_truncated_file(saved):
    path = saved[0]
    data = path.read_bytes()
    for size in (0, 6, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        with pytest.raises(MiNtfError, match=r"is no field file or is truncated .*make it anew with `mi-ntf train`"):
            field_file.load(path)


def test_foreign_and_absent_files(tmp_path):
    path = tmp_path / "foreign.safetensors"
    safetensors.numpy.save_file({"w": np.zeros(2, np.float32)}, path)
    with pytest.raises(MiNtfError, match=r"safetensors file of another program .*pass a file of `mi-ntf train`"):
        field_file.load(path)
    path.write_bytes(b"\x80\x04K\x01.")  # a pickle
    with pytest.raises(MiNtfError, match="is no field file or is truncated"):
        field_file.load(path)
    with pytest.raises(MiNtfError, match=r"not exist; make one with `mi-ntf train DATASET -o nowhere.safetensors`"):
        field_file.load(tmp_path / "nowhere.safetensors")


@pytest.mark.parametrize(("change", "text"), [
    (lambda d: d.update(format=1), "field format 1, this build reads 2; train or export the field anew"),
    (lambda d: d.pop("architecture"), "incomplete .*architecture"),
    (lambda d: d["architecture"].pop("transmittance"), "incomplete .*transmittance"),
    (lambda d: d["architecture"].update(phase=1), "phase function is 1, expected -1 to 1, exclusive"),
    (lambda d: d["architecture"].update(phase="hg"), "phase function is 'hg', expected a finite number"),
    (lambda d: d["architecture"].update(fresnel=1), "fresnel is 1, expected true or false"),
    (lambda d: d["architecture"]["density"]["encoding"].update(kind="hash"),
     "'hash' of density, expected one of planes, frequency"),
    (lambda d: d["architecture"]["transmittance"]["encoding"].update(kind="planes"),
     "'planes' of transmittance, expected one of frequency, depth"),
    (lambda d: d["architecture"]["density"]["encoding"].update(resolutions=[1]),
     "a resolution of density is 1, expected an integer, 2 to"),
    (lambda d: d["architecture"]["density"]["encoding"].update(resolutions="64"),
     "resolutions is '64', expected a list"),
    (lambda d: d["architecture"]["density"]["encoding"].update(resolutions=[]), "0 resolutions of density"),
    (lambda d: d["architecture"]["density"]["encoding"].update(channels=True),
     "channels of density is True, expected"),
    (lambda d: d["architecture"]["density"]["encoding"].update(channels=-2), "channels of density is -2, expected"),
    (lambda d: d["architecture"]["reflectance"]["encoding"].update(octaves=2000), "octaves of reflectance is 2000"),
    (lambda d: d["architecture"]["reflectance"]["encoding"].update(octaves=2.0), "octaves of reflectance is 2.0"),
    (lambda d: d["architecture"]["reflectance"]["encoding"].update(resolutions=[64]), "planes alone have any"),
    (lambda d: d["architecture"]["density"].update(hidden=[0]), "a layer's width in density is 0, expected an integer"),
    (lambda d: d["architecture"]["density"].update(hidden=[10**40]), "a layer's width in density is 10000000"),
    (lambda d: d["architecture"]["density"].update(hidden=7), "hidden is 7, expected a list"),
    (lambda d: d["architecture"]["transmittance"].update(components=0), "components of transmittance is 0"),
    (lambda d: d["architecture"].update(density=[1, 2]), "density is .1, 2., expected an object"),
    (lambda d: d["architecture"].update(visibility="yes"), "visibility is 'yes', expected an object"),
    (lambda d: d.update(architecture=[]), r"architecture is \[\], expected an object"),
    (lambda d: d.update(similarity="unit"), "similarity is 'unit', expected an object"),
    (lambda d: d["similarity"].update(radius=0), "radius is 0, expected a finite number above 0"),
    (lambda d: d["similarity"].update(radius=10**400), "radius is 1000000"),
    (lambda d: d["similarity"].update(radius="1"), "radius is '1', expected a finite number"),
    (lambda d: d["similarity"].update(radius=float("nan")), "radius is nan, expected"),
    (lambda d: d["similarity"].update(center=[0, float("inf"), 0]), "center is inf, expected"),
    (lambda d: d["similarity"].update(center=[0, 1]), r"center \[0, 1\], expected 3 numbers"),
    (lambda d: d["similarity"].update(center=[0, True, 1]), "center is True, expected"),
    (lambda d: d.update(provenance="long ago"), "provenance is 'long ago', expected an object"),
])
def test_wrong_headers(change, text):
    data = json.loads(json.dumps(Header(SMALL).to_json()))
    change(data)
    with pytest.raises(MiNtfError, match=text) as caught:
        header_from_json(data, "some.file")
    assert str(caught.value).startswith("some.file: ")


@pytest.mark.parametrize("text", ["no json", "[]", "3", "[" * 100_000, "1" * 5000])
def test_headers_that_are_no_description(tmp_path, text):
    safetensors.numpy.save_file({"w": np.zeros(2, np.float32)}, tmp_path / "f", metadata={"mi_ntf": text})
    with pytest.raises(MiNtfError, match=r"header is not JSON|field format None"):
        field_file.load(tmp_path / "f")

"""Bad input: one error that names the thing, the value and the remedy, as a user of XML sees it."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core import field_file
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.transport import rendering

LIGHT = '<emitter type="constant"/>'
FILM = '<film type="hdrfilm"><integer name="width" value="4"/><integer name="height" value="4"/></film>'
SENSOR = f'<sensor type="perspective">{FILM}</sensor>'
GOOD = '<string name="filename" value="{path}"/>'


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    folder = tmp_path_factory.mktemp("field")
    header, tensors = fields.blobs([(0, 0, 0)], [0.5])
    field_file.save(folder / "ball.safetensors", header, tensors, np.float32)
    return folder / "ball.safetensors"


def render(path, medium=GOOD, integrator="", shape="", more="", light=LIGHT):
    medium = medium.format(path=path)
    text = f"""<scene version="3.9.0"><integrator type="nrf">{integrator}</integrator>{SENSOR}{light}{more}
      <shape type="sphere">{shape}<bsdf type="null"/><medium type="nrf" name="interior">{medium}</medium></shape>
      </scene>"""
    return mi.render(mi.load_string(text), spp=1)


def check(text, *arguments, **named):
    with pytest.raises((MiNtfError, RuntimeError)) as caught:  # what a constructor raises, Mitsuba's parser wraps
        render(*arguments, **named)
    assert text in " ".join(str(caught.value).split())


def test_the_good_scene_renders(path):
    assert np.isfinite(np.array(render(path))).all()


@pytest.mark.parametrize(
    ("named", "text"),
    [
        ({"integrator": '<string name="visiblity" value="none"/>'}, '"visiblity"'),
        ({"integrator": '<string name="visibility" value="raymarsh"/>'},
         'visibility is "raymarsh", expected one of raymarch, transmittance_volume'),
        ({"integrator": '<string name="visiblity" value="none"/>'},
         'did you mean "visibility"? It has visibility, samples'),
        ({"integrator": '<integer name="foo" value="3"/>'},
         'nrf integrator: unknown property "foo". It has visibility,'),
        ({"integrator": '<integer name="seed" value="3"/>'}, 'nrf integrator: unknown property "seed"'),
        ({"integrator": '<integer name="resolution" value="64"/>'},
         'nrf integrator: unknown property "resolution", which belongs to the nrf medium'),
        ({"integrator": '<sampler type="independent"/>'},
         "nrf integrator: it has no place for the nested IndependentSampler"),
        ({"integrator": '<integer name="samples" value="3"/>'}, "samples is 3, expected an integer, 0 or 8 to 8192"),
        ({"integrator": '<string name="samples" value="100"/>'},
         'nrf integrator: samples is the text "100", expected an integer, 0 or 8 to 8192'),
        ({"integrator": '<float name="samples" value="100.7"/>'}, "samples is the number 100.7, expected an integer"),
        ({"integrator": '<boolean name="samples" value="true"/>'}, "samples is the boolean True, expected an integer"),
        ({"integrator": '<integer name="hide_emitters" value="1"/>'},
         "hide_emitters is the integer 1, expected a boolean"),
        ({"integrator": '<integer name="visibility" value="1"/>'},
         "visibility is the integer 1, expected one of raymarch"),
        ({"integrator": '<float name="timeout" value="nan"/>'}, "timeout is nan, expected a finite number"),
        ({"integrator": '<float name="map_memory" value="inf"/>'}, "map_memory is inf, expected a finite number, 0 to"),
        ({"integrator": '<string name="map_memory" value="1GB"/>'},
         'map_memory is the text "1GB", expected a finite number'),
        ({"integrator": '<string name="map_source" value="net"/>'},
         'map_source is "net", expected one of'),
        ({"integrator": '<string name="visibility" value="transmittance_map"/>'
          '<integer name="light_samples" value="2"/>'},
         "remove light_samples"),
        ({"medium": GOOD + '<float name="scal" value="2"/>'}, '"scal"'),
        ({"medium": GOOD + '<float name="scale" value="-2"/>'},
         "scale is -2.0, expected a finite number, 1e-12 to 1e+12"),
        ({"medium": GOOD + '<string name="scale" value="2"/>'}, 'nrf medium: scale is the text "2", expected a finite'),
        ({"medium": GOOD + '<float name="scale" value="nan"/>'}, "scale is nan, expected a finite number"),
        ({"medium": GOOD + '<float name="resolution" value="64.5"/>'},
         "resolution is the number 64.5, expected an integer"),
        ({"medium": GOOD + '<vector name="to_world" x="1" y="2" z="3"/>'},
         "to_world is of type vector, expected a transform"),
        ({"medium": GOOD + '<transform name="to_world"><translate x="nan"/></transform>'}, "expected finite numbers"),
        ({"medium": GOOD + '<transform name="to_world"><translate x="1e30"/></transform>'},
         "single precision reckons with"),
        ({"medium": GOOD + '<phase type="isotropic"/>'}, "nrf medium: it has no place for the nested IsotropicPhase"),
        ({"medium": GOOD + '<integer name="samples" value="100"/>'}, 'nrf medium: unknown property "samples"'),
        ({"medium": GOOD + '<integer name="resolution" value="9999"/>'},
         "resolution is 9999, expected an integer, 0 or 16 to 1024"),
        ({"medium": GOOD + '<string name="representation" value="mesh"/>'},
         'representation is "mesh", expected one of grid'),
        ({"medium": GOOD + '<transform name="to_world"><scale x="1" y="2" z="1"/></transform>'}, "is no similarity"),
        ({"medium": '<string name="filenam" value="x"/>'}, 'unknown property "filenam", did you mean "filename"?'),
        ({"medium": '<string name="filename" value=""/>'}, '"filename" is missing'),
        ({"medium": '<integer name="filename" value="3"/>'}, "filename is the integer 3, expected text"),
        ({"medium": '<string name="filename" value="nowhere.safetensors"/>'}, "nowhere.safetensors does not exist"),
        ({"shape": '<float name="radius" value="0.3"/>'}, "give shape and medium the same placement"),
        ({"shape": '<point name="center" x="1.5" y="0" z="0"/>'}, "but the nrf medium inside it"),
    ],
)  # fmt: skip
def test_bad_input(path, named, text):
    check(text, path, **named)


def test_truncated_and_foreign_field_files(path, tmp_path):
    data = path.read_bytes()
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(data[: len(data) // 2])
    check("cut.safetensors is no field file or is truncated", cut)
    foreign = tmp_path / "foreign.safetensors"
    foreign.write_bytes(b"PK\x03\x04 not a field")
    check("foreign.safetensors is no field file", foreign)


def test_no_medium():
    text = f'<scene version="3.9.0"><integrator type="nrf"/>{SENSOR}{LIGHT}<shape type="sphere"/></scene>'
    with pytest.raises(MiNtfError, match="the scene has no nrf medium and no other"):
        mi.render(mi.load_string(text), spp=1)


def test_other_errors_of_a_render_stay_as_they_are(path):
    loaded = mi.load_string(f'<scene version="3.9.0"><integrator type="path"/>{SENSOR}</scene>')
    with pytest.raises(Exception, match="primal and differential seed"):
        mi.render(loaded, seed=3, seed_grad=3)


def test_an_interrupted_render_is_interrupted(path, monkeypatch):
    """The error is no RuntimeError, on which loops over frames go on."""
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(rendering, "render", interrupt)
    with pytest.raises(KeyboardInterrupt):
        render(path)


ALIKE = '<medium type="nrf" name="interior"><string name="filename" value="{path}"/></medium>'
REFERRED = '<ref id="m" name="interior"/>'


@pytest.mark.parametrize("medium", [ALIKE, REFERRED], ids=["alike", "referred to"])
@pytest.mark.parametrize(
    ("second", "names"),
    [
        ('<shape type="sphere"><point name="center" x="3" y="0" z="0"/>', '(Sphere at (0, 0, 0), Sphere at (3, 0, 0))'),
        ('<shape type="cube" id="there">', '(Sphere at (0, 0, 0), shape "there")'),
    ],
)
def test_two_shapes_of_one_medium(path, medium, second, names):
    """Mitsuba's parser merges media of the same text into one, as if the second shape referred to the first's."""
    medium = medium.format(path=path)
    loaded = mi.load_string(f"""<scene version="3.9.0"><integrator type="nrf"/>{SENSOR}{LIGHT}
      <medium type="nrf" id="m"><string name="filename" value="{path}"/></medium>
      <shape type="sphere"><bsdf type="null"/>{medium}</shape>{second}<bsdf type="null"/>{medium}</shape></scene>""")
    with pytest.raises(MiNtfError) as caught:
        loaded.integrator().render(loaded, spp=1)
    assert f"2 bounding shapes {names} share one nrf medium ({path})" in str(caught.value)
    assert "Mitsuba merges media of the same text; give each shape a medium of its own" in str(caught.value)


def test_variant_without_jit():
    mi.set_variant("scalar_rgb")
    try:
        with pytest.raises(ValueError, match="variant scalar_rgb: the nrf and ntf plugins need llvm_ad_rgb"):
            mi_ntf.render.register()
    finally:
        mi.set_variant(VARIANT)


def test_scenes_helper_matches_the_medium(tmp_path):
    """The medium's sphere is the similarity's, where the helper puts its bounding shape."""
    loaded = scenes.scene(scenes.write_blobs(tmp_path), {"type": "nrf"}, {"light": scenes.light("point")})
    (shape,) = loaded.shapes()
    frame = shape.interior_medium().frame
    np.testing.assert_allclose(frame.origin, scenes.SIMILARITY.center)
    assert frame.length == pytest.approx(scenes.SIMILARITY.radius)

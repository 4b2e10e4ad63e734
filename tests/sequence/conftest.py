"""A small scene file of a field, as a user has it."""

import mitsuba as mi
import pytest
from helpers import scenes
from helpers.variants import VARIANT

SCENE = """<scene version="3.9.0">
    <default name="spp" value="2"/><default name="res" value="16"/><default name="visibility" value="raymarch"/>
    <default name="depth" value="2"/><default name="more" value=""/>
    <integrator type="nrf"><string name="visibility" value="$visibility"/><integer name="max_depth" value="$depth"/>
        <integer name="map_resolution" value="32"/><string name="aovs" value="$more"/></integrator>
    <sensor type="perspective"><float name="fov" value="40"/>
        <transform name="to_world"><lookat origin="2, 1.5, 6" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
            <string name="pixel_format" value="rgba"/><string name="component_format" value="float32"/>
            <rfilter type="box"/></film></sensor>
    LIGHTS
    <shape type="sphere"><point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/><medium type="nrf" name="interior"><string name="filename" value="FIELD"/>
        <integer name="resolution" value="48"/></medium></shape>
</scene>"""
POINT = """<emitter type="point" id="lamp"><point name="position" x="3" y="3" z="2.5"/>
    <rgb name="intensity" value="60, 50, 40"/></emitter>"""


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)


@pytest.fixture(scope="session")
def field(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


@pytest.fixture
def scene(field, tmp_path):
    """Function that writes a scene file with the XML of lights and returns its path."""
    def write(lights=POINT):
        path = tmp_path / "scene.xml"
        path.write_text(SCENE.replace("LIGHTS", lights).replace("FIELD", str(field)))
        return path
    return write

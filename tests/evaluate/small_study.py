"""Scenes that are small enough to be studied within a test."""

import os
from pathlib import Path

import numpy as np
from helpers import fields, scenes

from mi_ntf.core import field_file

MEDIUM = """<shape type="sphere">
        <point name="center" x="{x}" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/>
        <medium type="nrf" name="interior"><string name="filename" value="{file}.safetensors"/>
            <integer name="resolution" value="48"/>{place}</medium>
    </shape>"""
SCENE = """<scene version="3.9.0">
    <default name="res" value="24"/>
    <default name="spp" value="4"/>
    <default name="light" value="point"/>
    <default name="visibility" value="auto"/>
    <default name="noise" value="0"/>
    <default name="drawn" value="0"/>
    <integrator type="nrf">{visibility}<integer name="samples" value="48"/>
        <integer name="map_resolution" value="32"/><integer name="environment_lights" value="32"/>
        <float name="noise_threshold" value="$noise"/><integer name="light_samples" value="$drawn"/>
        <boolean name="hide_emitters" value="true"/></integrator>
    <sensor type="perspective">
        <float name="fov" value="28"/>
        <transform name="to_world"><lookat origin="1.6, 1.3, 5.3" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
        <sampler type="independent"><integer name="sample_count" value="$spp"/></sampler>
        <film type="hdrfilm"><integer name="width" value="$res"/><integer name="height" value="$res"/>
            <rfilter type="box"/></film>
    </sensor>
    {more}
</scene>
"""
POINT = """<emitter type="$light"><point name="position" x="3.4" y="3" z="2.5"/>
        <rgb name="intensity" value="60, 50, 40"/></emitter>"""
SKY = """<emitter type="constant"><rgb name="radiance" value="0.7, 0.8, 0.9"/></emitter>"""
FLOOR = """<emitter type="spot"><transform name="to_world">
        <lookat origin="-1, 4, 3" target="0.4, -0.2, 0.3" up="0, 0, 1"/></transform><rgb name="intensity" value="30"/>
    </emitter>
    <emitter type="directional"><vector name="direction" x="-1" y="-1.2" z="-0.6"/><rgb name="irradiance" value="1"/>
    </emitter>
    <shape type="rectangle"><transform name="to_world"><scale value="5"/><rotate x="1" angle="-90"/>
        <translate y="-1.3"/></transform></shape>"""
NAMED = '<string name="visibility" value="$visibility"/>'
TURNED = """<transform name="to_world"><translate x="-0.4" y="0.2" z="-0.3"/><rotate y="1" angle="40"/>
            <translate x="0.4" y="-0.2" z="0.3"/></transform>"""


def write(folder: Path) -> Path:
    """Write ``one.xml``, a field under a point light; ``sky.xml``, under a sky of 32 lights, whose method is no $name;
    ``moved.xml``, turned about its centre; and ``many.xml``, two fields with two kinds of networks on a floor under
    three lights. Return the folder."""
    for name, visibility in (("ball", False), ("seen", True)):
        header, tensors = fields.blobs(scenes.CENTERS, scenes.RADII, similarity=scenes.SIMILARITY, log_density=4.0,
                                       visibility=visibility)
        field_file.save(folder / f"{name}.safetensors", header, tensors, np.float32)
    ball = MEDIUM.format(x=0.4, file="ball", place="")
    aside = '<transform name="to_world"><translate x="{x}"/></transform>'
    pair = [MEDIUM.format(x=0.4 + x, file="seen", place=aside.format(x=x)) for x in (-1.2, 1.2)]
    pair[1] = pair[1].replace('value="48"', 'value="40"')  # Mitsuba merges media of the same text
    for name, visibility, more in (
            ("one", NAMED, POINT + ball), ("sky", "", SKY + ball), ("many", NAMED, POINT + FLOOR + "".join(pair)),
            ("moved", NAMED, POINT + MEDIUM.format(x=0.4, file="ball", place=TURNED))):
        (folder / f"{name}.xml").write_text(SCENE.format(visibility=visibility, more=more))
    return folder


def relative(folder: Path) -> str:
    """The folder as a command names it from the working folder."""
    return os.path.relpath(folder)

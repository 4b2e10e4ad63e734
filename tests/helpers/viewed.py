"""A scene for views, as text: ``{lights}`` stands for some of the emitters below."""

SCENE = """<scene version="3.9.0">
    <default name="visibility" value="transmittance_map"/>
    <integrator type="nrf">
        <string name="visibility" value="$visibility"/>
        <integer name="map_resolution" value="48"/>
        <integer name="environment_lights" value="16"/>
        <boolean name="hide_emitters" value="true"/>
    </integrator>
    <sensor type="perspective">
        <float name="fov" value="28"/>
        <transform name="to_world"><lookat origin="1.6, 1.3, 5.3" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
        <film type="hdrfilm">
            <integer name="width" value="32"/> <integer name="height" value="32"/>
            <string name="pixel_format" value="rgba"/> <rfilter type="box"/>
        </film>
    </sensor>
    {lights}
    <shape type="sphere">
        <point name="center" x="0.4" y="-0.2" z="0.3"/> <float name="radius" value="1.5"/>
        <bsdf type="null"/>
        <medium type="nrf" name="interior"><string name="filename" value="blobs.safetensors"/></medium>
    </shape>
</scene>
"""
POINT = """<emitter type="point">
        <point name="position" x="3.4" y="3" z="2.5"/> <rgb name="intensity" value="60, 50, 40"/>
    </emitter>"""
SECOND = """<emitter type="point">
        <point name="position" x="-2.5" y="2" z="3"/> <rgb name="intensity" value="10, 20, 40"/>
    </emitter>"""
SPOT = """<emitter type="spot">
        <transform name="to_world"><lookat origin="0, 4, 4" target="0.4, -0.2, 0.3" up="0, 1, 0"/></transform>
        <rgb name="intensity" value="60, 20, 60"/>
    </emitter>"""
DIRECTIONAL = """<emitter type="directional">
        <vector name="direction" x="-1" y="-1.2" z="-0.6"/> <rgb name="irradiance" value="3, 2.5, 2"/>
    </emitter>"""
ENVIRONMENT = """<emitter type="envmap">
        <string name="filename" value="sky.exr"/>
        <transform name="to_world"><rotate x="1" angle="20"/></transform>
    </emitter>"""
CONSTANT = '<emitter type="constant"><rgb name="radiance" value="0.5, 0.6, 0.8"/></emitter>'

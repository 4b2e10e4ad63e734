"""Maps on disk: files that a scene names, the cache, and parts of the lights that fit into memory."""

import dataclasses
import json
import os
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from helpers import scenes

from mi_ntf import cli
from mi_ntf.core.errors import MiNtfError
from mi_ntf.infer import tuning
from mi_ntf.infer.lights import LightTable
from mi_ntf.render import user_cache
from mi_ntf.render.commands.bake import bake
from mi_ntf.render.lights import scene_lights as lights_module
from mi_ntf.render.maps import building, map_cache, map_file
from mi_ntf.render.scene.media import find_media
from mi_ntf.render.scene.settings import Settings

WHERE = np.array([[0.48, 0.6, 0.64], [1.5, 1.0, 2.0], [0.1, 0.5, -0.1]])
IS_POINT = np.array([False, True, True])
OPTIONS = building.Options(2 / 128, 16)
SETTINGS = Settings("auto", 128, 0, 512, 16, "field", 1, 1024.0, "", 2, 5, "auto", 1, False)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0)


@pytest.fixture
def medium(path):
    loaded = scenes.scene(path, {"type": "nrf"}, {"light": scenes.light("point")}, medium={"resolution": 64})
    return find_media(loaded)[0]


def table(move=0.0):
    return LightTable(WHERE + move, np.ones((3, 3)), IS_POINT, 1.0, mi)


def build(medium, lights, options):
    return building.build("transmittance_map", medium, lights, options)


@pytest.mark.parametrize("options", [OPTIONS, dataclasses.replace(OPTIONS, map_components=2)], ids=["one", "two"])
def test_file_gives_the_same_map(medium, tmp_path, options):
    """Every texel that a lookup reads, bit for bit; also where the lights are taken in parts."""
    file = tmp_path / "maps.exr"
    made = build(medium, table(), options)
    map_file.write(file, medium, table(), options, [made])
    parts = OpenEXR.File(str(file)).parts
    assert [set(p.channels) for p in parts] == [{"a", "b"} if made.width == 2 else set("w0 a0 b0 w1 a1 b1".split())] * 3
    assert not list(tmp_path.glob("*.part*"))
    named = dataclasses.replace(options, map_file=str(file))
    x = tuple(mi.Float(c) for c in np.random.default_rng(1).uniform(-0.5, 0.5, (3, 500)).astype(np.float32))
    back = build(medium, table(), named)
    last = build(medium, table().part(1, 3), named)
    for k in range(3):
        light = table().sample(mi.UInt32(k), x, True)
        about = x, light.wi, light.distance
        expected = np.array(made.tau(*about, mi.UInt32(k), True))
        np.testing.assert_array_equal(np.array(back.tau(*about, mi.UInt32(k), True)), expected)
        if k:
            np.testing.assert_array_equal(np.array(last.tau(*about, mi.UInt32(k - 1), True)), expected)


@pytest.mark.parametrize("method", ["transmittance_atlas", "neural_transmittance"])
def test_an_atlas_is_baked_and_read(path, medium, tmp_path, method, monkeypatch):
    """By the command, from a scene that names the method: the same bits; not as a map of lights, nor as the other."""
    monkeypatch.setattr(tuning, "ATLAS_SIDE", 4)
    monkeypatch.setattr(tuning, "ATLAS_RESOLUTION", 12)
    similar = scenes.SIMILARITY
    scene = tmp_path / "scene.xml"
    scene.write_text(f"""<scene version="3.9.0"><default name="visibility" value="auto"/>
        <integrator type="nrf"><string name="visibility" value="$visibility"/><integer name="samples" value="128"/>
        </integrator><sensor type="perspective"/><shape type="sphere">
        <point name="center" x="{similar.center[0]}" y="{similar.center[1]}" z="{similar.center[2]}"/>
        <float name="radius" value="{similar.radius}"/><bsdf type="null"/><medium type="nrf" name="interior">
        <string name="filename" value="{path}"/><integer name="resolution" value="64"/></medium></shape></scene>""")
    about = bake(scene, tmp_path / "atlas.exr", {"visibility": method})
    assert (about["lights"], about["resolution"], about["components"]) == (16, 12, 2)
    named = dataclasses.replace(OPTIONS, map_file=str(tmp_path / "atlas.exr"))
    x, wi = np.random.default_rng(1).uniform(-0.5, 0.5, (2, 3, 500)).astype(np.float32)
    about = tuple(map(mi.Float, x)), tuple(map(mi.Float, wi / np.linalg.norm(wi, axis=0))), mi.Float(np.inf)
    made, read = (building.build(method, medium, None, o).tau(*about, mi.UInt32(0), True) for o in (OPTIONS, named))
    np.testing.assert_array_equal(np.array(made), np.array(read))
    with pytest.raises(MiNtfError, match="holds 16 lights, the scene has 3"):
        build(medium, table(), named)
    other = "neural_transmittance" if method == "transmittance_atlas" else "transmittance_atlas"
    with pytest.raises(MiNtfError, match="map_source is "):
        building.build(other, medium, None, named)


def test_file_of_something_else_is_refused(medium, tmp_path):
    file = tmp_path / "maps.exr"
    map_file.write(file, medium, table(), OPTIONS, [build(medium, table(), OPTIONS)])
    named = dataclasses.replace(OPTIONS, map_file=str(file))
    with pytest.raises(MiNtfError, match=r"maps.exr, light 0: where is \[0.48, .*, the scene's is \[0.4833"):
        build(medium, table(0.02), named)
    with pytest.raises(MiNtfError, match="map_resolution is 16, the scene's is 32"):
        build(medium, table(), dataclasses.replace(named, map_resolution=32))
    changed = dataclasses.replace(medium.field, digest="0" * 64)
    other = SimpleNamespace(representation="grid", field=changed, source=medium.source)
    with pytest.raises(MiNtfError, match=r"light 0: field is [0-9a-f]{64}, the scene's is [0-9a-f]{64}"):
        build(other, table(), named)
    with pytest.raises(MiNtfError, match=r"light 0: samples is 128\.0, the scene's is 384\.0; bake it anew or"):
        build(medium, table(), dataclasses.replace(named, step=2 / 384))
    with pytest.raises(MiNtfError, match="holds 3 lights, the scene has 1"):
        build(medium, LightTable(WHERE[:1], np.ones((1, 3)), IS_POINT[:1], 1.0, mi), named)
    with pytest.raises(MiNtfError, match=r"nothing\.exr does not exist; make it with `mi-ntf bake"):
        build(medium, table(), dataclasses.replace(OPTIONS, map_file=str(tmp_path / "nothing.exr")))


def test_lights_come_in_parts_that_fit(medium):
    """16² texels of 8 bytes are 2 KiB a light; two media, or two logistics, take more."""
    lights = LightTable(np.tile(WHERE[:1], (10, 1)), np.ones((10, 3)), np.zeros(10, bool), 1.0, mi)

    def parts(kib, media=1, method="transmittance_map", **other):
        settings = dataclasses.replace(SETTINGS, map_memory=kib / 1024, **other)
        return building.parts(method, [medium] * media, lights, settings)

    assert parts(1 << 20) == [(0, 10)]
    assert parts(8) == [(0, 4), (4, 8), (8, 10)]
    assert parts(8, media=2) == [(0, 2), (2, 4), (4, 6), (6, 8), (8, 10)]
    assert parts(40, map_components=2) == [(0, 5), (5, 10)]
    assert parts(640, method="transmittance_volume") == [(0, 5), (5, 10)]
    assert parts(0, method="raymarch") == [(0, 10)]
    with pytest.raises(MiNtfError, match=r"map_memory is 0.0009766 MiB, but one light takes 0.001953 MiB"):
        parts(1)


def test_parts_of_a_table_are_its_lights():
    lights = LightTable(WHERE, np.arange(9.0).reshape(3, 3), IS_POINT, 2.0, mi)
    part = lights.part(1, 3).part(1, 2)
    x = tuple(mi.Float([0.1]) for _ in range(3))
    a, b = lights.sample(mi.UInt32(2), x, True), part.sample(mi.UInt32(0), x, True)
    for name in ("wi", "irradiance", "distance"):
        np.testing.assert_array_equal(np.array(getattr(a, name)), np.array(getattr(b, name)))
    assert (part.first, part.total, part.count) == (2, 3, 1)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("MI_NTF_CACHE", "on")
    map_cache.forget()
    yield tmp_path / "mi-ntf" / "maps"
    map_cache.forget()


def test_cache_in_memory_and_on_disk(medium, cache, monkeypatch):
    options = dataclasses.replace(OPTIONS, cache=True)
    first = build(medium, table(), options)
    (file,) = cache.glob("*")
    assert build(medium, table(), options) is first
    map_cache.forget()
    again = build(medium, table(), options)
    assert again is not first
    np.testing.assert_array_equal(np.array(again.values), np.array(first.values))
    # Another light, resolution or number of logistics: another map.
    build(medium, table(0.01), options)
    build(medium, table(), dataclasses.replace(options, map_components=2))
    assert len(list(cache.glob("*"))) == 3
    # A broken file is made anew.
    map_cache.forget()
    file.write_bytes(b"nonsense")
    np.testing.assert_array_equal(np.array(build(medium, table(), options).values), np.array(first.values))
    assert file.stat().st_size > 1000
    monkeypatch.setenv("MI_NTF_CACHE", "off")
    assert build(medium, table(), options) is not build(medium, table(), options)
    monkeypatch.setenv("MI_NTF_CACHE", "no")
    with pytest.raises(MiNtfError, match='MI_NTF_CACHE is "no", expected on, memory or off'):
        build(medium, table(), options)


def test_cache_keeps_within_its_limits(medium, cache, monkeypatch):
    """Maps too large for a file are not written; of the files, those used last stay; memory keeps the newest."""
    options = dataclasses.replace(OPTIONS, cache=True)
    size = 4 * len(build(medium, table(), options).values)
    monkeypatch.setattr(user_cache, "FOLDER_LIMIT", int(2.5 * (size + 200)))
    seen = list(cache.glob("*"))
    for k in range(4):
        for file in cache.glob("*"):
            os.utime(file, (1000 + seen.index(file),) * 2)  # the clock is too coarse to tell which is newer
        build(medium, table(0.01 * (k + 1)), options)
        seen += [f for f in cache.glob("*") if f not in seen]
    assert set(cache.glob("*")) == set(seen[-2:])
    options = dataclasses.replace(options, map_memory=2 * size / 2**20)
    last = build(medium, table(0.5), options)
    assert len(map_cache._maps) == 2 and last in map_cache._maps.values()
    monkeypatch.setattr(user_cache, "LARGEST_FILE", size - 1)
    before = set(cache.glob("*"))
    build(medium, table(0.6), options)
    assert set(cache.glob("*")) == before


def test_b_keeps_sixteen_bits(medium):
    """Places on a ray in steps of 2.4/2¹⁶ or less."""
    b = np.array(build(medium, table(), OPTIONS).values)[1::2]
    b = b[np.abs(b) < 1.2]
    assert b.dtype == np.float32 and len(b) > 50 and np.spacing(np.abs(b)).max() < 2.4 / 2**16


def test_bake_command(path, tmp_path, capsys):
    """`mi-ntf bake` on a scene file; the scene's other lights and its settings are found in the EXR."""
    scene = tmp_path / "scene.xml"
    scene.write_text(f"""<scene version="3.9.0">
      <default name="m" value="24"/>
      <integrator type="nrf"><integer name="map_resolution" value="$m"/></integrator>
      <sensor type="perspective"><film type="hdrfilm"><integer name="width" value="8"/>
        <integer name="height" value="8"/></film></sensor>
      <emitter type="point"><point name="position" x="3" y="3" z="2.5"/></emitter>
      <emitter type="directional"><vector name="direction" x="-1" y="-1.2" z="-0.6"/></emitter>
      <shape type="sphere"><point name="center" x="0.4" y="-0.2" z="0.3"/><float name="radius" value="1.5"/>
        <bsdf type="null"/><medium type="nrf" name="interior"><string name="filename" value="{path}"/>
        <integer name="resolution" value="64"/></medium></shape></scene>""")
    assert cli.main(["bake", str(scene), "-o", str(tmp_path / "maps.exr"), "-D", "m=20"]) == 0
    printed = capsys.readouterr().out
    assert f"{tmp_path / 'maps.exr'} (2 lights of 20² texels, " in printed
    assert f'next: <string name="map_file" value="{tmp_path / "maps.exr"}"/> in the integrator' in printed
    parts = OpenEXR.File(str(tmp_path / "maps.exr")).parts
    assert [p.header["name"] for p in parts] == ["light 0", "light 1"]
    assert 300 < parts[0].channels["b"].pixels.size <= 400
    assert cli.main(["bake", str(scene), "-o", str(tmp_path / "again.exr"), "--json"]) == 0
    silent = capsys.readouterr()
    assert json.loads(silent.out)["lights"] == 2 and silent.err == ""
    assert cli.main(["bake", str(scene), "-o", str(scene / "maps.exr")]) == 1
    assert "cannot make the folder" in capsys.readouterr().err


def test_lights_in_runs_give_the_same_picture(path):
    """Maps of one light at a time, with a drawn light, a surface and the environment behind: nothing counts twice."""
    lights = {
        "sun": scenes.light("directional"),
        "lamp": scenes.light("point"),
        "sky": {"type": "constant", "radiance": 0.1},
        "panel": {"type": "rectangle", "emitter": {"type": "area", "radiance": 2.0},
                  "to_world": mi.ScalarTransform4f().translate([0.4, 3.0, 0.3]).rotate([1, 0, 0], 90)},
    }
    floor = {"floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0.4, -1.9, 0.3])
                       .rotate([1, 0, 0], -90).scale(3)}}

    def render(memory, **options):
        nrf = {"type": "nrf", "visibility": "transmittance_map", "map_resolution": 16, "environment_lights": 4,
               "samples": 128, "map_memory": memory, **options}
        return scenes.render(scenes.scene(path, nrf, lights, shapes=floor, size=16, spp=4, medium={"resolution": 64}))

    whole = render(1024.0)
    assert whole[..., :3].mean() > 0.1
    np.testing.assert_allclose(render(0.0025), whole, atol=2e-5)
    # Two runs or more bounce by the march: maps of 16² differ from it by some per cent of the second bounce.
    many, one = render(0.008, max_depth=3), render(1024.0, max_depth=3)
    np.testing.assert_allclose(many[..., 3], one[..., 3], atol=1e-6)
    assert many[..., :3].mean() == pytest.approx(one[..., :3].mean(), rel=0.02)


def test_scene_names_its_map_file(path, tmp_path):
    """The integrator's property; a file for another scene is refused, with both named."""
    lights = {"sun": scenes.light("directional")}

    def scene(**options):
        nrf = {"type": "nrf", "visibility": "transmittance_map", "map_resolution": 16, "samples": 128, **options}
        return scenes.scene(path, nrf, lights, size=16, spp=2, medium={"resolution": 64})

    plain = scene()
    (medium,) = find_media(plain)
    rows = lights_module.Lights(plain, [medium], 0, 512).table(medium.frame)
    options = building.options(building.resolved(plain.integrator().context.settings, rows.count, [medium]), medium)
    map_file.write(tmp_path / "maps.exr", medium, rows, options, [build(medium, rows, options)])
    np.testing.assert_array_equal(scenes.render(scene(map_file=str(tmp_path / "maps.exr"))), scenes.render(plain))
    lights["sun"]["direction"] = [0, -1, 0]
    with pytest.raises(Exception) as caught:
        scenes.render(scene(map_file=str(tmp_path / "maps.exr")))
    assert "light 0: where is [" in str(caught.value.__cause__ or caught.value)

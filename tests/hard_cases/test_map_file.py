"""Map files that do not hold what `mi-ntf bake` wrote: one sentence each, never other texels."""

import dataclasses
import json

import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from helpers import scenes
from helpers.maps import OPTIONS, build, find_medium, table
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.maps import map_file


@pytest.fixture(scope="module")
def baked(tmp_path_factory):
    """``(medium, file)``: the baked maps of the three lights."""
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    folder = tmp_path_factory.mktemp("baked")
    medium, file = find_medium(scenes.write_blobs(folder, log_density=3.0)), folder / "maps.exr"
    options = dataclasses.replace(OPTIONS, cache=False)
    map_file.write(file, medium, table(), options, [build(medium, options=options)])
    return medium, file


def read(baked, file):
    return map_file.read(file, baked[0], table(), OPTIONS, 2)


def rewrite(baked, tmp_path, change):
    """The baked file with ``change(light, header, channels)`` applied to every part."""
    parts = []
    for k, part in enumerate(OpenEXR.File(str(baked[1])).parts):
        header, channels = dict(part.header), {name: c.pixels.copy() for name, c in part.channels.items()}
        header.pop("channels")
        header.pop("dataWindow")
        channels = change(k, header, channels) or channels
        parts.append(OpenEXR.Part(header, channels))
    OpenEXR.File(parts).write(str(tmp_path / "changed.exr"))
    return tmp_path / "changed.exr"


def about(**changes):
    return lambda k, header, channels: header.update(
        {map_file.ATTRIBUTE: json.dumps(json.loads(header[map_file.ATTRIBUTE]) | changes)})


def attribute(value):
    return lambda k, header, channels: header.update({map_file.ATTRIBUTE: value})


def every_pixel(function):
    return lambda k, header, channels: {name: function(pixels) for name, pixels in channels.items()}


WRONG = {
    "no attribute": (lambda k, header, channels: header.pop(map_file.ATTRIBUTE) and None, "of another program"),
    "no JSON": (attribute("{"), "is no JSON object"),
    "a list": (attribute("[1, 2]"), "is no JSON object"),
    "a number": (attribute(3.0), "is no JSON object"),
    "endless JSON": (attribute("[" * 50_000), "is no JSON object"),
    "an empty object": (attribute("{}"), "field is None, the scene's is"),
    "where is text": (about(where="here"), "where is here, the scene's is"),
    "where is deep": (about(where=[[1.0], 2.0, 3.0]), r"where is \[\[1.0\], 2.0, 3.0\], the scene's is"),
    "where is huge": (about(where=[10**400, 0, 0]), "where is "),
    "where is NaN": (about(where=[float("nan")] * 3), r"where is \[nan, nan, nan\], the scene's is"),
    "samples is text": (about(samples="96"), "samples is 96, the scene's is 96.0"),
    "other samples": (about(samples=384.0), "samples is 384.0, the scene's is 96.0; bake it anew or render with"),
    "no hash": (about(texels=None), "holds other texels than were written"),
    "NaN": (every_pixel(lambda p: p * np.float32(np.nan)), "holds other texels than were written"),
    "zeros": (every_pixel(np.zeros_like), "holds other texels than were written"),
    "one texel": (every_pixel(lambda p: np.where(np.arange(p.size).reshape(p.shape) == 7, 2, p).astype(np.float32)),
                  "holds other texels than were written"),
    "half floats": (every_pixel(lambda p: p.astype(np.float16)), "channel a is float16"),
    "other shape": (every_pixel(lambda p: np.ascontiguousarray(p[:-1])), r"is \(\d+, \d+\) texels, expected"),
    "turned": (every_pixel(lambda p: np.ascontiguousarray(p.T)), r"is \(\d+, \d+\) texels, expected"),
    "one channel": (lambda k, header, channels: {"a": channels["a"]}, "has channels a, expected a, b"),
    "other channels": (lambda k, header, channels: {"x": channels["a"], "y": channels["b"]}, "has channels x, y"),
    "another light's size": (lambda k, header, channels: {n: np.zeros((400, 400), np.float32) for n in "ab"} if k == 2
                             else None, r"light 2: is \(400, 400\) texels"),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_every_fault_of_a_map_file_is_one_sentence(baked, tmp_path, wrong):
    change, text = WRONG[wrong]
    file = rewrite(baked, tmp_path, change)
    with pytest.raises(MiNtfError, match=text) as caught:
        read(baked, file)
    assert str(file) in str(caught.value) and "bake" in str(caught.value)


def test_bytes_changed_at_random_never_change_a_picture(baked, tmp_path, rng):
    """400 files: the very texels, or one sentence. The library reads on past chunks that it cannot decode."""
    data, expected = baked[1].read_bytes(), read(baked, baked[1])
    refused = 0
    for _ in range(400):
        changed = bytearray(data)
        places = rng.integers(0, rng.choice([len(data), 1500]), rng.choice([1, 2, 5, 20]))
        changed[:] = changed if rng.random() < 0.8 else changed[: rng.integers(len(data))]
        for place in places[places < len(changed)]:
            changed[place] = rng.integers(256)
        file = tmp_path / "changed.exr"
        file.write_bytes(changed)
        try:
            np.testing.assert_array_equal(read(baked, file), expected)
        except MiNtfError as error:
            refused += 1
            assert str(file) in str(error)
    assert refused > 200

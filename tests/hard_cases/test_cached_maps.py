"""Maps in the user's cache: damaged, of another field or program, too many. They may cost time, never a wrong picture,
never memory."""

import dataclasses
import os
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import safetensors.numpy
from helpers import scenes
from helpers.maps import OPTIONS, SIZE, build, find_medium, table, texels, without_cache
from helpers.variants import VARIANT

from mi_ntf.infer import tuning
from mi_ntf.render import user_cache
from mi_ntf.render.maps import map_cache
from mi_ntf.render.scene import loaded

# --- files that do not hold what was written -------------------------------------------------------------------------


def as_npy(array):
    def change(file, data):
        with open(file, "wb") as out:
            np.save(out, array)

    return change


def floats(change):
    """Numbers changed behind the seal."""
    def apply(file, data):
        begin = 8 + int.from_bytes(data[:8], "little")
        values = np.frombuffer(data, "<f4", offset=begin).copy()
        change(values)
        file.write_bytes(data[:begin] + values.tobytes())

    return apply


def another_seal(file, data):
    """The same texels, sealed as those of another map."""
    arrays = safetensors.numpy.load(data)
    file.write_bytes(safetensors.numpy.save(arrays, {"seal": user_cache._seal_of("maps", "0" * 64, arrays)}))


def other_arrays(file, data):
    """A whole entry under this name, but of another kind of content."""
    file.unlink()
    user_cache.write("maps", file.stem, {"index": np.arange(4)})


DAMAGE = {
    "empty": lambda file, data: file.write_bytes(b""),
    "cut": lambda file, data: file.write_bytes(data[:-1]),
    "cut in half": lambda file, data: file.write_bytes(data[: len(data) // 2]),
    "longer": lambda file, data: file.write_bytes(data + b"\0"),
    "zeros of the right length": lambda file, data: file.write_bytes(bytes(len(data))),
    "npy": as_npy(np.ones(3 * SIZE // 4, np.float32)),
    "npy of doubles": as_npy(np.ones(3 * SIZE // 8)),
    "a pickle": lambda file, data: file.write_bytes(b"cos\nabort\n(tR." + data[14:]),
    "NaN": floats(lambda v: v.__setitem__(5, np.nan)),
    "inf": floats(lambda v: v.__setitem__(-1, np.inf)),
    "zeros": floats(lambda v: v.fill(0)),
    "another map's": another_seal,
    "other arrays": other_arrays,
    "swapped": floats(lambda v: v.__setitem__(slice(None), v[::-1].copy())),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_a_damaged_map_is_made_anew(medium, cache, warnings, damage):
    expected = texels(medium)
    (file,) = cache.iterdir()
    data = file.read_bytes()
    DAMAGE[damage](file, data)
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert file.read_bytes() == data and list(cache.iterdir()) == [file] and not warnings


def test_every_flipped_bit_is_noticed(medium, cache, rng):
    """Header, texels and a map under the name of another light's are damaged in turn."""
    texels(medium)
    (file,) = cache.iterdir()
    name, data = file.stem, file.read_bytes()
    begin = 8 + int.from_bytes(data[:8], "little")
    assert user_cache.read("maps", name) is not None
    for place in [*range(begin), *rng.integers(begin, len(data), 300)]:
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.integers(8)
        file.write_bytes(flipped)
        assert user_cache.read("maps", name) is None, place
    file.write_bytes(data)
    assert user_cache.read("maps", name) is not None
    file.rename(file.with_name(f"{'0' * 64}.safetensors"))
    assert user_cache.read("maps", "0" * 64) is None


def test_something_else_under_a_maps_name(medium, cache, warnings):
    """A folder cannot be replaced, and a pipe would be waited for: a warning, a warning less, and the map."""
    expected = texels(medium)
    (file,) = cache.iterdir()
    file.unlink()
    file.mkdir()
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert len(warnings) == 1 and "Is a directory" in warnings[0]
    file.rmdir()
    os.mkfifo(file)
    map_cache.forget()
    np.testing.assert_array_equal(texels(medium), expected)
    assert file.is_file() and len(warnings) == 1


def test_numbers_that_are_not_finite_are_never_kept(cache):
    made = SimpleNamespace(values=mi.Float([1.0, np.nan]))
    assert map_cache.cached("0" * 64, lambda values=None: made, 2, 1e9) is made
    assert not cache.exists()


# --- threads ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("apart", ["in one scene", "in threads"])
def test_several_media_of_one_file_bake_it_once(tmp_path, monkeypatch, apart):
    """Mitsuba makes the media of a scene in parallel."""
    path, baked = scenes.write_blobs(tmp_path), []
    bake = loaded.bake
    monkeypatch.setattr(loaded, "bake", lambda *args: baked.append(args) or bake(*args))
    if apart == "in threads":
        with ThreadPoolExecutor(8) as pool:
            assert len({id(field) for field in pool.map(lambda _: loaded.load(str(path), 48), range(8))}) == 1
    else:
        balls = {f"ball{i}": scenes.ball(path, resolution=48, to_world=mi.ScalarTransform4f().translate([0, 0, i]))
                 for i in range(8)}
        media = [shape.interior_medium() for shape in mi.load_dict({"type": "scene", **balls}).shapes()]
        assert len({id(medium.field) for medium in media}) == 1 and len(media) == 8
    assert len(baked) == 1


def test_the_cache_is_of_many_threads(monkeypatch):
    """Every thread gets its maps while others come and go, and nothing is kept of those that went."""
    monkeypatch.setenv("MI_NTF_CACHE", "memory")
    map_cache.forget()

    def ask(number):
        name, texels = str(number % 50), np.full(16, number % 50, np.float32)
        made = SimpleNamespace(values=texels, texels=texels)
        found = map_cache.cached(name, lambda *_: made, 16, 20 * texels.nbytes, light_keys=[name],
                                 make_part=lambda rows: made)
        return found.values[0] == number % 50

    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    try:
        with ThreadPoolExecutor(8) as pool:
            assert all(pool.map(ask, range(3000)))
    finally:
        sys.setswitchinterval(interval)
    assert len(map_cache._maps) <= 20 + 8 and set(map_cache._light_keys) <= set(map_cache._maps)
    assert map_cache._used <= set(map_cache._maps)
    map_cache.forget()
    assert not map_cache._light_keys and not map_cache._used


# --- keys ------------------------------------------------------------------------------------------------------------


def test_a_field_trained_over_while_it_is_loaded(tmp_path, cache):
    """The process that holds the old field stores old maps, which the new field must never meet."""
    path = scenes.write_blobs(tmp_path, log_density=3.0)
    old = find_medium(path)
    scenes.write_blobs(tmp_path, log_density=-1.0)  # the same name, size and, within a tick of the clock, time
    before = texels(old)
    map_cache.forget()
    loaded._load.cache_clear()
    new = find_medium(path)
    after = texels(new)
    np.testing.assert_array_equal(before, without_cache(old))
    np.testing.assert_array_equal(after, without_cache(new))
    assert np.abs(before - after).max() > 1
    assert old.field.digest != new.field.digest and len(list(cache.iterdir())) == 2


def test_a_field_written_within_one_tick_of_the_clock_is_read_anew(tmp_path):
    path = scenes.write_blobs(tmp_path, log_density=3.0)
    stat = path.stat()
    old = loaded.load(str(path), 32)
    scenes.write_blobs(tmp_path, log_density=-1.0)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    assert path.stat().st_size == stat.st_size
    assert loaded.load(str(path), 32).digest != old.digest


def test_the_same_networks_in_another_file_share_maps(path, tmp_path, cache, medium):
    copy = tmp_path / "copy.safetensors"
    copy.write_bytes(path.read_bytes())
    texels(medium)
    map_cache.forget()
    texels(find_medium(copy))
    assert len(list(cache.iterdir())) == 1


def names_of(cache, medium, options=OPTIONS):
    map_cache.forget()
    texels(medium, options=options)
    return {p.name for p in cache.iterdir()}


def test_keys_follow_the_march_and_the_libraries(medium, cache, monkeypatch):
    """The name depends on everything that texels depend on, to the last bit."""
    seen = [names_of(cache, medium)]
    seen.append(names_of(cache, medium, dataclasses.replace(OPTIONS, step=2 / 128)))
    network = dataclasses.replace(OPTIONS, map_source="network")
    seen.append(names_of(cache, medium, network))
    monkeypatch.setattr(tuning, "NETWORK_STEP", 1.25)  # the rule for a march's step, which only this source follows
    seen.append(names_of(cache, medium, network))
    assert names_of(cache, medium) == seen[-1]
    for module in (user_cache.mi, user_cache.dr, user_cache.np):
        with monkeypatch.context() as patch:
            patch.setattr(module, "__version__", "0.0.0")
            seen.append(names_of(cache, medium))
    with monkeypatch.context() as patch:
        compiler = "cuda_version" if VARIANT.startswith("cuda") else "llvm_version"
        patch.setattr(user_cache.dr.detail, compiler, lambda: (1, 2, 3))
        seen.append(names_of(cache, medium))
    assert [len(names) for names in seen] == list(range(1, len(seen) + 1))


def test_voxels_and_networks_of_one_field_have_maps_of_their_own(path, medium, cache):
    """Neither is taken for the other, in memory or on disk."""
    network = find_medium(path, representation="network")
    voxels = texels(medium)
    assert np.abs(texels(network) - voxels).max() > 0.01
    map_cache.forget()
    np.testing.assert_array_equal(texels(network), without_cache(network))
    assert len(list(cache.iterdir())) == 2


# --- memory ----------------------------------------------------------------------------------------------------------


def held():
    return sum(4 * len(m.values) for m in map_cache._maps.values())


def kept(size: int):
    """Return a stand-in for a map of `size` bytes."""
    return SimpleNamespace(values=np.zeros(size // 4, np.float32), texels=SimpleNamespace(nbytes=size))


def test_kept_maps_and_the_one_in_the_making_fit_into_map_memory(cache, monkeypatch):
    """Lights that move each frame: a new map each time, in a memory for two and a half."""
    monkeypatch.setenv("MI_NTF_CACHE", "memory")
    limit, size, most = 2.5 * 1000, 1000, []

    def make(values=None):
        most.append(held() + size)
        return kept(size)

    for k in range(6):
        map_cache.cached(str(k), make, size // 4, limit)
    assert max(most) <= limit and max(most) == 2000 and held() == 2000
    map_cache.cached("larger than all", lambda values=None: kept(2800), 700, limit)
    assert held() == 0, "what exceeds the memory alone is not kept beside"


def test_maps_of_one_run_of_several_are_not_kept(medium, cache):
    whole = table()
    build(medium, whole)
    assert held() == 3 * SIZE
    for k in range(3):
        part = whole.part(k, k + 1)
        first = build(medium, part, dataclasses.replace(OPTIONS, map_memory=SIZE / 2**20))
        assert held() == 0
        assert build(medium, part, OPTIONS) is not first
    assert len(list(cache.iterdir())) == 4, "on disk each run is found again"

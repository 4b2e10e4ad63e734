"""Many instances of a field, which are one medium of the kernels, against media of their own and closed forms."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes, ztest

from mi_ntf import Field
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Similarity
from mi_ntf.render.maps import map_cache
from mi_ntf.render.scene import many
from mi_ntf.render.scene.media import find_media

BALL = Similarity((0.0, 0.0, 0.0), 1.0)


def place(i: int) -> mi.ScalarTransform4f:
    """Return one of several places; neighbours overlap."""
    to_world = mi.ScalarTransform4f().translate([0.4 + 0.7 * np.cos(2.1 * i), 0.25 * i - 0.8, 0.7 * np.sin(2.1 * i)])
    return to_world.rotate([0, 1, 0], 50 * i).scale(0.6 + 0.02 * i)


def instances(field, places, similarity=scenes.SIMILARITY, **medium) -> dict:
    at = {f"at_{i}": {"type": "instance", "to_world": p, "group": {"type": "ref", "id": "group"}}
          for i, p in enumerate(places)}
    return {"group": {"type": "shapegroup", "inner": scenes.ball(field, similarity, **medium)}, **at}


def pictures(blobs, monkeypatch, options, *, size=16, spp=16, seeds=1, lights=("point",), shapes=None):
    """Return pictures of four fields as one medium, and as four of their own; `shapes`: by default instances."""
    lights = {name: scenes.light(name) for name in lights}
    loaded = scenes.scene(None, scenes.nrf(**options), lights, size=size,
                          shapes=shapes or instances(blobs, [place(i) for i in range(4)]))
    result = []
    for fewest in (4, 100):
        monkeypatch.setattr(many, "FEWEST", fewest)
        with map_cache.in_memory():
            result.append(np.array([scenes.render(loaded, seed, spp) for seed in range(seeds)]))
    return result


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_atlas", "none"])
def test_one_medium_shows_what_media_of_their_own_show(blobs, monkeypatch, visibility):
    together, apart = pictures(blobs, monkeypatch, {"visibility": visibility}, spp=32, seeds=4)
    assert not np.array_equal(together, apart)
    ztest.check(list(together[..., :3]), list(apart[..., :3]), visibility, block=4)
    np.testing.assert_allclose(together.mean((0, 1, 2)), apart.mean((0, 1, 2)), rtol=0.01)


def test_different_fields_are_one_medium_too(blobs, tmp_path, monkeypatch):
    """Each has its own density, reflectance and atlas."""
    shapes = {}
    for i in range(4):
        path = tmp_path / f"{i}.safetensors"
        look = {"albedo": (0.2 + 0.2 * i, 0.5, 0.8 - 0.2 * i), "similarity": scenes.SIMILARITY}
        field_file.save(path, *fields.blobs(scenes.CENTERS, [0.3 + 0.05 * i, 0.28, 0.2], **look), np.float32)
        shapes[f"at_{i}"] = scenes.ball(path, to_world=place(i), resolution=64) | {"to_world": place(i)}
    loaded = find_media(scenes.scene(None, scenes.nrf(), {}, shapes=shapes))
    assert [len(medium.kinds) for medium in many.joined(loaded)] == [4]
    together, apart = pictures(None, monkeypatch, {}, spp=32, seeds=4, shapes=shapes)
    ztest.check(list(together[..., :3]), list(apart[..., :3]), "different fields", block=4)
    np.testing.assert_allclose(together.mean((0, 1, 2)), apart.mean((0, 1, 2)), rtol=0.01)


def test_further_bounces_are_those_of_media_of_their_own(blobs, monkeypatch):
    together, apart = pictures(blobs, monkeypatch, {"max_depth": 4, "bounces": "paths"}, spp=64, seeds=4)
    ztest.check(list(together[..., :3]), list(apart[..., :3]), "bounces", block=4)
    np.testing.assert_allclose(together.mean((0, 1, 2)), apart.mean((0, 1, 2)), rtol=0.01)


def test_densities_of_overlapping_instances_add(tmp_path):
    """The opacity of uniform balls is that of the sum of their chords."""
    path = tmp_path / "ball.safetensors"
    field_file.save(path, *fields.uniform(0.3, similarity=BALL), np.float32)
    where = [(0.3 * i - 0.6, 0.2 * i - 0.4, 0.5 * i) for i in range(5)]
    places = [mi.ScalarTransform4f().translate(w).scale(1.6 - 0.1 * i) for i, w in enumerate(where)]
    look = mi.ScalarTransform4f().look_at([0, 0, 9], [0, 0, 0], [0, 1, 0]).scale(1.2)
    sensor = {"type": "orthographic", "to_world": look, "film": scenes.film(16),
              "sampler": {"type": "multijitter", "sample_count": 16}}
    loaded = mi.load_dict({"type": "scene", "integrator": scenes.nrf(), "sensor": sensor,
                           "light": scenes.light("directional"), **instances(path, places, BALL, resolution=96)})
    c = (np.arange(64) + 0.5) / 64 * 2.4 - 1.2
    x, y = np.meshgrid(c, -c)
    depth = sum(0.6 / r * np.sqrt(np.maximum(r * r - (x - w[0]) ** 2 - (y - w[1]) ** 2, 0))
                for w, r in zip(where, 1.6 - 0.1 * np.arange(5), strict=True))
    expected = (1 - np.exp(-depth)).reshape(16, 4, 16, 4).mean((1, 3))
    alpha = scenes.render(loaded)[..., 3]
    np.testing.assert_allclose(alpha, expected, atol=0.03)  # voxels of 1/48 at the rims
    assert abs((alpha - expected).mean()) < 0.003


def test_instances_of_another_order_of_size_are_another_medium(blobs):
    """Cells of a march have the length of a medium's smallest field."""
    places = [place(i) for i in range(5)] + [place(i).scale(0.01) for i in range(5)]
    media = find_media(scenes.scene(None, scenes.nrf(), {}, shapes=instances(blobs, places)))
    joined = many.joined(media)
    assert [len(medium.members) for medium in joined] == [5, 5]
    for medium in joined:
        sizes = [member.frame.length for member in medium.members]
        assert max(sizes) <= 2 * min(sizes) and medium.finest * medium.frame.length == pytest.approx(min(sizes))


def test_density_and_clear_distance_of_copies(blobs):
    """Density is the sum over all copies, and rays are clear of it as far as they are told."""
    media = find_media(scenes.scene(None, scenes.nrf(), {}, shapes=instances(blobs, [place(i) for i in range(6)])))
    crowd, rng = many.Crowd(media), np.random.default_rng(4)
    volume, n = crowd.source, 4096
    p = tuple(mi.Float(c.astype(np.float32)) for c in rng.uniform(*volume.bounds, (n, 3)).T)
    world = crowd.frame.point_to_world(p)
    expected = sum(m.source.density(m.frame.point_to_field(world)) / m.frame.length for m in media) * crowd.frame.length
    np.testing.assert_allclose(volume.density(p), expected, rtol=2e-2, atol=1e-3)
    d = rng.normal(size=(n, 3))
    d = tuple(mi.Float(c.astype(np.float32)) for c in (d / np.linalg.norm(d, axis=1, keepdims=True)).T)
    clear = volume.clear_distance(volume.place(p), tuple(dr.rcp(c) for c in d))
    assert 0.1 < np.mean(np.array(clear) > 0) < 1
    for fraction in rng.random(16):
        q = tuple(a + float(fraction) * 0.999 * clear * b for a, b in zip(p, d, strict=True))
        assert np.array(dr.select(clear > 0, volume.density(q), 0)).max() == 0


def test_a_hundred_instances_are_a_hundred_loads(blobs):
    """The pictures are equal, and no kernel is compiled for the next hundred at other places."""
    def scene(shift, load=False):
        spots = [mi.ScalarTransform4f().translate([4.0 * (i % 10) - 18, 4.0 * (i // 10) - 18 + shift * (i % 2), -60])
                 for i in range(100)]
        shapes = {f"at_{i}": scenes.ball(blobs, to_world=p) | {"to_world": p} for i, p in enumerate(spots)}
        return scenes.scene(None, scenes.nrf("transmittance_atlas"), {"light": scenes.light("point")}, size=16, spp=4,
                            shapes=shapes if load else instances(blobs, spots))

    with map_cache.in_memory(), dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        image, load = (scenes.render(scene(0, load)) for load in (False, True))
        other = scene(1.5)
        dr.kernel_history_clear()
        moved = scenes.render(other)
        compiled = [k for k in dr.kernel_history([dr.KernelType.JIT]) if not k["cache_hit"]]
    np.testing.assert_array_equal(image, load)
    assert image[..., 3].mean() > 0.05 and np.abs(moved - image).max() > 0.1
    assert compiled == []


@pytest.mark.parametrize(("kind", "kinds"), [("skins", [2]), ("smoke", [1, 1, 1, 1])])
def test_a_reflectance_that_was_set_is_that_of_one_instance(blobs, kind, kinds):
    """Four media of one field, of which one becomes red; smoke of different reflectance is no single medium."""
    grid = Field.from_grid(np.full((8, 8, 8), 4.0), 0.9, ((-1, -1, -1), (1, 1, 1)))
    shapes = {}
    for i in range(4):
        own = (blobs, scenes.SIMILARITY) if kind == "skins" else (grid.path, Similarity((0.0, 0.0, 0.0), 1.8))
        shapes[f"at_{i}"] = scenes.ball(*own, to_world=place(i)) | {"to_world": place(i)}
    loaded = scenes.scene(None, scenes.nrf(), {"light": {"type": "constant"}}, shapes=shapes)
    parameters = mi.traverse(loaded)
    key = next(key for key in parameters.keys() if key.startswith("at_0.") and key.endswith("albedo"))
    albedo = np.array(parameters[key])
    albedo[..., 1:] = 0
    parameters[key] = mi.TensorXf(albedo)
    parameters.update()
    assert [len(getattr(medium, "kinds", [medium])) for medium in many.joined(find_media(loaded))] == kinds


def test_far_instances_are_no_single_medium(blobs):
    """Single precision cannot place the cells of small fields in a sphere around all of them."""
    places = [mi.ScalarTransform4f().translate([x, 0, 0])
              for x in (0, 3, 6, 9, 1e5, 1e5 + 3, 1e5 + 6, 1e5 + 9, -1e6)]
    loaded = scenes.scene(None, scenes.nrf(), {}, shapes=instances(blobs, places))
    media = many.joined(find_media(loaded))
    assert [len(getattr(medium, "members", [medium])) for medium in media] == [1, 4, 4]

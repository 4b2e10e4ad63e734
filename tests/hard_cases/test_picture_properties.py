"""Properties of every picture: energy, linearity, and that nothing depends on how the work is cut up."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, random_fields, scenes, ztest
from helpers.scenes import nrf
from hypothesis import given, settings
from hypothesis import strategies as st

from mi_ntf.core import field_file
from mi_ntf.infer import tuning

METHODS = {name: {"visibility": method, **options} for name, (method, options) in random_fields.METHODS.items()}
every_method = pytest.mark.parametrize("name", METHODS)
tied = pytest.mark.parametrize("name", [n for n in METHODS if n != "visibility_mlp"])
"""Without the baseline's network, which may take the whole depth of a skin for lit."""
@pytest.fixture(scope="module", autouse=True)
def small_atlas():
    """Two million rays take seconds, and here each picture has its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tuning, "ATLAS_SIDE", 16)
        patch.setattr(tuning, "ATLAS_RESOLUTION", 24)
        yield


FEW = settings(settings.get_profile("hard"), max_examples=3)
SMALL = {"environment_lights": 32, "map_resolution": 32, "samples": 128}


def integrator(name: str, **options) -> dict:
    return {**nrf(), **SMALL, **METHODS[name], **options}


def white_ball(folder, log_density: float, radius: float):
    """A ball around the origin that reflects all light, diffusely; its normals are exact."""
    path = folder / f"{log_density}_{radius}.safetensors"
    if not path.exists():
        header, tensors = fields.blobs([(0, 0, 0)], [radius], log_density=log_density, edge=2.0,
                                       albedo=(0.999,) * 3, specular=1e-4, roughness=0.9,
                                       similarity=scenes.SIMILARITY)  # fmt: skip
        for key in tensors:  # zero outputs: the logistic through the middle of a ray's profile
            tensors[key] *= not key.startswith("transmittance")
        field_file.save(path, header, tensors, np.float32)
    return path


@pytest.mark.parametrize("depth", [2, 3, -1])
@tied
@given(log_density=st.sampled_from([0.5, 2.0, 4.0, 6.0]), radius=st.sampled_from([0.25, 0.6]))
@FEW
def test_white_furnace(name, depth, tmp_path_factory, log_density, radius):
    """Nothing is brighter than light of radiance 1 that comes from everywhere, in means of 4×4 pixels."""
    loaded = scenes.scene(
        white_ball(tmp_path_factory.getbasetemp(), log_density, radius),
        integrator(name, max_depth=depth, hide_emitters=False), {"sky": {"type": "constant"}},
        size=16, spp=16, medium={"resolution": 96}, sampler="multijitter",
    )  # fmt: skip
    image = scenes.render(loaded)[..., :3]
    assert np.isfinite(image).all() and image.min() >= 0
    # Skins as thick as a tenth of the ball: measured 1.012 where the thinnest is lit by rays along it, others 1.004.
    # With none, 1.0016 by noise.
    assert ztest.block_means(image, 4).max() < (1.002 if name == "none" else 1.018)


def two_fields(blobs, turned: bool) -> dict:
    """Two that overlap, one three times the other, in either order; and three lights."""
    to_world = mi.ScalarTransform4f
    shapes = [
        {"type": "sphere", "center": (np.array(place) + size * np.array(scenes.SIMILARITY.center)).tolist(),
         "radius": size * scenes.SIMILARITY.radius, "bsdf": {"type": "null"},
         "interior": {"type": "nrf", "filename": str(blobs), "scale": size, "resolution": 48,
                      "to_world": to_world().translate(list(place))}}
        for place, size in (((0.3, 0.1, 0.2), 1.0), ((0.9, 0.5, 0.9), 0.33))
    ]  # fmt: skip
    return {f"field_{i}": shape for i, shape in enumerate(shapes[::-1] if turned else shapes)}


LIGHTS = ("sun", "lamp", "spot")


def light(name: str) -> dict:
    aim = mi.ScalarTransform4f().look_at([-2, 3, 3], [0.4, 0, 0.3], [0, 1, 0])
    spot = {"type": "spot", "to_world": aim, "intensity": 40.0, "cutoff_angle": 30.0}
    return {"sun": scenes.light("directional"), "lamp": scenes.light("point"), "spot": spot}[name]


def picture(blobs, name: str, lights, turned=False, seed=0, **options) -> np.ndarray:
    loaded = scenes.scene(None, integrator(name, **options), {k: light(k) for k in lights}, size=16, spp=16,
                          shapes=two_fields(blobs, turned), sampler="multijitter")  # fmt: skip
    return scenes.render(loaded, seed)


@every_method
def test_lights_one_by_one(blobs, name):
    """The sum of the pictures under each light alone is the picture under all, in any order, and in several runs."""
    alone = sum(picture(blobs, name, [light])[..., :3] for light in LIGHTS)
    for image in (
        picture(blobs, name, LIGHTS),
        picture(blobs, name, LIGHTS[::-1]),
        # Maps of 32²: a light takes 8 KiB to 0.75 MiB of each field, so every light has a run of its own.
        picture(blobs, name, LIGHTS, map_memory=PER_LIGHT.get(name, 1.0)),
    ):
        np.testing.assert_allclose(image[..., :3], alone, rtol=1e-4, atol=1e-5 * alone.max())


PER_LIGHT = {"transmittance_volume": 1.8, "map, field": 0.03, "map, field, 2": 0.1, "map, network": 0.1}


@every_method
def test_order_of_shapes(blobs, name):
    """The large field first or the small one: the same picture but for other random numbers."""
    one, other = (
        [picture(blobs, name, ["sun"], turned, seed) for seed in range(4)] for turned in (False, True)
    )
    ztest.check([i[..., :3] for i in one], [i[..., :3] for i in other], f"order {name}", block=4)
    np.testing.assert_allclose(np.mean(one, (0, 1, 2)), np.mean(other, (0, 1, 2)), rtol=0.01)


@every_method
def test_chunks_and_bits(blobs, name, monkeypatch):
    """The same seed, the same bits; a chunk of few pixels at a time, other random numbers and the same picture."""
    whole = [picture(blobs, name, LIGHTS, seed=seed) for seed in range(4)]
    np.testing.assert_array_equal(picture(blobs, name, LIGHTS, seed=2), whole[2])
    monkeypatch.setattr("mi_ntf.render.transport.rendering.CHUNK", 16 * 40)
    chunks = [picture(blobs, name, LIGHTS, seed=seed) for seed in range(4)]
    ztest.check([i[..., :3] for i in whole], [i[..., :3] for i in chunks], f"chunks {name}", block=4)
    np.testing.assert_allclose(np.mean(whole, (0, 1, 2)), np.mean(chunks, (0, 1, 2)), rtol=0.01)

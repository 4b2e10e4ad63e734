"""Fields that emit light, against the closed form: radiance = Σ over splats of ∫ T σ c dt."""

import mitsuba as mi
import numpy as np
import pytest

from mi_ntf.core import voxels
from mi_ntf.core.splats import Splats, density, optical_depth
from mi_ntf.field import Field
from mi_ntf.importing_splats import of_splats

COLOUR = (0.7, 0.3, 0.1)


@pytest.fixture(scope="module")
def splats() -> Splats:
    rng = np.random.default_rng(4)
    n = 20
    turns = rng.normal(size=(n, 4))
    return Splats(rng.uniform(-0.5, 0.5, (n, 3)), rng.uniform(0.1, 0.3, (n, 3)),
                  turns / np.linalg.norm(turns, axis=1, keepdims=True), rng.uniform(0.2, 0.9, n),
                  np.where(rng.random((n, 1)) < 0.5, COLOUR, (0.1, 0.2, 0.8)))


@pytest.fixture(scope="module")
def field(splats, tmp_path_factory):
    path = tmp_path_factory.mktemp("emission") / "field.safetensors"
    header, *parts = of_splats(splats, 96, emissive=True)
    voxels.save(path, header, *parts)
    sphere = header.similarity
    return {"type": "sphere", "center": list(sphere.center), "radius": sphere.radius, "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(path)}}


def rendered(integrator="nrf", **things):
    camera = {"type": "orthographic",
              "to_world": mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0]),
              "film": {"type": "hdrfilm", "width": 16, "height": 16, "pixel_format": "rgb",
                       "rfilter": {"type": "box"}}}
    integrator = {"type": integrator} if isinstance(integrator, str) else integrator
    scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": camera, **things})
    return np.array(mi.render(scene, spp=64))


def closed_form(splats: Splats) -> np.ndarray:
    """Radiance at 4 × 4 points of each pixel, by the closed form of T and a fine sum along the ray."""
    axis = (np.arange(64) + 0.5) / 32 - 1
    x, y = np.meshgrid(axis, -axis)
    result = np.zeros((64 * 64, 3))
    origins = np.stack([x.ravel(), y.ravel(), np.full(x.size, 4.0)], 1)
    depth, step = np.zeros(len(origins)), 0.02
    for z in np.arange(1.8, -1.8, -step):
        points = origins * [1, 1, 0] + [0, 0, z - step / 2]
        sigma = density(splats, points)
        of_first = density(splats.take(splats.colours[:, 0] > 0.5), points)
        colour = of_first[:, None] * COLOUR + (sigma - of_first)[:, None] * [0.1, 0.2, 0.8]
        result += (np.exp(-depth) * -np.expm1(-sigma * step) / np.maximum(sigma, 1e-12))[:, None] * colour
        depth += sigma * step
    straight = np.tile([0.0, 0.0, -1.0], (8, 1))
    assert np.allclose(depth[2000:2008], optical_depth(splats, origins[2000:2008], straight), rtol=1e-3)
    return result.reshape(16, 4, 16, 4, 3).mean((1, 3))


def test_radiance_without_lights_is_that_of_the_splats(field, splats):
    """The picture needs no light, and its mean error is 1 % of its brightest value."""
    picture, truth = rendered(field=field), closed_form(splats)
    assert np.abs(picture - truth).mean() < 0.01 * truth.max()
    assert picture.mean() == pytest.approx(truth.mean(), rel=0.01)


def test_a_lamp_does_not_change_emission_but_the_field_shadows_a_floor(field):
    """Emitted light does not depend on a lamp; the floor behind the field gets less of its light."""
    lamp = {"type": "directional", "direction": [0, 0, -1], "irradiance": 2.0}
    dark = rendered(field=field)
    assert np.abs(rendered(field=field, lamp=lamp) - dark).max() < 0.05
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().translate([0, 0, -2]).scale(3)}
    lit = rendered("direct", floor=floor, lamp=lamp)
    behind = rendered(field=field, floor=floor, lamp=lamp) - dark
    assert behind[8, 8].max() < 0.5 * lit[8, 8].min()
    assert (behind < lit + 0.02).all()


LAMPS = {"above": {"type": "directional", "direction": [0, -1, 0], "irradiance": {"type": "rgb", "value": [3, 1, 0]}},
         "beside": {"type": "directional", "direction": [-1, 0, 0], "irradiance": {"type": "rgb", "value": [1, 1, 2]}}}


def catcher(field):
    return field | {"interior": field["interior"] | {"shadow_catcher": True}}


def roof():
    """An opaque square above the field, at right angles to the camera's rays."""
    to_world = mi.ScalarTransform4f().translate([0, 1.8, 0]).rotate([1, 0, 0], 90).scale(1.8)
    return {"type": "rectangle", "to_world": to_world}


def test_a_shadow_catcher_loses_the_fraction_of_light_that_a_surface_blocks(field):
    """The lamp above is in the shadow of the roof, and the one beside is not: 1/4, 1/2 and 2/2 of the light is left."""
    open_sky = rendered(field=catcher(field), **LAMPS)
    assert np.allclose(open_sky, rendered(field=field, **LAMPS), atol=1e-5)  # no shadow on itself
    left = rendered(field=catcher(field), roof=roof(), **LAMPS)
    assert np.allclose(left, open_sky * [0.25, 0.5, 1.0], atol=1e-4)
    assert np.allclose(rendered(field=field, roof=roof(), **LAMPS), open_sky, atol=1e-5)  # it has to be asked for


@pytest.mark.parametrize("visibility", ["raymarch", "transmittance_map"])
def test_smoke_dims_a_shadow_catcher_by_its_transmittance(field, visibility):
    """A slab of smoke between the field and the only lamp lets e^(−0.9) through."""
    slab = {"type": "cube", "to_world": mi.ScalarTransform4f().translate([0, 2.2, 0]).scale([2, 0.3, 2]),
            "bsdf": {"type": "null"}, "interior": {"type": "homogeneous", "sigma_t": 1.5, "albedo": 0.0}}
    lamp = {"type": "point", "position": [0, 60.0, 0]}
    integrator = {"type": "nrf", "visibility": visibility}
    bright = rendered(field=catcher(field), lamp=lamp)
    left = rendered(integrator, field=catcher(field), lamp=lamp, slab=slab)
    assert left.sum() == pytest.approx(np.exp(-0.9) * bright.sum(), rel=0.02)


def test_an_emitting_field_alone_catches_shadows():
    smoke = Field.from_grid(np.ones((4, 4, 4), np.float32)).shape()
    with pytest.raises(RuntimeError, match=r"shadow_catcher is true, but .* emits no light .* with --emissive"):
        mi.load_dict(catcher(smoke))

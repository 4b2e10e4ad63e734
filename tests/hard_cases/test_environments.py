"""Environment maps of any size, orientation and range: all their light arrives, from where it comes, with gradients."""

from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, skies
from helpers.variants import VARIANT

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.render.lights import environment, light_gradients, light_rows, scene_lights, sun
from mi_ntf.render.scene import recent


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=2.5, roughness=0.6, visibility=True)


def sphere(side: int = 240):
    """Directions (n, 3) and solid angles (n,) that cover the sphere."""
    theta = (np.arange(side) + 0.5) * np.pi / side
    phi = (np.arange(2 * side) + 0.5) * np.pi / side
    theta, phi = (v.ravel() for v in np.meshgrid(theta, phi, indexing="ij"))
    d = np.stack([np.sin(theta) * np.cos(phi), np.cos(theta), np.sin(theta) * np.sin(phi)], axis=1)
    return d, np.sin(theta) * (np.pi / side) ** 2


def looked_up(emitter, d):
    """Radiance (n, 3) that Mitsuba's own `eval` shows a camera in the directions `d`."""
    return np.array(environment.background(emitter, mi.Vector3f(*d.T.astype(np.float32)))).T


def turned(how: str):
    place = mi.ScalarTransform4f().rotate([0.48, 0.8, -0.36], 50)
    if how == "mirrored":
        return place @ mi.ScalarTransform4f().scale([-1, 1, 1])
    return place @ mi.ScalarTransform4f().scale({"rotated": 1.0, "enlarged": 3.0, "shrunk": 0.01}[how])


@pytest.mark.parametrize(
    ("size", "how"),
    [
        ((1, 1), "rotated"),
        ((1, 2), "mirrored"),
        ((2, 1), "enlarged"),
        ((2, 2), "mirrored"),
        ((3, 2), "shrunk"),
        ((4, 7), "mirrored"),
        ((5, 3), "enlarged"),
        ((16, 33), "rotated"),
        ((61, 33), "mirrored"),
    ],
)
def test_all_light_arrives_from_where_it_comes(size, how, rng):
    """Total and vector irradiance against a quadrature of Mitsuba's lookup, which is bilinear between texels."""
    image = rng.uniform(0, 1, (*size, 3)).astype(np.float32) ** 4
    loaded = mi.load_dict(skies.emitter(image, scale=2.5, to_world=turned(how)))
    rows, cells = light_rows.sky(loaded, "envmap", 512)
    d, solid_angle = sphere()
    power = looked_up(loaded, d) * solid_angle[:, None]
    assert len(rows.power) == 512
    # The quadrature's own error is 2e-4; cells of 4° shorten the vector by 0.2 %.
    np.testing.assert_allclose(rows.power.sum(axis=0), power.sum(axis=0), rtol=1e-3)
    np.testing.assert_allclose(rows.power.T @ rows.where, power.T @ d, atol=4e-3 * power.sum())
    np.testing.assert_allclose(np.linalg.norm(rows.where, axis=1), 1, atol=1e-9)
    assert cells.solid_angle.sum() == pytest.approx(4 * np.pi, rel=1e-9)


@pytest.mark.parametrize("how", ["enlarged", "shrunk"])
def test_drawn_light_of_a_scaled_environment(blobs, how):
    """A size means nothing at infinity: the picture is that of the unscaled one, drawn or summed, sky included."""
    plain = {"type": "nrf", "visibility": "none", "environment_lights": 64}
    pictures = [
        scenes.render(scenes.scene(blobs, {**plain, **options}, {"sky": light}, size=8, spp=4))
        for light in (skies.emitter(skies.sky(16, 32), to_world=turned(name)) for name in ("rotated", how))
        for options in ({}, {"light_samples": 4})
    ]
    for picture, same in zip(pictures[2:], pictures[:2], strict=True):
        np.testing.assert_allclose(picture, same, rtol=2e-3, atol=2e-3)  # float32 matrices differ by 1e-7 rad


@pytest.mark.parametrize("kind", ["sheared", "flat", "sunsky"])
def test_other_placements_are_refused(kind):
    matrix = {"sheared": [1, 2, 1], "flat": [1, 1, 1e-5], "sunsky": [2, 2, 2]}[kind]
    place = mi.ScalarTransform4f().scale(matrix)
    description = {"type": "sunsky", "to_world": place}
    if kind != "sunsky":
        description = skies.emitter(np.ones((4, 8, 3)), to_world=place)
    plugin = description["type"]
    with pytest.raises(MiNtfError, match=f"{plugin} emitter.*to_world.*leave"):
        light_rows.sky(mi.load_dict(description), plugin, 8)


def test_scaled_environments_among_surfaces_are_refused(blobs):
    """There Mitsuba itself samples and looks up."""
    light = {"sky": skies.emitter(skies.sky(16, 32), to_world=turned("enlarged"))}
    scene = scenes.scene(blobs, scenes.nrf(), light, size=4, spp=1, shapes={"floor": {"type": "rectangle"}})
    with pytest.raises(MiNtfError, match=r"envmap emitter \(sky\): to_world scales by 3.*leave the scale out"):
        scene.integrator().render(scene)
    with pytest.raises((MiNtfError, RuntimeError), match="to_world scales by 3"):
        mi.load_dict({"type": "ntf", "sky": light["sky"], "m": {"type": "nrf", "filename": str(blobs)}})


def check_suns(height: int, width: int, texels: int) -> None:
    """A sun of `texels` a side, shifted by single ones: its light or lights move with it, and no power is lost."""
    still = None
    for down, right in ((0, 0), (0, 1), (1, 2), (2, 3)):
        image = np.roll(skies.sky(height, width, texels=texels, share=0.7), right, axis=1)
        image[1 : height // 2 - 1] = np.roll(image[1 : height // 2 - 1], down, axis=0)
        cells = environment.cells(image, 512)
        # The sun shines from the centre of its texels, of those that the map holds at (row, column + 0.5).
        row, column = round(0.3 * height) + down + (texels - 1) / 2, round(0.35 * width) + right + texels / 2
        theta, phi = row * np.pi / (height - 1), column * 2 * np.pi / width
        there = np.array([np.sin(phi) * np.sin(theta), np.cos(theta), -np.cos(phi) * np.sin(theta)])
        near = cells.direction @ there > np.cos(np.radians(1.5))
        total = cells.power.sum()
        assert 0.69 < cells.power[near].sum() / total < 0.72, (down, right)
        centre = cells.power[near].sum(axis=1) @ cells.direction[near]
        angle = np.degrees(np.arccos(min(centre @ there / np.linalg.norm(centre), 1)))
        assert angle < 0.02, (down, right, angle)  # the sky around it pulls by thousandths of a degree
        still = still or total
        assert total == pytest.approx(still, rel=1e-6 if not down else 0.01), (down, right)


@pytest.mark.parametrize("texels", [1, 3])
def test_suns_of_a_2k_sky_shifted_by_texels(texels):
    check_suns(1024, 2048, texels)


@pytest.mark.slow
@pytest.mark.parametrize("texels", [1, 2, 5, 16])
def test_suns_of_a_4k_sky_shifted_by_texels(texels):
    check_suns(2048, 4096, texels)


@pytest.mark.parametrize("limit", [2, 8, 32, 512])
@pytest.mark.parametrize("kind", ["even", "random", "sun"])
def test_unshadowed_surfaces_receive_within_the_stated_bound(kind, limit, rng):
    """Irradiance from `limit` lights and from 4 to 16 times as many, on surfaces of 500 orientations."""
    image = {"even": np.ones((3, 2, 3)), "random": rng.uniform(0, 1, (33, 64, 3)) ** 8, "sun": skies.sky(64, 128)}[kind]
    cells = environment.cells(image, limit)
    truth = environment.cells(image, min(16 * limit, 2048))
    normal = rng.normal(size=(500, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    received, wanted = (np.maximum(normal @ c.direction.T, 0) @ c.weight / c.weight.sum() for c in (cells, truth))
    error = np.abs(received - wanted).max()
    assert error <= cells.error() + truth.error()
    assert cells.error() < 40 * error + 1e-3  # and no idle bound: 2 to 13 times what is found, measured
    assert cells.error() < {2: 0.6, 8: 0.2, 32: 0.06, 512: 0.005}[limit]


def test_one_light_for_an_even_sky():
    """Nothing but rounding has a direction there: it comes from above, with all the light."""
    rows, _ = light_rows.sky(mi.load_dict({"type": "constant", "radiance": 2.0}), "constant", 1)
    np.testing.assert_allclose(rows.where, [[0, 1, 0]])
    np.testing.assert_allclose(rows.power, [[8 * np.pi] * 3], rtol=1e-6)


def test_one_map_makes_the_same_lights_twice(rng):
    image = rng.uniform(0, 1, (300, 601, 3)).astype(np.float32)
    a = environment.cells(image.copy(), 512)
    assert environment.cells(image.copy(), 512) is a  # kept
    environment._cells_of_images.clear()
    b = environment.cells(image.copy(), 512)
    assert b is not a
    assert (a.power == b.power).all() and (a.direction == b.direction).all() and (a.bounds == b.bounds).all()


def test_lights_that_are_kept_are_of_the_same_map(rng):
    """Another texel, another number of lights: others; a few maps later they are let go."""
    image = rng.uniform(0, 1, (8, 16, 3)).astype(np.float32)
    first, fewer = environment.cells(image, 32), environment.cells(image, 16)
    assert (len(first.power), len(fewer.power)) == (32, 16)
    image[3, 4] += 1
    brighter = environment.cells(image, 32)
    assert brighter.power.sum() > first.power.sum()
    for limit in range(1, recent.SIZE + 4):
        environment.cells(image, limit)
    assert len(environment._cells_of_images) == recent.SIZE
    assert environment.cells(image, 32) is not brighter


def test_skies_that_are_kept_are_of_the_same_parameters():
    """Another haze, another place of the sun: other skies; a few later they are let go."""
    emitter = mi.load_dict({"type": "sunsky", "sun_direction": [0.3, 0.2, 0.9]})
    parameters = mi.traverse(emitter)
    clear = sun.sky(emitter)
    assert sun.sky(mi.load_dict({"type": "sunsky", "sun_direction": [0.3, 0.2, 0.9]})) is clear
    parameters["turbidity"] = 8.0
    parameters.update()
    hazy = sun.sky(emitter)
    assert hazy.power.sum() < 0.9 * clear.power.sum() and (hazy.axis == clear.axis).all()
    parameters["turbidity"] = 3.0
    parameters["sun_direction"] = [-0.3, 0.2, 0.9]
    parameters.update()
    moved = sun.sky(emitter)
    assert moved.axis[0] == pytest.approx(-clear.axis[0])
    assert np.abs(moved.image - clear.image).max() > 0.1 * clear.image.max()
    for turbidity in np.linspace(2, 9, recent.SIZE + 1):
        sun.sky(mi.load_dict({"type": "sunsky", "turbidity": float(turbidity)}))
    assert len(sun._skies) == recent.SIZE
    assert sun.sky(emitter) is not moved


@pytest.mark.parametrize("place", ["texel", "sun"])
def test_range_of_half_the_floats(place):
    """A sun 10³⁰ times the sky, and a sky of 10³⁷: nothing overflows, nothing else is lost."""
    image = skies.sky(64, 128, texels=1) if place == "sun" else np.full((64, 128, 3), 1e37, np.float32)
    image[40, 30] = 1e30 if place == "sun" else 1e37
    cells = environment.cells(image, 512)
    assert np.isfinite(cells.power.astype(np.float32)).all() and np.isfinite(cells.direction).all()
    dim = environment.cells(np.where(image < 1e29, image, 0), 512) if place == "sun" else cells
    rest = cells.power[cells.power[:, 0] < 1e20] if place == "sun" else cells.power
    # The few cells that meet at the texel hold some of the sky.
    assert rest.sum() == pytest.approx(dim.power.sum(), rel=0.15)


def test_sunsky_sun_of_unknown_size_is_an_error(monkeypatch):
    monkeypatch.setattr(sun, "re", SimpleNamespace(search=lambda *_: None))
    with pytest.raises(MiNtfError, match=r'sunsky emitter.*"Sun aperture"'):
        light_rows.sky(mi.load_dict({"type": "sunsky"}), "sunsky", 8)


def test_timed_sunsky_is_refused(blobs):
    with pytest.raises(MiNtfError, match=r"timed_sunsky emitter .sky.: .*use sunsky at one moment"):
        scene_lights.Lights(scenes.scene(blobs, scenes.nrf(), {"sky": {"type": "timed_sunsky"}}, size=4))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("mode", ["summed", "drawn", "ntf"])
def test_texels_that_are_no_numbers(blobs, value, mode):
    """Named with their count and the first place, however the map would be used. The first and the last column, which
    Mitsuba repeats, count once."""
    image = np.ones((8, 16, 3), np.float32)
    image[5, 0], image[5, 15, 1], image[6, 3, 2] = value, value, value
    if mode == "ntf":
        with pytest.raises((MiNtfError, RuntimeError), match=r"3 texels of data are NaN or infinite.*row 5, column 0"):
            mi.load_dict({"type": "ntf", "sky": skies.emitter(image), "m": {"type": "nrf", "filename": str(blobs)}})
        return
    options = {"light_samples": 2} if mode == "drawn" else {}
    scene = scenes.scene(blobs, scenes.nrf(**options), {"sky": skies.emitter(image)}, size=4, spp=1)
    for visibility in ("raymarch", "none", "ray_network", "visibility_mlp"):
        context = scene.integrator().context
        context.settings = replace(context.settings, visibility=visibility)
        with pytest.raises(MiNtfError, match=r"\(sky\): 3 texels of data are NaN or infinite.*row 5, column 0"):
            scene.integrator().render(scene)


def test_negative_texels_subtract_where_they_are_summed_and_are_refused_where_drawn(blobs):
    image = skies.sky(16, 32)
    image[3:6, 4:9] = -0.1
    rows, _ = light_rows.sky(mi.load_dict(skies.emitter(image)), "envmap", 512)
    d, solid_angle = sphere()
    power = looked_up(mi.load_dict(skies.emitter(image)), d) * solid_angle[:, None]
    np.testing.assert_allclose(rows.power.sum(axis=0), power.sum(axis=0), rtol=1e-3)
    scene = scenes.scene(blobs, scenes.nrf(light_samples=2), {"sky": skies.emitter(image)}, size=4, spp=1)
    with pytest.raises(MiNtfError, match=r"15 texels of data are negative.*row 3, column 4"):
        scene.integrator().render(scene)


@pytest.mark.parametrize("size", [(1, 1), (3, 2), (5, 7), (33, 64), (600, 1300)])
def test_power_has_the_gradient_of_every_texel(size, rng):
    """Its value is the rows'; its derivative by a texel is the solid angle of that texel's bilinear hat."""
    loaded = mi.load_dict(skies.emitter(rng.uniform(0, 1, (*size, 3)), scale=2.0))
    rows, cells = light_rows.sky(loaded, "envmap", 100)
    data = mi.traverse(loaded)["data"]
    texels = mi.Float(data.array)
    dr.enable_grad(texels)
    power = light_gradients.cell_power(texels * 2.0, data.shape[:2], cells)
    np.testing.assert_allclose(np.array(dr.detach(power)).T, rows.power, rtol=1e-5)
    dr.backward(power)
    found = np.array(dr.grad(texels)).reshape(data.shape)[:, 1:-1, 0]
    height = data.shape[0]
    step = np.pi / (height - 1)
    theta = np.arange(height) * step
    hat = 2 * np.sin(theta) * (1 - np.cos(step)) / step  # ∫ hat(θ) sin θ dθ in closed form, cut in two at the poles
    hat[[0, -1]] = 1 - np.sin(step) / step
    wanted = np.tile(2 * hat[:, None] * 2 * np.pi / found.shape[1], (1, found.shape[1]))
    np.testing.assert_allclose(found, wanted, rtol=1e-3)  # float32 sums; the closed form loses digits at 600 rows


def picture(scene, parameters=None, seed=3):
    return mi.render(scene, parameters, seed=seed, seed_grad=seed + 1)[..., :3]


@pytest.mark.parametrize(
    ("visibility", "dark"),
    [
        ("none", False),
        ("none", True),
        pytest.param("raymarch", False, marks=pytest.mark.slow),
        pytest.param("transmittance_map", True, marks=pytest.mark.slow),
        pytest.param("visibility_mlp", False, marks=pytest.mark.slow),
    ],
)
def test_picture_has_the_gradient_of_single_texels(blobs, visibility, dark):
    """Light is additive: the derivative by a texel is the picture of that texel alone. `dark`: of a black map."""
    image = 0 * skies.sky(64, 128) if dark else skies.sky(64, 128)
    image[20:30, 90:100] = 0
    integrator = scenes.nrf(visibility, environment_lights=128)
    scene = scenes.scene(blobs, integrator, {"sky": skies.emitter(image)}, size=8, spp=8)
    parameters = mi.traverse(scene)
    data = mi.TensorXf(parameters["sky.data"])
    dr.enable_grad(data)
    parameters["sky.data"] = data
    parameters.update()
    dr.backward(dr.mean(picture(scene, parameters), axis=None))
    gradient = np.array(dr.grad(data))[:, 1:-1]
    assert (gradient[1:-1].sum(axis=-1) > 0).mean() > 0.95  # but where the camera sees nothing that a texel lights
    for row, column in ((25, 95), (12, 40), (31, 8), (40, 60)):
        alone = np.zeros_like(image)
        alone[row, column] = 1
        few = scenes.scene(
            blobs, scenes.nrf(visibility, environment_lights=4), {"sky": skies.emitter(alone)}, size=8, spp=8
        )
        wanted = float(dr.mean(picture(few, seed=4), axis=None).array[0])
        # A texel shines from its cell's centre: of 128 cells 8° wide, wider where it is dark, up to 25 % (measured).
        assert gradient[row, column].sum() == pytest.approx(wanted, rel=0.3), (row, column)


@pytest.mark.slow
@pytest.mark.parametrize(("texels", "shift"), [(3, 0), (1, 1)])
def test_picture_under_a_2k_sky_is_the_importance_sampled_one(tmp_path, texels, shift):
    """Default settings but for the march: one map a light has errors of its own. Both pictures are noisy: the variances
    are taken off the mean square of their difference."""
    field = scenes.write_blobs(tmp_path, log_density=3.0)
    sky = {"sky": skies.emitter(np.roll(skies.sky(1024, 2048, texels=texels), shift, axis=1))}
    summed = scenes.scene(field, scenes.nrf("raymarch"), sky, size=16, spp=32)
    drawn = scenes.scene(field, scenes.nrf(light_samples=8), sky, size=16, spp=32)
    pair = [np.stack([scenes.render(s, i + 8 * (s is drawn))[..., :3] for i in range(4)]) for s in (summed, drawn)]
    noise = sum((p.var(axis=0, ddof=1) / len(p)).mean() for p in pair)
    ours, theirs = (p.mean(axis=0) for p in pair)
    error = np.sqrt(max(((ours - theirs) ** 2).mean() - noise, 0) / (theirs**2).mean())
    print(f"{texels} texels, shifted by {shift}: {error:.2%}, noise {np.sqrt(noise / (theirs**2).mean()):.2%}, mean "
          f"{ours.mean() / theirs.mean():.4f}")  # fmt: skip
    assert error < 0.03
    assert ours.mean() == pytest.approx(theirs.mean(), rel=0.01)

"""Films, filters, samplers, sensors, seeds and numbers of samples: whatever is chosen, the picture is the same one."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, pictures, scenes, ztest
from helpers.pairwise import pairwise

SIZE, BLOCK = 32, 8
OPTIONS = {
    "pixel_format": ("rgba", "rgb", "luminance", "luminance_alpha", "xyz", "xyza"),
    "rfilter": ("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"),
    "method": ("raymarch", "transmittance_map", "transmittance_volume", "ray_network", "visibility_mlp",
               "none"),
    "sampler": ("independent", "stratified", "multijitter", "orthogonal", "ldsampler"),
    "spp": (16, 4, 7, 49),
    "seed": (0, 1, 2**31, 2**32 - 1),
    "component_format": ("float32", "float16"),
    "crop": ((), (5, 3, 19, 27), (31, 0, 1, 32)),
    "sample_border": (False, True),
    "max_depth": (2, 4),
    "bounces": ("auto", "paths"),
}
ROWS = pairwise(OPTIONS)
LUMINANCE = np.array([0.212671, 0.715160, 0.072169])
XYZ = np.array([[0.412453, 0.357580, 0.180423], LUMINANCE, [0.019334, 0.119193, 0.950227]])
LIGHT = {"light": scenes.light("point")}


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    return scenes.write_blobs(tmp_path_factory.mktemp("field"), log_density=3.0, visibility=True)


def picture(blobs, method, spp, seed=0, sampler="independent", max_depth=2, bounces="auto",
            **film) -> np.ndarray:
    loaded = scenes.scene(blobs, pictures.integrator(method, max_depth=max_depth, bounces=bounces), LIGHT, size=SIZE,
                          spp=spp, sampler=sampler, film_options=film, medium={"resolution": 96})  # fmt: skip
    return scenes.render(loaded, seed).astype(np.float64)


@pytest.fixture(scope="module")
def neutral(blobs):
    return cache(lambda method, **options: picture(blobs, method, 64, 5, **options))


def channels(rgba: np.ndarray, pixel_format: str) -> np.ndarray:
    """Return the channels of a picture that a film of this format stores."""
    rgb, alpha = rgba[..., :3], rgba[..., 3:]
    base = pixel_format.removesuffix("_alpha").removesuffix("a")
    value = {"rgb": rgb, "luminance": rgb @ LUMINANCE[:, None], "xyz": rgb @ XYZ.T}[base]
    return value if base == pixel_format else np.concatenate([value, alpha], -1)


def name(row: dict) -> str:
    return " ".join("×".join(map(str, v)) or "whole" if isinstance(v, tuple) else str(v) for v in row.values())


@pytest.mark.parametrize("row", [r if i % 3 == 0 else pytest.param(r, marks=pytest.mark.slow)
                                 for i, r in enumerate(ROWS)], ids=name)
def test_pairwise(blobs, neutral, row, check):
    """Means of blocks of 8² pixels against an RGBA film with a box filter, over the brightest block."""
    options = {k: row[k] for k in ("spp", "seed", "sampler", "max_depth", "bounces")}
    film = {"pixel_format": row["pixel_format"], "component_format": row["component_format"],
            "rfilter": {"type": row["rfilter"]}, "sample_border": row["sample_border"]}  # fmt: skip
    truth = channels(neutral(row["method"], max_depth=row["max_depth"], bounces=row["bounces"]), row["pixel_format"])
    brightest = ztest.block_means(truth, BLOCK).max((0, 1))
    if row["crop"]:
        x, y, width, height = row["crop"]
        film |= {"crop_offset_x": x, "crop_offset_y": y, "crop_width": width, "crop_height": height}
        truth = truth[y : y + height, x : x + width]
    image = picture(blobs, row["method"], **options, **film)
    assert image.shape == truth.shape
    size = min(BLOCK, *truth.shape[:2])
    a, b = (ztest.block_means(i, size) for i in (image, truth))
    noise = 0.02 + (0.08 if row["spp"] < 16 else 0.04) * (1 if row["max_depth"] == 2 else 1.5)
    check(name(row), row["method"], "block means", (a - b) / brightest, noise)


def test_every_pair_is_met(check):
    seen = {((a, r[a]), (b, r[b])) for r in ROWS for a in OPTIONS for b in OPTIONS if a < b}
    wanted = {((a, u), (b, v)) for a in OPTIONS for b in OPTIONS if a < b for u in OPTIONS[a] for v in OPTIONS[b]}
    check("the matrix of configurations", "pairwise", "pairs of options left out", len(wanted - seen), 0)


def test_specfilm_is_refused(check):
    """Mitsuba itself says that it needs a spectral variant."""
    with pytest.raises(RuntimeError, match="spectral"):
        mi.load_dict({"type": "specfilm", "width": 4, "height": 4,
                      "band": {"type": "spectrum", "value": [(400, 1.0), (700, 1.0)]}})  # fmt: skip
    check("specfilm", "film", "one clear error", 0, 0)


@pytest.fixture(scope="module")
def fog(tmp_path_factory):
    """Black fog of σ = 0.8 before a sky of radiance 1."""
    black = fields.uniform(0.8)
    fields.constant(black[1], "reflectance", [0, 0, 1, *[-1e4] * 3, 0, -1e4])
    path = pictures.save(tmp_path_factory.mktemp("fog"), black)
    return {"sky": {"type": "constant"}, "ball": pictures.ball(path, resolution=64)}


SENSORS = ("perspective", "perspective off centre", "perspective, far", "thinlens", "orthographic", "radiancemeter",
           "distant at a point", "distant", "irradiancemeter", "batch")  # fmt: skip


def sensors() -> dict:
    """Sensors of every kind, 3 × 2 pixels where they may have them: name → what makes one in a scene."""
    look = mi.ScalarTransform4f().look_at([0.3, 0.4, 4], [0.3, 0, 0], [0, 1, 0])

    def sensor(kind, width=3, height=2, **options):
        film = {**scenes.film(1), "width": width, "height": height, "pixel_format": "rgb"}
        return {"sensor": {"type": kind, "film": film, **options}}

    plate = mi.ScalarTransform4f().translate([0.2, -1.5, 0]).rotate([1, 0, 0], -90).scale(0.3)
    meter = {"type": "rectangle", "to_world": plate, **sensor("irradiancemeter", 1, 1)}
    left, right = (sensor("perspective", 1, 1, to_world=look, fov=f)["sensor"] for f in (20, 40))
    view = {"to_world": look, "fov": 30}
    return {
        "perspective": sensor("perspective", **view),
        "perspective off centre": sensor(
            "perspective", principal_point_offset_x=0.3, principal_point_offset_y=-0.2, **view),
        "perspective, far": sensor("perspective", fov=1e-2, to_world=mi.ScalarTransform4f().look_at(
            [0, 0, 1e4], [0, 0, 0], [0, 1, 0]), far_clip=1e5),
        "thinlens": sensor("thinlens", aperture_radius=0.5, focus_distance=3.0, **view),
        "orthographic": sensor("orthographic", to_world=look),
        "radiancemeter": sensor("radiancemeter", 1, 1, to_world=look),
        "distant at a point": sensor("distant", 1, 1, direction=[0, -0.3, -1], target=[0.3, 0.2, 0]),
        "distant": sensor("distant", 1, 1, direction=[0.2, 0, -1]),
        "irradiancemeter": {"plate": meter},
        "batch": sensor("batch", 2, 1, a=left, b=right),
    }  # fmt: skip


@pytest.mark.parametrize("spp", [1024, pytest.param(999, marks=pytest.mark.slow)])
@pytest.mark.parametrize("method", ["raymarch", pytest.param("transmittance_map", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", SENSORS)
def test_sensor(fog, kind, method, spp, check):
    """The sky through fog, against e^(−σ l) along the rays that Mitsuba draws of the sensor."""
    integrator = pictures.integrator(method, hide_emitters=False, samples=64, environment_lights=1)
    scene = mi.load_dict({"type": "scene", "integrator": integrator, **fog, **sensors()[kind]})
    sensor = scene.sensors()[0]
    image = np.array(mi.render(scene, spp=spp), np.float64)
    height, width = image.shape[:2]
    rng, count = np.random.default_rng(0), 40000
    truth = np.zeros(image.shape[:2])
    for y, x in np.ndindex(height, width):
        u, v = rng.random((2, count))
        at = mi.Point2f(mi.Float((u + x) / width), mi.Float((v + y) / height))
        aperture = mi.Point2f(*map(mi.Float, rng.random((2, count))))
        ray, weight = sensor.sample_ray_differential(0.0, 0.5, at, aperture)
        o, d = (np.array(v, np.float64).reshape(3, -1).T for v in (ray.o, ray.d))
        truth[y, x] = (np.array(weight, np.float64).reshape(3, -1)[0] * np.exp(-0.8 * _inside(o, d))).mean()
    # Most of the noise is that of our samples: where rays differ within a pixel, 0.25/√spp.
    check(f"{kind}, {spp} samples", method, "radiance", (image - truth[..., None]) / max(truth.max(), 1), 0.015)


def _inside(o, d) -> np.ndarray:
    """Lengths of the rays within the unit sphere."""
    along = (o * d).sum(1)
    middle = o - along[:, None] * d
    square = 1 - (middle * middle).sum(1)
    half = np.sqrt(np.where(square > 0.05**2, square, 0))  # shorter chords count as none
    return np.maximum(half - along, 0) - np.maximum(-half - along, 0)


@pytest.mark.parametrize("form", [5, np.uint32(5), "array"], ids=str)
def test_seed_forms(blobs, form, check):
    seed = mi.UInt32(5) if isinstance(form, str) else form
    loaded = scenes.scene(blobs, scenes.nrf(), LIGHT, size=16, spp=4, medium={"resolution": 96})
    error = np.array(mi.render(loaded, seed=seed)) - np.array(mi.render(loaded, seed=5))
    check(f"seed given as {type(seed).__name__}", "raymarch", "bits that differ", error, 0)


@pytest.mark.parametrize("spp", [1, 2, 3, 1000, 2**16 + 1, pytest.param(2**21, marks=pytest.mark.slow)])
@pytest.mark.parametrize("sampler", OPTIONS["sampler"])
def test_numbers_of_samples(fog, spp, sampler, check):
    """The pixel looks through the middle of the fog and its rays are alike, so any number of samples is exact."""
    sensor = {**pictures.camera((0, 0, 4), fov=1e-3, size=1), "sampler": {"type": sampler}}
    image = pictures.render("none", {"sensor": sensor, **fog}, spp=spp, hide_emitters=False, max_depth=1)
    check(f"{spp} samples of {sampler}", "camera march", "radiance", image[..., :3] - np.exp(-1.6), 1e-5)

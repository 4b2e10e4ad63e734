"""Random scenes: fields × films × sensors × lights × methods × dials, small enough for a second each. One seed, one
scene; nothing here knows what it should look like."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np

import mi_ntf.render
from helpers import emitters, fields
from helpers.variants import VARIANT
from mi_ntf.core import field_file
from mi_ntf.core.architecture import Similarity

SHIPPED = Path(__file__).parents[2] / "scenes"
SIMILARITY = Similarity((0.1, 0.0, -0.1), 1.2)
SIGNED = ("mitchell", "catmullrom", "lanczos")
"""Filters with negative lobes."""
FILTERS = ("box", "box", "gaussian", "tent", *SIGNED)
PLAIN = ("point", "spot", "textured", "directional", "constant", "envmap", "sunsky", "area", "projector")
SKIES = ("constant", "envmap", "sunsky")
BSDFS = {
    "diffuse": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.5, 0.3]}},
    "metal": {"type": "roughconductor", "alpha": 0.3},
    "plastic": {"type": "plastic"},
    "glass": {"type": "dielectric"},
    "mirror": {"type": "conductor"},
    "principled": {"type": "principled", "roughness": 0.4, "specular": 0.5},
}
LEAF = {"type": "mask", "opacity": {"type": "checkerboard", "color0": 0.2, "color1": 0.9},
        "nested": {"type": "twosided", "bsdf": {"type": "diffuse"}}}
CROSSED = {
    "null": {"type": "null"},
    "leaf": LEAF,
    "pane": {"type": "thindielectric", "specular_transmittance": {"type": "rgb", "value": [0.9, 0.7, 0.4]}},
    "blend": {"type": "blendbsdf", "weight": 0.4, "a": {"type": "null"}, "b": {"type": "diffuse"}},
}
"""BSDFs with a null component."""


@dataclass(frozen=True)
class Scene:
    """`what`: its choices in words; `scene`, `integrator`: Mitsuba dictionaries; `signed`: whether its film's filter
    has negative lobes; `coloured`: channels of the film that are colours."""

    seed: int
    what: str
    scene: dict
    integrator: dict
    signed: bool
    coloured: int


def write_fields(folder: Path) -> dict[str, Path]:
    """Fields of every kind: blobs as thin as smoke and as hard as stone, fog, nothing at all; and two of the shipped
    ones."""
    balls = [(-0.3, 0.05, 0.0), (0.45, 0.3, 0.15), (0.1, -0.5, 0.35)], [0.5, 0.28, 0.2]
    made = {
        "smoke": fields.blobs(*balls, log_density=0.5, similarity=SIMILARITY),
        "blobs": fields.blobs(*balls, log_density=3.0, similarity=SIMILARITY),
        "stone": fields.blobs(*balls, log_density=6.0, roughness=0.16, specular=0.9, similarity=SIMILARITY),
        "fog": fields.uniform(0.8, similarity=SIMILARITY),
        "nothing": fields.empty(),
    }
    paths = {name: folder / f"{name}.safetensors" for name in made}
    for name, (header, tensors) in made.items():
        field_file.save(paths[name], header, tensors, np.float32)
    return paths | {name: SHIPPED / name / "field.safetensors" for name in ("knot", "cloud")}


@contextmanager
def prepared() -> Iterator[dict[str, Path]]:
    """Set the variant, register the plugins, and give the field files in a folder that goes afterwards."""
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    with tempfile.TemporaryDirectory() as folder:
        yield write_fields(Path(folder))


class _Draw:
    """A random stream that notes its choices."""

    def __init__(self, seed: int | list[int]):
        self.rng, self.notes = np.random.default_rng(seed), []

    def pick(self, name: str, options, weights=None):
        weights = None if weights is None else np.array(weights) / sum(weights)
        value = options[self.rng.choice(len(options), p=weights)]
        self.notes.append(f"{name}={value}")
        return value

    def vector(self, size: float) -> np.ndarray:
        return self.rng.uniform(-size, size, 3)


def draw(seed: int, files: dict[str, Path]) -> Scene:
    """The scene of `seed`, on the fields of :func:`write_fields`."""
    d = _Draw(seed)
    scene, centre, radius = _media(d, files, d.pick("fields", (1, 2, 3), (6, 2, 1)), apart=False)
    kinds = [d.pick("light", (*PLAIN, "directionalarea", "ntf", "dark", "camera"))
             for _ in range(d.pick("lights", (0, 1, 2, 4), (1, 8, 4, 2)))]
    eye = centre + radius * np.array([0.6, 0.8, 3.6]) + 0.3 * radius * d.vector(1)
    scene |= _lights(kinds, centre, radius, eye, scene["field_0"]["interior"])
    scene |= _surfaces(d, centre, radius, BSDFS)
    film, signed, coloured = _film(d)
    scene["sensor"] = _sensor(d, eye, centre, radius, film, d.pick("spp", (1, 2, 4, 9)))
    integrator = _integrator(d)
    more = _Draw([seed, 1])  # a stream of its own, so that the other choices of old seeds stay what they were
    _vary(more, scene, centre, radius, eye)
    limit = more.pick("limit", ("", "noise_threshold", "max_error", "time_budget"), (6, 1, 1, 1))
    integrator |= {limit: more.pick(limit, (0.05, 0.3))} if limit else {}
    return Scene(seed, " ".join(d.notes + more.notes), scene, integrator, signed, coloured)


def draw_pair(seed: int, files: dict[str, Path]) -> tuple[Scene, dict]:
    """A scene that stock ``volpath`` renders identically, and its integrator: no media that overlap, no method that
    approximates, an environment as Mitsuba samples it, and path lengths of two or three edges."""
    d = _Draw(seed)
    files = {name: files[name] for name in ("smoke", "blobs", "fog", "cloud")}
    scene, centre, radius = _media(d, files, d.pick("fields", (1, 2), (2, 1)), apart=True)
    kinds = [d.pick("light", PLAIN) for _ in range(d.pick("lights", (1, 2)))]
    eye = centre + radius * np.array([0.6, 0.8, 3.6]) + 0.3 * radius * d.vector(1)
    scene |= _lights(kinds, centre, radius, eye, None)
    scene |= _surfaces(d, centre, radius, {name: BSDFS[name] for name in ("diffuse", "metal", "principled")})
    film = {"type": "hdrfilm", "width": 16, "height": 16, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    scene["sensor"] = _camera("perspective", eye, centre, film, 16, "independent")
    both = {"max_depth": d.pick("max_depth", (2, 2, 3)), "hide_emitters": bool(d.pick("hide", (0, 1)))}
    drawn = d.pick("light_samples", (2, 4)) if set(SKIES) & set(kinds) else d.pick("light_samples", (0, 0, 3))
    ours = {"type": "nrf", "visibility": "raymarch", "samples": 768, "light_samples": drawn, "bounces": "paths",
            **both}
    more = _Draw([seed, 1])
    _vary(more, scene, centre, radius, eye)
    theirs = {"type": "volpath", "rr_depth": 64, **both}
    return Scene(seed, " ".join(d.notes + more.notes), scene, ours, False, 3), theirs


def _media(d: _Draw, files: dict, count: int, apart: bool):
    """``(shapes, centre, radius)``: `count` fields in their bounding shapes; the first one's sphere."""
    size = 10 ** d.rng.uniform(-1, 1)
    shapes, first = {}, None
    for i in range(count):
        name = d.pick("field", tuple(files))
        similarity = field_file.load(files[name])[0].similarity
        axis = d.vector(1)
        turn = mi.ScalarTransform4f().rotate((axis / np.linalg.norm(axis)).tolist(), float(d.rng.uniform(0, 360)))
        scale = size * (1.0 if i == 0 else d.rng.uniform(0.3, 0.9)) / similarity.radius
        inner = np.array((turn @ mi.ScalarTransform4f().scale(scale)).matrix, np.float64)[:3, :3] @ similarity.center
        centre = d.vector(2 * size) if first is None else first + size * (
            np.array([-2.3, 0.2, 0.3]) if apart else d.vector(1))
        place = mi.ScalarTransform4f().translate((centre - inner).tolist()) @ turn
        first = centre if first is None else first
        extra = {} if apart else {"representation": d.pick("as", ("grid", "grid", "network"))}
        shapes[f"field_{i}"] = {
            "type": "sphere", "center": centre.tolist(), "radius": scale * similarity.radius,
            "bsdf": {"type": "null"},
            "interior": {"type": "nrf", "filename": str(files[name]), "to_world": place, "scale": scale,
                         "resolution": 48, **extra},
        }  # fmt: skip
    return shapes, first, size


def _lights(kinds, centre, radius, eye, medium) -> dict:
    """Return one light of each kind. Mitsuba allows one environment, so the first sky alone stays."""
    skies = [k for k in kinds if k in SKIES]
    result = {}
    for i, kind in enumerate(kinds):
        if (kind in SKIES and kind != skies[0]) or (kind in kinds[:i] and kind in (*SKIES, "ntf")):
            continue
        if kind == "ntf":
            result[f"light_{i}"] = {"type": "ntf", "light": emitters.emitter("spot", centre, radius), "medium": medium}
        elif kind == "dark":
            result[f"light_{i}"] = {"type": "point", "position": [0, 0, 0], "intensity": 0.0}
        elif kind == "camera":
            power = 20 * radius * radius
            result[f"light_{i}"] = {"type": "point", "position": eye.tolist(), "intensity": power}
        else:
            result[f"light_{i}"] = emitters.emitter(kind, centre, radius)
    return result


def _surfaces(d: _Draw, centre, radius, bsdfs: dict) -> dict:
    """Maybe a floor and a ball beside the field."""
    shapes, to_world = {}, mi.ScalarTransform4f
    if d.pick("floor", (0, 0, 1)):
        place = to_world().translate((centre - [0, 1.1 * radius, 0]).tolist()).rotate([1, 0, 0], -90).scale(4 * radius)
        shapes["floor"] = {"type": "rectangle", "to_world": place, "bsdf": bsdfs[d.pick("bsdf", tuple(bsdfs))]}
    if d.pick("ball", (0, 0, 0, 1)):
        place = centre + radius * np.array([1.3, -0.4, 0.9])
        shapes["ball"] = {"type": "sphere", "center": place.tolist(), "radius": 0.4 * radius,
                          "bsdf": bsdfs[d.pick("bsdf", tuple(bsdfs))]}
    return shapes


def _vary(d: _Draw, scene: dict, centre, radius, eye) -> None:
    """Add to `scene` surfaces that let light through, instances, and lights that are sampled unevenly."""
    to_world = mi.ScalarTransform4f
    for name, towards in (("at_light", emitters.AWAY), ("at_camera", (eye - centre) / radius)):
        if d.pick(name, (0, 0, 1)):
            place = (centre + 0.6 * radius * np.asarray(towards)).tolist()
            look = to_world().look_at(place, centre.tolist(), [0, 1, 0.1]) @ to_world().scale(0.7 * radius)
            scene[name] = {"type": "rectangle", "to_world": look, "bsdf": CROSSED[d.pick("bsdf", tuple(CROSSED))]}
    if d.pick("case", (0, 0, 0, 0, 1)):
        scene["case"] = {"type": "sphere", "center": centre.tolist(), "radius": 7 * radius, "bsdf": {"type": "null"}}
    if d.pick("instances", (0, 0, 0, 1)):
        bsdf = d.pick("bsdf", ("leaf", "diffuse"))
        scene["group"] = {"type": "shapegroup", "ball": {
            "type": "sphere", "radius": 0.3 * radius, "bsdf": (CROSSED | BSDFS)[bsdf]}}
        for i, at in enumerate(([1.2, 0.5, 0.9], [-0.8, 0.9, 1.1])):
            scene[f"instance_{i}"] = {"type": "instance", "group": {"type": "ref", "id": "group"},
                                      "to_world": to_world().translate((centre + radius * np.array(at)).tolist())}
    lights = [light.get("emitter", light) for name, light in scene.items() if name.startswith("light_")]
    for i, light in enumerate(lights):
        # Mitsuba refuses a scene whose emitters all have the weight 0, and ntf refuses that weight.
        weights = (1.0, 0.3, 2.0, 0.0) if i and light["type"] != "ntf" else (1.0, 2.0)
        light["sampling_weight"] = d.pick("weight", weights)
        if light["type"] == "envmap":
            light["mis_compensation"] = bool(d.pick("mis_compensation", (0, 1)))


COLOURS = {"rgb": 3, "rgba": 3, "luminance": 1, "luminance_alpha": 1, "xyz": 3, "xyza": 3}


def _film(d: _Draw):
    """``(film, signed, coloured)``: up to 32 pixels a side, odd numbers and crops among them."""
    width, height = (d.pick(n, (1, 7, 16, 31, 32), (1, 2, 6, 2, 4)) for n in ("width", "height"))
    rfilter, pixels = d.pick("filter", FILTERS), d.pick("pixels", tuple(COLOURS), (2, 4, 1, 1, 1, 1))
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": rfilter}, "pixel_format": pixels,
            "component_format": d.pick("component", ("float32", "float16")),
            "sample_border": bool(d.pick("border", (0, 0, 1)))}  # fmt: skip
    if d.pick("crop", (0, 0, 1)) and min(width, height) > 6:
        film |= {"crop_width": width // 2, "crop_height": height // 3, "crop_offset_x": width // 4,
                 "crop_offset_y": height // 3}  # fmt: skip
    return film, rfilter in SIGNED, COLOURS[pixels]


def _sensor(d: _Draw, eye, centre, radius, film: dict, spp: int) -> dict:
    kind = d.pick("sensor", ("perspective", "thinlens", "orthographic", "radiancemeter", "distant", "irradiancemeter"),
                  (10, 2, 2, 1, 1, 0.5))  # fmt: skip
    sampler = d.pick("sampler", ("independent", "stratified", "multijitter", "orthogonal", "ldsampler"),
                     (6, 1, 2, 1, 1))  # fmt: skip
    if kind in ("radiancemeter", "distant", "irradiancemeter"):
        film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgba"}
    return _camera(kind, eye, centre, film, spp, sampler, radius)


def _camera(kind: str, eye, centre, film: dict, spp: int, sampler: str, radius: float = 1.0) -> dict:
    look = mi.ScalarTransform4f().look_at(eye.tolist(), np.asarray(centre).tolist(), [0, 1, 0])
    forward = np.asarray(centre) - eye
    common = {"type": kind, "film": film, "sampler": {"type": sampler, "sample_count": spp}}
    placed = {
        "perspective": {"fov": 34, "to_world": look},
        "thinlens": {"fov": 34, "to_world": look, "aperture_radius": 0.05 * radius,
                     "focus_distance": float(np.linalg.norm(forward))},
        "orthographic": {"to_world": look @ mi.ScalarTransform4f().scale(1.2 * radius)},
        "radiancemeter": {"to_world": look},
        "distant": {"direction": forward.tolist(), "target": np.asarray(centre).tolist()},
        "irradiancemeter": {},
    }[kind]  # fmt: skip
    if kind == "irradiancemeter":
        return {"type": "rectangle", "to_world": look @ mi.ScalarTransform4f().scale(0.2 * radius),
                "sensor": common}  # fmt: skip
    return common | placed


def _integrator(d: _Draw) -> dict:
    method = d.pick("visibility", ("raymarch", "transmittance_map", "ray_network", "transmittance_volume",
                                   "visibility_mlp", "none", "auto"), (3, 4, 3, 2, 1, 1, 2))  # fmt: skip
    options = {
        "samples": d.pick("samples", (8, 48, 128, 384)),
        "light_samples": d.pick("light_samples", (0, 1, 3), (8, 1, 2)),
        "environment_lights": d.pick("environment_lights", (1, 2, 8, 50)),
        "map_resolution": d.pick("map_resolution", (4, 9, 32, 64)),
        "map_source": d.pick("map_source", ("field", "network")),
        "map_components": d.pick("map_components", (1, 2)),
        "map_memory": d.pick("map_memory", (0.3, 4.0, 512.0), (1, 1, 4)),
        "max_depth": d.pick("max_depth", (0, 1, 2, 3, 4, -1), (1, 1, 10, 3, 1, 2)),
        "bounces": d.pick("bounces", ("auto", "paths")),
        "hide_emitters": bool(d.pick("hide", (0, 1))),
    }
    names = ("depth", "normal", "albedo", "roughness", "opacity", "visibility", "visibility_lights")
    if d.pick("aovs", (0, 0, 0, 1)):
        options["aovs"] = ",".join(n for n in names if d.rng.random() < 0.5)
    return {"type": "nrf", "visibility": method, **options}

"""Derivatives of the picture by the parameters of a field: kinds of fields × lights × methods.

Each is compared with central differences over the same random numbers. A shadow that is looked up has the derivative of
its march, so differences by density are those of `raymarch`.
"""

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from helpers.derivatives import backward, differences

from mi_ntf.field import Field

STEPS = {"density": 0.1, "albedo": 0.05, "roughness": 0.01}
"""Steps of the differences; that of density is a fraction of the mean where the parameter is no logarithm."""
KINDS = ("surface", "smoke", "voxels")
LIGHTS = ("point", "env", "area")
METHODS = ("raymarch", "transmittance_map", "transmittance_atlas")
AREA = {"type": "sphere", "center": [3.4, 3.0, 2.5], "radius": 0.5, "emitter": {"type": "area", "radiance": 60.0}}
MEDIUM = "ball.interior_medium."
QUICK = {("surface", "area", "transmittance_atlas", "albedo"), ("smoke", "point", "raymarch", "density"),
         ("voxels", "point", "transmittance_map", "density")}
"""Combinations that also run outside of the catalogue."""
ALL = [(kind, light, method, name) for kind in KINDS for light in LIGHTS for method in METHODS for name in STEPS
       if name != "roughness" or kind == "surface"]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Kind → file of a field that is soft enough for its density to be seen."""
    folder = tmp_path_factory.mktemp("fields")

    def density(x, y, z):
        return 2 * np.exp(-3 * (x * x + y * y + 2 * z * z)) * (1 + 0.5 * np.sin(5 * x + 2 * z))

    low, high = (np.array(scenes.SIMILARITY.center) + side * scenes.SIMILARITY.radius for side in (-0.6, 0.6))
    center = np.array(scenes.SIMILARITY.center)
    voxels = Field.from_function(lambda p: density(*(p - center).T / scenes.SIMILARITY.radius),
                                 lambda p: np.broadcast_to([0.7, 0.5, 0.3], p.shape), (low, high), resolution=24)
    (folder / "smoke").mkdir()
    yield {"surface": scenes.write_blobs(folder, log_density=2.0, roughness=0.6), "voxels": voxels.path,
           "smoke": scenes.write_blobs(folder / "smoke", log_density=1.0, phase=0.3)}


def case(file, name, light, method):
    """Scene, parameters, key, direction and type for the derivative by half of the blocks of a parameter."""
    integrator = scenes.nrf(method, samples=192, environment_lights=16, map_resolution=64)
    scene = scenes.scene(file, integrator, {"light": AREA if light == "area" else scenes.light(light)}, size=12,
                         spp=64 if name == "density" else 16)
    parameters = mi.traverse(scene)
    key = next(MEDIUM + k for k in (name, f"log_{name}") if MEDIUM + k in parameters)
    places = np.array(parameters[MEDIUM + ("density_blocks" if name == "density" else "reflectance_blocks")])
    direction = np.zeros(parameters[key].shape, np.float32)
    direction[places[:, 0] < np.median(places[:, 0])] = 1
    return scene, parameters, key, direction, mi.TensorXf


@pytest.mark.parametrize(("kind", "light", "method", "name"), [
    row if row in QUICK else pytest.param(*row, marks=pytest.mark.slow) for row in ALL])
def test_derivatives_are_those_of_differences(files, check, kind, light, method, name):
    this = case(files[kind], name, light, method)
    truth = case(files[kind], name, light, "raymarch") if name == "density" else this
    step = STEPS[name]
    if not this[2].endswith(f"log_{name}") and name == "density":
        step *= float(np.mean(np.array(this[1][this[2]])))
    expected = differences(*truth, step)
    # Mitsuba's own suite asks for 5e-4 of smooth parameters. Density differs by the noise of free-flight sampling.
    bound = 0.05 if name == "density" else 5e-3
    check(f"{kind}, {light}, {name}", method, "backward over differences", backward(*this) / expected - 1, bound)

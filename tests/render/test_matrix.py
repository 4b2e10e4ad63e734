"""Every visibility method under every emitter on the shipped fields, against fine marches."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers import emitters

from mi_ntf.infer.visibility import raymarch

SCENES = Path(__file__).parents[2] / "scenes"
TOLERANCE = {
    "raymarch": 0.01,
    "neural_transmittance": 0.05,  # the figure that the networks are trained for
    "transmittance_map": 0.06,  # 128² texels: one is as wide as the finer shadows
    "transmittance_volume": 0.12,  # the same, where one skin is brighter than its neighbour
    "visibility_mlp": 0.6,  # the baseline: a small network that knows the object by heart
}
"""Relative RMSE of the image."""
KINDS = ("point", "spot", "directional", "constant", "envmap", "sunsky", "area", "projector", "directionalarea")


def images(name: str, kind: str, methods) -> dict[str, np.ndarray]:
    """The scene's field from its own camera, 64² pixels, lit by one emitter: method → RGB; "fine" for marches of
    quarter steps."""
    shipped = mi.load_file(str(SCENES / name / "scene.xml"), res="64")
    (ball,) = shipped.shapes()
    light = emitters.emitter(kind, np.array(ball.bbox().center()), float(ball.bbox().extents()[0]) / 2)
    scene = mi.load_dict({"type": "scene", "sensor": shipped.sensors()[0], "ball": ball, "light": light})

    def image(method):
        # Few lights stand for an environment here, the same ones for every method.
        integrator = {"type": "nrf", "visibility": method, "hide_emitters": True, "environment_lights": 8}
        return np.array(mi.render(scene, integrator=mi.load_dict(integrator), spp=4))[..., :3]

    with pytest.MonkeyPatch.context() as patch:
        steps = raymarch.default_steps
        patch.setattr(raymarch, "default_steps", lambda step, gradients: tuple(s / 4 for s in steps(step)))
        fine = image("raymarch")
    return {"fine": fine} | {method: image(method) for method in methods}


@pytest.mark.parametrize("name", ["statue", "globe", "knot"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_method_and_emitter(name, kind):
    found = images(name, kind, TOLERANCE)
    truth = found.pop("fine")
    if kind == "directionalarea":  # direct lighting never finds it, in Mitsuba too
        assert not np.any(truth)
    bright = np.sqrt((truth**2).mean())
    for method, image in found.items():
        assert np.isfinite(image).all(), method
        error = np.sqrt(((image - truth) ** 2).mean()) / max(bright, 1e-9)
        print(f"{name} {kind} {method}: {error:.2%}")
        assert error <= TOLERANCE[method], f"{method}: {error:.1%} of fine marches"

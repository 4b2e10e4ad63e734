"""Fields of smoke: a phase function in place of a surface's reflectance, beside stock ``volpath``."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, ztest

import mi_ntf
from mi_ntf.core import henyey_greenstein, ops
from mi_ntf.render.scene.media import find_media

ALBEDO = (0.7, 0.5, 0.3)


def smoke(folder, g: float, **options):
    """Return a field file of the asymmetric object as smoke."""
    return scenes.write_blobs(folder, log_density=1.0, albedo=ALBEDO, phase=g, **options)


@pytest.mark.parametrize("g", [-0.9, -0.3, 0.0, 0.6, 0.9])
def test_samples_follow_their_density(g, tmp_path):
    """χ² over 10⁶ samples of the phase function of an ``nrf`` medium."""
    loaded = scenes.scene(smoke(tmp_path, g), scenes.nrf(), {"light": scenes.light("directional")})
    medium = find_media(loaded)[0]
    phase = medium.phase_function()

    def interaction(count: int) -> mi.MediumInteraction3f:
        mei = dr.zeros(mi.MediumInteraction3f, count)
        mei.p, mei.wi = mi.Point3f(*map(float, medium.frame.origin)), mi.Vector3f(0.48, -0.6, 0.64)
        return mei

    def sample(points):
        wo, weight, _ = phase.sample(mi.PhaseFunctionContext(None), interaction(dr.width(points)), points.z,
                                     mi.Point2f(points.x, points.y))
        return wo, weight.x / ALBEDO[0]

    def pdf(wo):
        return phase.eval_pdf(mi.PhaseFunctionContext(None), interaction(dr.width(wo)), wo)[1]

    test = mi.chi2.ChiSquareTest(domain=mi.chi2.SphericalDomain(), sample_func=sample, pdf_func=pdf, sample_dim=3,
                                 sample_count=1_000_000, res=101, ires=16)
    assert test.run(significance_level=0.001), test.messages


@pytest.mark.parametrize("g", [-0.7, 0.0, 0.8])
def test_value_is_the_formula(g, tmp_path, rng):
    """Forward scattering is that of light which continues in its direction: ω_i = −ω_o."""
    loaded = scenes.scene(smoke(tmp_path, g), scenes.nrf(), {"light": scenes.light("directional")})
    reflectance = find_media(loaded)[0].reflectance((mi.Float(0.1), mi.Float(0), mi.Float(0)))
    assert reflectance.albedo[1][0] == pytest.approx(ALBEDO[1], rel=1e-3)
    wo, wi = np.array([0, 0, 1.0]), rng.normal(size=(3, 1000))
    wi /= np.linalg.norm(wi, axis=0)
    value, pdf = reflectance.lobe.evaluate(tuple(map(mi.Float, wi.astype(np.float32))), tuple(map(mi.Float, wo)))
    truth = henyey_greenstein.phase(ops, g, -wi[2])
    for channel in (*value, pdf):
        np.testing.assert_allclose(channel.numpy(), truth, rtol=2e-5)


CASES = {"backward": (-0.6, "point", 2), "forward": (0.7, "directional", 2), "even, networks": (0.0, "point", 2),
         "forward, two scatterings": (0.5, "point", 3)}


@pytest.mark.parametrize("case", CASES)
def test_a_field_of_smoke_agrees_with_volpath(case, tmp_path):
    """The integrator passes a z-test against stock ``volpath`` on the same field."""
    g, light, depth = CASES[case]
    path = smoke(tmp_path, g)
    medium = {"resolution": 48, "representation": "network" if "networks" in case else "grid"}

    def pictures(integrator: dict, spp: int) -> list:
        loaded = scenes.scene(path, integrator, {"light": scenes.light(light)}, size=12, medium=medium)
        return [np.array(mi.render(loaded, spp=spp, seed=1000 * s + 7))[..., :3] for s in range(4)]

    stock = {"type": "volpath", "max_depth": depth, "hide_emitters": True}
    ztest.check(pictures(scenes.nrf(max_depth=depth), 32), pictures(stock, 256), case, block=4)


def test_smoke_has_no_skin_and_no_specular_lobe(tmp_path):
    """The file's phase function decides, whatever the networks say of roughness, and opacity."""
    path = smoke(tmp_path, 0.25, roughness=0.2, specular=0.9)
    field = mi_ntf.Field.load(path, resolution=48)
    assert field.phase == 0.25
    values = field.reflectance(np.array([scenes.CENTERS[0]]) * scenes.SIMILARITY.radius + scenes.SIMILARITY.center)
    assert not values.normal.any() and values.roughness == 1 and not values.specular.any()
    assert values.albedo[0] == pytest.approx(ALBEDO, rel=1e-3)
    loaded = scenes.scene(path, scenes.nrf(), {"light": scenes.light("point")}, medium={"resolution": 48})
    medium = find_media(loaded)[0]
    assert not medium.field.softness.opaque and medium.field.grid.gloss == 0

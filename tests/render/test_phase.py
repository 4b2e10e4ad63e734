"""The ``nrf`` phase function: sampling against density, and against the formula."""

import gc
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

import mi_ntf.render
from mi_ntf.core import fresnel, microfacet, ops
from mi_ntf.render.scene import loaded


@pytest.fixture(params=[(0.3, 0.4, None, None), (0.8, 0.1, None, None), (0.4, 0.06, 0.0, None), (0.4, 0.06, 0.6, 0.3),
                        (0.6, (0.95, 0.6, 0.5), 0.2, 0.0)],
                ids=["glossy", "rough", "fresnel", "retro-reflection and tail", "metal with Beckmann's lobe"])
def medium(request, variant, tmp_path):
    mi_ntf.render.register()
    roughness, specular, retro, tail = request.param
    path = scenes.write_blobs(tmp_path, roughness=roughness, specular=specular, albedo=(0.7, 0.5, 0.3),
                              retro=retro, tail=tail)
    scene = scenes.scene(path, {"type": "nrf"}, {"light": scenes.light("directional")})
    (shape,) = scene.shapes()
    return shape.interior_medium()


# Normals point away from the field's origin: at field point (0, 0, 0.5) the normal is +z.
NORMAL_POINT = (0.0, 0.0, 0.5)


def interaction(medium, viewer, count=1):
    mei = dr.zeros(mi.MediumInteraction3f, count)
    mei.p = medium.frame.point_to_world(tuple(mi.Float(c) for c in NORMAL_POINT))
    mei.wi = mi.Vector3f(*map(float, viewer))
    return mei


@pytest.mark.parametrize("angle", [0.2, 1.1, 2.0])
def test_samples_follow_their_density(medium, angle):
    """χ² over 10⁶ samples, with the viewer above, near the horizon, and behind the surface."""
    viewer = [np.sin(angle), 0.0, np.cos(angle)]
    phase = medium.phase_function()

    def sample(points):
        count = dr.width(points)
        wo, weight, _ = phase.sample(
            mi.PhaseFunctionContext(None), interaction(medium, viewer, count), points.z, mi.Point2f(points.x, points.y)
        )
        return wo, dr.select(dr.max(weight) > 0, 1.0, 0.0)

    def pdf(wo):
        return phase.eval_pdf(mi.PhaseFunctionContext(None), interaction(medium, viewer, dr.width(wo)), wo)[1]

    test = mi.chi2.ChiSquareTest(
        domain=mi.chi2.SphericalDomain(),
        sample_func=sample,
        pdf_func=pdf,
        sample_dim=3,
        sample_count=1_000_000,
        res=101,
        ires=16,
    )
    assert test.run(significance_level=0.001), test.messages


def test_value_is_the_formula_and_weight_is_value_over_density(medium, rng):
    phase = medium.phase_function()
    viewer = np.array([0.48, 0.6, 0.64])
    count = 5000
    mei = interaction(medium, viewer, count)
    u = rng.random((3, count)).astype(np.float32)
    wo, weight, pdf = phase.sample(mi.PhaseFunctionContext(None), mei, mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    value, pdf_again = phase.eval_pdf(mi.PhaseFunctionContext(None), mei, wo)
    np.testing.assert_allclose(np.array(pdf), np.array(pdf_again), rtol=2e-3, atol=1e-5)
    # Peaks of GGX amplify the rounding of sampled directions.
    np.testing.assert_allclose(np.array(weight) * np.array(pdf), np.array(value), rtol=5e-3, atol=1e-5)
    _, _, *gloss = medium.source.reflectance(tuple(mi.Float(c) for c in NORMAL_POINT))
    roughness, specular = float(gloss[0][0]), [float(s[0]) for s in gloss[1]]
    softness = float(medium.field.softness(tuple(mi.Float(c) for c in NORMAL_POINT))[0])
    d = np.array(wo, np.float64)
    directions = tuple(d), tuple(np.full(count, c) for c in viewer), (0.0, 0.0, 1.0), roughness
    diffuse, gloss = microfacet.scattering(ops, *directions, softness, medium.field.tail)
    for channel, (albedo, s) in enumerate(zip((0.7, 0.5, 0.3), specular, strict=True)):
        weights = fresnel.weights(ops, *directions, s, medium.field.retro)
        truth = weights[0] * albedo * diffuse + weights[1] * gloss
        # Baked normals are off by 1e-3 between voxels.
        np.testing.assert_allclose(np.array(value)[channel], truth, rtol=0.03, atol=2e-3)


def test_a_medium_that_is_gone_lets_go_of_its_field(medium):
    """Medium and phase function know each other: a cycle of theirs would keep every field for good."""
    path = medium.path
    other = mi.load_dict({"type": "nrf", "filename": path, "resolution": 24})
    grid = weakref.ref(other.field.grid)
    del other
    loaded._load.cache_clear()
    gc.collect()
    assert grid() is None


def test_alone_it_says_what_to_do(variant):
    """A phase function that no medium attached to itself refuses to be evaluated."""
    from mi_ntf.render.plugins.phase import phase_class

    alone = phase_class()(mi.Properties("nrf"))
    with pytest.raises(Exception, match="the nrf medium creates its own"):
        alone.eval_pdf(mi.PhaseFunctionContext(None), dr.zeros(mi.MediumInteraction3f), mi.Vector3f(0, 0, 1))

"""Coloured specular lobes: the phase function of ``nrf`` against BSDFs of Mitsuba, and the mesh that is exported."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes

import mi_ntf.render
from mi_ntf import export
from mi_ntf.core import microfacet, ops
from mi_ntf.core.fresnel import weights
from mi_ntf.infer import scatter, shade
from mi_ntf.render.scene.loaded import LoadedField

POINT = (0.0, 0.0, 0.5)
"""Point of the field whose normal is +z."""
GOLD = (0.98, 0.72, 0.30)
ROUGHNESS = 0.6
BLACK = 1e-6


def directions(rng, count=400):
    """Return ``(wi, wo)``, unit vectors (3, count) of cosines above 0.1 to +z."""
    cos, phi = rng.uniform(0.1, 1, (2, count)), rng.uniform(0, 2 * np.pi, (2, count))
    sin = np.sqrt(1 - cos**2)
    return np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], 1)


def reflected(folder, rng, retro: float | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ρ ⟨n,ω_i⟩ (3, n) of a field of gold as the phase function has it, and the directions."""
    mi_ntf.render.register()
    path = scenes.write_blobs(folder, roughness=ROUGHNESS, specular=GOLD, albedo=(BLACK,) * 3, retro=retro)
    (shape,) = scenes.scene(path, {"type": "nrf"}, {"light": scenes.light("directional")}).shapes()
    medium = shape.interior_medium()
    field: LoadedField = medium.field
    assert field.header.architecture.specular_channels == 3
    wi, wo = directions(rng)
    mei = dr.zeros(mi.MediumInteraction3f, wi.shape[1])
    at = tuple(mi.Float(c) for c in POINT)
    mei.p, mei.wi = medium.frame.point_to_world(at), mi.Vector3f(wo)
    value = np.array(medium.phase_function().eval_pdf(mi.PhaseFunctionContext(None), mei, mi.Vector3f(wi))[0])
    joint = microfacet.joint_cosine(ops, wi[2], wo[2], float(field.softness(at)[0]))
    return value / joint * wi[2], wi, wo


def evaluated(bsdf: dict, wi: np.ndarray, wo: np.ndarray) -> np.ndarray:
    """Return ρ ⟨n,ω_i⟩ (3, n) of a BSDF of Mitsuba."""
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = mi.Vector3f(wo)
    return np.array(mi.load_dict(bsdf).eval(mi.BSDFContext(), si, mi.Vector3f(wi)))


def test_single_scattering_reflects_by_the_phase_function(variant, rng):
    """The sum over lights and the sampled paths have the same colour, in skins and at light from all sides."""
    wi, wo = (tuple(mi.Float(c) for c in v) for v in directions(rng))
    count = dr.width(wi[0])
    values = [tuple(dr.full(mi.Float, c, count) for c in v) for v in (POINT, (0.0, 0.0, 1.0), (0.3, 0.2, 0.1), GOLD)]
    x, normal, albedo, specular = values
    for retro in (None, 0.5):
        matter = shade.Reflectance(normal, albedo, dr.full(mi.Float, ROUGHNESS, count), specular, mi.Float(0.1), retro)
        _, summed = shade._value(wi, shade.Points(x, wo, matter), True, True)
        sampled, _ = scatter.evaluate(wi, wo, matter)
        np.testing.assert_allclose(np.array(summed), np.array(sampled), rtol=1e-5)
        assert np.ptp(np.array(summed), axis=0).min() > 0


def colour(values) -> dict:
    return {"type": "rgb", "value": list(values)}


def test_a_weight_without_fresnel_effect_is_a_coloured_roughconductor(variant, tmp_path, rng):
    value, wi, wo = reflected(tmp_path, rng, retro=None)
    truth = evaluated({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": ROUGHNESS**2,
                       "specular_reflectance": colour(GOLD)}, wi, wo)
    # 1e-3: baked normals, and float16 weights on CUDA.
    np.testing.assert_allclose(value, truth, rtol=0.02, atol=2e-3)


def test_a_normal_reflectance_is_a_metal_of_the_principled_bsdf(variant, tmp_path, rng):
    """Disney's metal has the same lobe with Schlick's term (Burley 2012). Both are 1 at grazing angles.

    Between 30° and 80° Fresnel's equations have up to 0.02 (1 − s) more than Schlick's term.
    """
    value, wi, wo = reflected(tmp_path, rng, retro=0.0)
    truth = evaluated({"type": "principled", "metallic": 1.0, "roughness": ROUGHNESS, "base_color": colour(GOLD)},
                      wi, wo)
    np.testing.assert_allclose(value, truth, rtol=0.06, atol=3e-3)


@pytest.mark.parametrize("material", ["Cu", "Au"])
def test_measured_metals_follow_their_normal_reflectance(variant, tmp_path, rng, material):
    """The normal reflectance of a measured metal gives its reflectance at other angles, too.

    Without it, as one grey weight, the channels of gold would be wrong by half.
    """
    bsdf = {"type": "roughconductor", "material": material, "distribution": "ggx", "alpha": ROUGHNESS**2}
    wi, wo = directions(rng)
    grey = evaluated({"type": "roughconductor", "material": "none", "distribution": "ggx", "alpha": ROUGHNESS**2},
                     wi, wo)
    fresnel = evaluated(bsdf, wi, wo) / grey
    up = np.tile([[0.0], [0.0], [1.0]], 1)
    normal = evaluated(bsdf, up, up) / evaluated({**bsdf, "material": "none"}, up, up)
    modelled = [weights(ops, wi, wo, (0.0, 0.0, 1.0), ROUGHNESS, s, 0.0)[1] for s in normal.ravel()]
    np.testing.assert_allclose(modelled, fresnel, atol=0.05)


def test_the_exported_mesh_has_the_colour(variant, tmp_path):
    exported = export.MeshFile("m.ply", 3, 1, 10.0, [1.0, 1.0, 1.0], ROUGHNESS, [0.8, 0.6, 0.2])
    text = export.mitsuba_shape(tmp_path / "m.ply", exported, np.eye(4))
    assert '<float name="weight" value="0.8"/>' in text
    assert '<rgb name="specular_reflectance" value="1, 0.75, 0.25"/>' in text

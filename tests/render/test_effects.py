"""Effects that a scene lacks are not computed: their code is not reached, and kernels are shorter."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from helpers import fields, scenes
from helpers.scenes import nrf

from mi_ntf.core import field_file, fresnel, microfacet
from mi_ntf.infer import march, shade
from mi_ntf.infer.visibility import raymarch
from mi_ntf.render.maps import building
from mi_ntf.render.scene.media import find_media
from mi_ntf.render.transport import camera_light, composition, effects, walk

COARSE = {"resolution": 96}
EYE = [scenes.SIMILARITY.center[0] + 1.2, scenes.SIMILARITY.center[1] + 1.5, scenes.SIMILARITY.center[2] + 5]
"""The pinhole of `scenes.scene`."""


def lamp(position=EYE, intensity=60.0):
    return {"light": {"type": "point", "position": list(position), "intensity": intensity}}


def floor():
    to_world = mi.ScalarTransform4f().translate([0, -1.5, 0]).rotate([1, 0, 0], -90).scale(6)
    return {"floor": {"type": "rectangle", "to_world": to_world}}


def forbid(monkeypatch, owner, name):
    """Make `owner.name` raise when it is called."""

    def called(*_, **__):
        raise AssertionError(f"{name} was called")

    monkeypatch.setattr(owner, name, called)


def described(scene) -> effects.Effects:
    return composition.Composition(scene, scene.integrator().context.settings, scene.sensors()[0], 4).effects


def operations(scene) -> int:
    """Return the number of arithmetic operations in all kernels of one render."""
    scenes.render(scene, 0)  # field, maps
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        scenes.render(scene, 1)
        history = dr.kernel_history((dr.KernelType.JIT,))
    return sum(entry["operation_count"] for entry in history)


def test_light_at_the_camera_needs_no_visibility(blobs, monkeypatch):
    """The picture agrees with the march towards the light, and nothing is built."""
    scene = scenes.scene(blobs, nrf(samples=768), lamp(), size=24, spp=64)
    with monkeypatch.context() as general:
        general.setattr(effects, "_at_camera", lambda *_: False)
        marched, count = scenes.render(scene), operations(scene)
    forbid(monkeypatch, building, "build")
    forbid(monkeypatch, raymarch, "optical_depth")
    reused = scenes.render(scene)
    assert described(scene).collocated and "not needed" in described(scene).reason
    assert np.abs(reused - marched)[..., :3].mean() < 0.01 * marched[..., :3].mean()  # the two marches' steps
    assert reused[..., :3].mean() == pytest.approx(marched[..., :3].mean(), rel=3e-3)
    assert operations(scene) < count


def test_light_beside_the_camera_is_not_at_it(blobs):
    """A millionth of the distance counts as at the camera, a hundredth does not."""
    near, beside = (lamp([EYE[0] + shift, *EYE[1:]]) for shift in (5e-6, 5e-2))
    assert described(scenes.scene(blobs, nrf(), near, size=8)).collocated
    assert not described(scenes.scene(blobs, nrf(), beside, size=8)).collocated
    both = lamp() | {"sky": {"type": "constant"}}
    assert not described(scenes.scene(blobs, nrf(environment_lights=2), both, size=8)).collocated
    assert not described(scenes.scene(blobs, nrf(light_samples=1), lamp(), size=8)).collocated


def test_no_shapes_no_rays(blobs, monkeypatch):
    alone = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=16, spp=4)
    furnished = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=16, spp=4, shapes=floor())
    assert described(furnished).surfaces and operations(alone) < operations(furnished)
    forbid(monkeypatch, composition, "Surfaces")
    forbid(monkeypatch, camera_light, "Walk")
    assert np.isfinite(scenes.render(alone)).all() and not described(alone).surfaces
    with pytest.raises(Exception, match="Surfaces was called") as caught:
        furnished.integrator().render(furnished)
    assert "Surfaces was called" in str(caught.value)


def test_diffuse_field_has_no_specular_lobe(tmp_path, monkeypatch):
    """A lobe of 1/1000 is left out: the image stays, and the kernel is shorter."""
    path = scenes.write_blobs(tmp_path, log_density=3.0, specular=1e-3, roughness=0.9)
    scene = scenes.scene(path, nrf(), {"light": scenes.light("point")}, size=24, spp=16, medium=COARSE)
    with monkeypatch.context() as general:
        general.setattr(effects, "MIN_GLOSS", 0.0)
        with_lobe, count = scenes.render(scene), operations(scene)
        assert described(scene).specular
    assert not described(scene).specular
    for name in ("scattering", "lobes", "ggx"):
        forbid(monkeypatch, microfacet, name)
    without = scenes.render(scene)
    np.testing.assert_allclose(without, with_lobe, rtol=0.01, atol=2e-3)
    assert operations(scene) < count


def test_fresnel_effect_is_that_of_fields_trained_with_it(tmp_path, monkeypatch):
    """Other fields do not evaluate it, however rough they are."""
    paths = (scenes.write_blobs(tmp_path / str(rim), log_density=3.0, specular=0.041 if rim else 1e-3, roughness=0.99,
                                fresnel=rim) for rim in (False, True))
    faint, scene = (scenes.scene(p, nrf(), {"light": scenes.light("point")}, size=24, spp=16, medium=COARSE)
                    for p in paths)
    assert not described(faint).specular and not described(faint).fresnel
    assert described(scene).specular and described(scene).fresnel
    with monkeypatch.context() as before:
        forbid(before, fresnel, "_rim")
        scenes.render(faint)
        with pytest.raises(Exception, match="_rim was called") as caught:
            scene.integrator().render(scene)
        assert "_rim was called" in str(caught.value)


def test_gloss_is_the_highest_lobe_in_matter(tmp_path):
    path = scenes.write_blobs(tmp_path, specular=0.3, roughness=0.5)
    scene = scenes.scene(path, nrf(), {})
    (medium,) = find_media(scene)
    assert medium.field.grid.gloss == pytest.approx(0.3 / (4 * 0.5**4), rel=1e-3)


@pytest.mark.parametrize("visibility_name", ["raymarch", "transmittance_map"])
def test_dark_lights_light_nothing(blobs, monkeypatch, visibility_name):
    """A light of zero power gives opacity only, without map and shading."""
    forbid(monkeypatch, building, "build")
    forbid(monkeypatch, shade, "reflect")
    image = scenes.render(scenes.scene(blobs, nrf(visibility_name), lamp(intensity=0.0), size=16))
    assert (image[..., :3] == 0).all() and image[..., 3].max() > 0.99


def test_empty_field_is_not_marched(tmp_path, monkeypatch):
    path = tmp_path / "empty.safetensors"
    header, tensors = fields.empty()
    field_file.save(path, header, tensors, np.float32)
    forbid(monkeypatch, march, "camera_samples")
    forbid(monkeypatch, building, "build")
    ball = {"type": "sphere", "bsdf": {"type": "null"}, "interior": {"type": "nrf", "filename": str(path)}}
    scene = scenes.scene(None, nrf(), lamp(), size=8, shapes={"ball": ball})
    assert (scenes.render(scene) == 0).all()


def test_field_outside_the_view_is_not_marched(blobs, monkeypatch):
    """Fields beside and behind the camera are outside; a field at the border is in view."""
    scene = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=8, spp=4)
    parameters = mi.traverse(scene)
    centre = list(scenes.SIMILARITY.center)
    in_view = {}
    for name, target in {"ahead": centre, "border": [3.1, 0, 0], "beside": [7, 0, 0], "behind": [2, 3, 11]}.items():
        parameters["sensor.to_world"] = mi.Transform4f().look_at(EYE, target, [0, 1, 0])
        parameters.update()
        in_view[name] = described(scene).in_view[0]
    assert in_view == {"ahead": True, "border": True, "beside": False, "behind": False}
    forbid(monkeypatch, march, "camera_samples")
    assert (scenes.render(scene) == 0).all()


def test_single_scattering_walks_nowhere(blobs, monkeypatch):
    scene = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=16, spp=4, shapes=floor())
    deep = scenes.scene(blobs, nrf(max_depth=3), {"light": scenes.light("point")}, size=16, spp=4, shapes=floor())
    assert described(deep).bounces and not described(scene).bounces
    assert operations(scene) < operations(deep)
    # No light of this scene can be hit: not even BSDF samples are drawn.
    forbid(monkeypatch, walk.Walk, "run")
    forbid(monkeypatch, march, "free_flight")
    assert np.isfinite(scenes.render(scene)).all()


def test_gradients_are_noticed(blobs):
    scene = scenes.scene(blobs, nrf(), {"light": scenes.light("point")}, size=8)
    assert not described(scene).gradients
    parameters = mi.traverse(scene)
    dr.enable_grad(parameters["light.intensity.value"])
    parameters.update()
    assert described(scene).gradients

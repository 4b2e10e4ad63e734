"""Training of smoke: shading by a phase function, and a ball of known smoke."""

import dataclasses
import json

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import shots, two_spheres  # noqa: E402

from mi_ntf.core import field_file, henyey_greenstein  # noqa: E402
from mi_ntf.core import ops as numpy_ops  # noqa: E402
from mi_ntf.core.errors import MiNtfError  # noqa: E402
from mi_ntf.data import schema  # noqa: E402
from mi_ntf.train import config, networks, train, volume  # noqa: E402
from mi_ntf.train.optical import Optical  # noqa: E402
from mi_ntf.train.transmittance_targets import TransmittanceTargets  # noqa: E402

RADIUS, SIGMA, ALBEDO, POWER = 0.6, 2.5, (0.8, 0.5, 0.25), 30.0


def smoke(n: int, seed: int = 0) -> networks.Reflectance:
    """Return smoke of random albedo, float64, whose albedo has gradients."""
    albedo = torch.rand(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).requires_grad_()
    zero = torch.zeros(n, dtype=torch.float64)
    return networks.Reflectance(torch.zeros(n, 3, dtype=torch.float64), albedo, zero + 1, zero[:, None])


def unit(n: int, seed: int) -> torch.Tensor:
    """Return `n` random directions, float64."""
    v = torch.randn(n, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return v / v.norm(dim=1, keepdim=True)


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.8])
def test_smoke_sends_light_back_by_its_phase_function(g):
    """The radiance is albedo p(−1) I/d², and its derivative by the albedo is the rest."""
    matter, t, light = smoke(40), torch.rand(40, dtype=torch.float64) + 1, torch.rand(40, 3, dtype=torch.float64)
    actual = volume.shade(matter, unit(40, 1), t, light, False, g)
    factor = henyey_greenstein.phase(numpy_ops, g, -1.0) * light.numpy() / t.numpy()[:, None] ** 2
    np.testing.assert_allclose(actual.detach().numpy(), matter.albedo.detach().numpy() * factor, rtol=1e-12)
    actual.sum().backward()
    np.testing.assert_allclose(matter.albedo.grad.numpy(), factor, rtol=1e-12)


@pytest.mark.parametrize("g", [-0.5, 0.0, 0.8])
def test_a_light_beside_the_lens_is_scattered_by_the_actual_angle(g):
    """A cell of optical depth D behind F sends e^−F (1 − e^−D) albedo p(cos) I/d², with forward light at cos = 1.

    No density throws shadows yet, so all light arrives.
    """
    n, place = 60, torch.tensor([[0.5, -1.0, 2.0]], dtype=torch.float64)
    x, d, matter = 0.3 * unit(n, 2), unit(n, 3), smoke(n)
    depth, front = torch.rand(n, dtype=torch.float64), 2 * torch.rand(n, dtype=torch.float64)
    lamp = shots.flash(place, TransmittanceTargets(), solid=False)
    actual = lamp.send(Optical(depth, front), matter, d, x, torch.zeros(n).long(), torch.full((n, 3), 5.0), False, g)
    toward = (place - x).numpy()
    distance = np.linalg.norm(toward, axis=1)
    cos = (toward * d.numpy()).sum(1) / distance
    weight = np.exp(-front.numpy()) * (1 - np.exp(-depth.numpy()))
    expected = (weight * henyey_greenstein.phase(numpy_ops, g, cos) * 5 / distance**2)[:, None]
    np.testing.assert_allclose(actual.detach().numpy(), expected * matter.albedo.detach().numpy(), rtol=1e-6)
    actual.sum().backward()
    np.testing.assert_allclose(matter.albedo.grad.numpy(), np.tile(expected, 3), rtol=1e-6)


def photograph(c2w: np.ndarray, focal: float, size: int) -> np.ndarray:
    """Return RGBA (size, size, 4) of a ball with σ = SIGMA (1 − r²/RADIUS²) under the flash, by 200 steps a ray."""
    o, d = schema.pixel_rays(c2w, focal, size, size)
    near, step = two_spheres.DISTANCE - RADIUS, 2 * RADIUS / 200
    color, clear = np.zeros((size, size)), np.ones((size, size))
    for k in range(200):
        t = near + (k + 0.5) * step
        x = o + t * d
        depth = SIGMA * np.clip(1 - (x * x).sum(-1) / RADIUS**2, 0, None) * step
        color += clear**2 * (1 - np.exp(-2 * depth)) / 2 * POWER / t**2
        clear = clear * np.exp(-depth)
    return np.dstack([*(color * a / (4 * np.pi) for a in ALBEDO), 1 - clear])


def write(folder, size: int = 24) -> None:
    """Write a data set of the ball."""
    rng = np.random.default_rng(7)
    for split, count in {"train": 16, "val": 1, "test": 1}.items():
        frames = []
        (folder / split).mkdir(parents=True)
        for k, place in enumerate(rng.normal(size=(count, 3))):
            c2w = two_spheres.camera(place / np.linalg.norm(place))
            image = photograph(c2w, size / 2 / np.tan(0.31), size)
            schema.write_exr(folder / split / f"{k}.exr", image.astype(np.float32))
            frames.append({"file_path": f"{split}/{k}", "transform_matrix": c2w.tolist(),
                           "pl_pos": c2w[:3, 3].tolist(), "pl_intensity": [POWER] * 3})
        (folder / f"transforms_{split}.json").write_text(json.dumps({"camera_angle_x": 0.62, "frames": frames}))


def test_training_recovers_the_albedo_of_smoke(tmp_path, monkeypatch):
    """The albedo of a ball of smoke is within 5 % after 200 steps."""
    two_spheres.coarsen(monkeypatch)
    write(tmp_path / "ball")
    report = train(tmp_path / "ball", tmp_path / "f.safetensors", steps=200, smoke=0.0)
    header, tensors = field_file.load(tmp_path / "f.safetensors")
    assert header.architecture.phase == 0.0 and not header.architecture.fresnel
    nets = networks.from_tensors(header.architecture, tensors)
    center, radius = torch.tensor(header.similarity.center), header.similarity.radius
    x = 0.6 * RADIUS * unit(2000, 4).float()
    albedo = nets.reflectance((x - center) / radius).albedo.mean(0).detach().numpy()
    np.testing.assert_allclose(albedo, ALBEDO, rtol=0.05)
    assert report["val"]["srgb"] > 33, report  # 37 dB were measured


def test_what_smoke_cannot_be_is_told(tmp_path):
    with pytest.raises(MiNtfError, match="--asymmetry is 1; expected a number between -1 and 1"):
        config.configured("fast", smoke=1.0)
    assert config.configured("paper", smoke=0.3).architecture.phase == 0.3
    write(tmp_path / "ball", 8)
    with pytest.raises(MiNtfError, match="reads the shading of surfaces"):
        train(tmp_path / "ball", tmp_path / "f.safetensors", steps=1, smoke=0.0, estimate=True)


def test_a_finished_field_keeps_its_phase_function(tmp_path):
    from mi_ntf.train.finished import FinishedField

    finished = FinishedField(tmp_path / "f", field_file.Header(dataclasses.replace(config.FAST, phase=0.5)), {}, True)
    assert finished.configured(config.configured("fast"), None).architecture.phase == 0.5
    with pytest.raises(MiNtfError, match=r"was trained as smoke of the asymmetry 0\.5, and --continue"):
        finished.configured(config.configured("fast", smoke=0.0), None)

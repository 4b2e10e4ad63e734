"""LPIPS with a stand-in for its package, and where package or weights are missing."""

import sys
import types

import numpy as np
import pytest

from mi_ntf.evaluate import metrics, perceptual
from mi_ntf.evaluate.compare import compare_arrays, print_table

torch = pytest.importorskip("torch", reason="pip install 'mi-ntf[train]'")


class Stand(torch.nn.Module):
    """Called as the package's class. Its distance: weight · |a − b| + bias, mean of channels, of images in [−1, 1]."""

    def __init__(self, net, pnet_rand, verbose):
        super().__init__()
        assert (net, pnet_rand, verbose) == ("alex", True, False)  # anything else may download
        self.net = torch.nn.Module()
        self.net.slice2 = torch.nn.Sequential()
        self.net.slice2.add_module("3", torch.nn.Conv2d(1, 1, 1))
        self.spatial = False

    def forward(self, a, b, normalize):
        assert normalize and a.shape == b.shape and a.shape[:2] == (1, 3)
        each = self.net.slice2((2 * a - 2 * b).abs().mean(1, keepdim=True))
        return each if self.spatial else each.mean((2, 3), keepdim=True)


@pytest.fixture(autouse=True)
def fresh(monkeypatch, tmp_path):
    """No network remembered, PyTorch's downloads in an empty folder, and the stand-in."""
    perceptual._network.cache_clear()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setitem(sys.modules, "lpips", types.SimpleNamespace(LPIPS=Stand))
    yield
    perceptual._network.cache_clear()


@pytest.fixture
def weights(tmp_path):
    """A file of weights as torchvision's, with further layers that LPIPS does not use."""
    file = tmp_path / "hub" / "checkpoints" / perceptual.BACKBONE
    file.parent.mkdir(parents=True)
    torch.save({"features.3.weight": torch.full((1, 1, 1, 1), 3.0), "features.3.bias": torch.tensor([0.5]),
                "classifier.1.bias": torch.zeros(4)}, file)
    return file


def test_it_is_measured_on_encoded_images_with_the_weights_of_the_file(weights, rng):
    a, b = rng.uniform(-0.2, 1.5, (2, 32, 40, 3))
    difference = 2 * np.abs(metrics.srgb(a) - metrics.srgb(b)).mean(-1)
    assert perceptual.lpips(a, b) == pytest.approx(3 * difference.mean() + 0.5, rel=1e-5)
    mask = np.zeros((32, 40), bool)
    mask[3:9, 5:30] = True
    assert perceptual.lpips(a, b, mask) == pytest.approx(3 * difference[mask].mean() + 0.5, rel=1e-5)
    assert perceptual.lpips(a, b) == pytest.approx(3 * difference.mean() + 0.5, rel=1e-5)  # the mask is forgotten
    assert compare_arrays(a, b, mask, lpips=True)["masked"]["lpips"] == perceptual.lpips(a, b, mask)


def _absent(capsys, rng) -> tuple[dict, str]:
    """Check the reason why LPIPS was not measured, and the printed table with all other metrics."""
    truth = rng.uniform(size=(32, 32, 3))
    result = compare_arrays(truth / 2, truth, lpips=True)
    assert result["lpips"] is result["aligned"]["lpips"] is None and result["relative_rmse"] == pytest.approx(0.5)
    print_table(result)
    return result["not_measured"]["lpips"], capsys.readouterr().out


def test_without_the_package(monkeypatch, capsys, rng):
    monkeypatch.setitem(sys.modules, "lpips", None)
    why, text = _absent(capsys, rng)
    assert why["reason"] == "package lpips is missing" and "pip install" in why["remedy"] and "[lpips]" in why["remedy"]
    assert "not measured:" in text and f"to measure LPIPS: {why['remedy']}\n" in text


def test_without_the_weights_nothing_is_downloaded(tmp_path, capsys, rng):
    why, _ = _absent(capsys, rng)
    assert why["reason"] == "the weights of AlexNet are missing"
    assert why["remedy"].endswith(f"{perceptual.BACKBONE} into {tmp_path / 'hub' / 'checkpoints'}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"not weights", None], ids=["damaged", "of another network"])
def test_weights_that_do_not_fit(weights, content, capsys, rng):
    if content is None:
        torch.save({"layer1.weight": torch.zeros(3)}, weights)
    else:
        weights.write_bytes(content)
    why, _ = _absent(capsys, rng)
    assert why["reason"].startswith(f"{weights} does not hold the weights of AlexNet (")


def test_a_torchvision_of_another_pytorch(monkeypatch, tmp_path, capsys, rng):
    monkeypatch.delitem(sys.modules, "lpips")
    (tmp_path / "lpips.py").write_text("raise RuntimeError('operator torchvision::nms does not exist')")
    monkeypatch.syspath_prepend(tmp_path)
    why, _ = _absent(capsys, rng)
    assert why["reason"] == "package lpips does not load (operator torchvision::nms does not exist)"
    assert why["remedy"] == "install the torchvision that belongs to the installed PyTorch"


def test_small_pictures(weights):
    with pytest.raises(metrics.NotMeasured, match="needs 31×31 pixels, the image has 40×30"):
        perceptual.lpips(np.ones((30, 40, 3)), np.ones((30, 40, 3)))
    assert perceptual.lpips(np.ones((31, 31, 3)), np.ones((31, 31, 3))) == pytest.approx(0.5)

"""A shipped field beside photographs of its meshes."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.variants import VARIANT

import mi_ntf.render
from benchmarks import photographs
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data.capture import capture
from mi_ntf.data.readers import load_dataset

STATUE = Path(__file__).parents[2] / "scenes/statue"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("photographs")
    capture(STATUE / "mesh.xml", folder, views=3, size=48, test_views=2, spp=32, seed=0)
    return folder


@pytest.mark.slow
def test_statue(dataset):
    """Cameras, light and normals agree: mirrored or turned views would lie below 20 dB and above 40°."""
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    found = photographs.study(STATUE / "field.safetensors", dataset, STATUE / "mesh.xml", spp=16)
    assert found["psnr"] > 29 and found["ssim"] > 0.9 and found["normal_error"] < 10


def test_cameras_that_mitsuba_has_not(dataset):
    split = load_dataset(dataset, lambda note: None)["test"]
    split.principal[0] += 3
    with pytest.raises(MiNtfError, match=r"view 0: .* expected square pixels and a centred camera"):
        photographs.sensor(split, 0)


def test_angles_of_vectors():
    a = np.array([[[1.0, 0, 0], [0, 0, 0.2], [0, 1, 0]]])
    b = np.array([[[0, 2.0, 0], [0, 0, 1], [0, 1, 0]]])
    np.testing.assert_allclose(photographs._angles(a, b), [[90, np.nan, 0]], atol=1e-6)

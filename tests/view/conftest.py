"""A small scene as a file, with lights of four kinds, seen in 32² pixels."""

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes, viewed
from helpers.variants import VARIANT

import mi_ntf.render


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant(VARIANT)
    mi_ntf.render.register()
    return mi


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Folder with a field and two skies."""
    mi.set_variant(VARIANT)
    where = scenes.write_blobs(tmp_path_factory.mktemp("view") / "scene", log_density=3.0).parent
    v, u = np.mgrid[:8, :16] / 8
    for name, ahead in (("sky", 0.65), ("other", 1.4)):
        sky = 0.6 + 0.5 * np.cos(np.pi * (u - ahead)) * np.sin(np.pi * v) + 0.3 * np.cos(np.pi * v)
        mi.Bitmap((sky[..., None] * [1.0, 0.9, 0.8]).astype(np.float32)).write(str(where / f"{name}.exr"))
    return where


@pytest.fixture
def scene(folder):
    def write(*lights, name="scene.xml"):
        path = folder / name
        path.write_text(viewed.SCENE.format(lights="\n    ".join(lights)))
        return path

    return write

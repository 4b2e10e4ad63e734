"""Fields that photographs refine, from the command to the file."""

import json

import mitsuba as mi
import numpy as np
import pytest
from helpers import scenes
from refine import shots

import mi_ntf
from mi_ntf.cli import main
from mi_ntf.core import field_file, progress
from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import schema
from mi_ntf.refine import refine
from mi_ntf.refine.gains import Gains
from mi_ntf.refine.photographs import Camera


@pytest.fixture(scope="module")
def case(tmp_path_factory):
    """Scene of the field with the wrong patch, photographs of the right one, and both fields."""
    from helpers.variants import VARIANT

    mi.set_variant(VARIANT)
    mi_ntf.register()
    folder = tmp_path_factory.mktemp("case")
    right = scenes.write_blobs(folder, log_density=4.0)
    subject = shots.subject(shots.write_scene(folder, right))
    photographs = shots.photograph(subject, folder / "photographs", {"train": 8, "val": 1, "test": 3})
    wrong = folder / "wrong.safetensors"
    shots.with_patch(subject, wrong)
    return shots.write_scene(folder, wrong), photographs, right, wrong


def test_a_patch_is_found_again(case, tmp_path):
    """An albedo that is 20 % too dark in a half of the object comes back, and the other half stays."""
    scene, photographs, right, wrong = case
    report = refine(scene, photographs, tmp_path / "out.safetensors", steps=30, gains=False)
    true, before, after = (shots.albedo(f, photographs).mean(1) for f in (right, wrong, tmp_path / "out.safetensors"))
    patch, rest = before / true < 0.81, before / true > 0.999
    assert after[patch].sum() / true[patch].sum() == pytest.approx(1, abs=0.03)
    assert after[rest].sum() / true[rest].sum() == pytest.approx(1, abs=0.03)
    assert report.kept and report.after < 0.5 * report.before
    header, _ = field_file.load(tmp_path / "out.safetensors")
    assert header.provenance["refined"]["steps"] == 30
    page = (tmp_path / "out.html").read_text()
    assert "closer to the photographs" in page
    assert {p.suffix for p in tmp_path.iterdir()} == {".safetensors", ".html"}

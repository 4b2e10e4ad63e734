"""Runs in processes of their own: killed and taken up again, and two together under torchrun."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="training needs PyTorch: pip install 'mi-ntf[train]'")

from train import two_spheres  # noqa: E402

PROGRAM = Path(__file__).with_name("program.py")
STEPS = 20
"""The transmittance network joins at step 8, the field is finished at step 17."""


@pytest.fixture(scope="module")
def photographs(tmp_path_factory):
    return two_spheres.write(tmp_path_factory.mktemp("spheres"), {"train": 12, "val": 1, "test": 1}, size=24)


def execute(photographs, out, death="", launcher=(), code=0):
    command = [sys.executable, *launcher, str(PROGRAM), str(photographs), str(out), str(STEPS)] + [death] * bool(death)
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == code, done.stderr
    return done.stderr


def result(out):
    with np.load(f"{out}.npz") as tensors:
        return json.loads(Path(f"{out}.json").read_text()), dict(tensors)


@pytest.fixture(scope="module")
def undisturbed(photographs, tmp_path_factory):
    out = tmp_path_factory.mktemp("undisturbed") / "f"
    execute(photographs, out)
    return result(out)


@pytest.mark.slow  # tests/hard_cases/test_kill.py kills at chance moments
def test_a_run_killed_twice_ends_where_an_undisturbed_one_ends(photographs, undisturbed, tmp_path):
    """Bit for bit: same tensors, same validations, same losses after each start."""
    out = tmp_path / "f"
    execute(photographs, out, "step 10", code=-signal.SIGKILL)
    assert {p.name for p in tmp_path.iterdir()} == {"f.ckpt"}
    execute(photographs, out, "write 2", code=-signal.SIGKILL)  # after the first write at step 12, in that at step 16
    partial, checkpoint = sorted((p.name for p in tmp_path.iterdir()), key=len, reverse=True)
    assert checkpoint == "f.ckpt" and partial.startswith("f.ckpt.") and partial.endswith(".part")
    execute(photographs, out)
    (expected, tensors), (actual, values) = undisturbed, result(out)
    assert list(actual["losses"]) == [str(i) for i in range(12, STEPS)], "one interval of 4 steps was lost, no more"
    assert all(expected["losses"][k] == v for k, v in actual["losses"].items())
    assert actual["history"] == expected["history"]
    for name, value in tensors.items():
        assert value.tobytes() == values[name].tobytes(), name
    assert {p.name for p in tmp_path.iterdir()} == {"f", "f.html", "f.npz", "f.json"}


@pytest.mark.slow
def test_two_processes_are_one(photographs, undisturbed, tmp_path):
    """torchrun with two processes: the losses of one process with the same seed.

    Only the order of sums differs, which is float32 rounding: 1e-7 of a loss was measured in these steps, 6e-7 in 120.
    Where a gradient is nothing but rounding, Adam makes a whole step of its sign: single texels that no loss depends
    on may differ by a learning rate, so tensors are compared in the mean square. The tolerances leave room for growth.
    """
    out = tmp_path / "f"
    launcher = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2")
    text = execute(photographs, out, launcher=launcher)
    assert text.count("step 18: the field is finished") == 1, "one process prints"
    (expected, tensors), (actual, values) = undisturbed, result(out)
    relative = {k: abs(actual["losses"][k] / v - 1) for k, v in expected["losses"].items()}
    assert len(relative) == STEPS and max(relative.values()) < 1e-5, relative
    for name, value in tensors.items():  # of order 1
        assert np.sqrt(np.mean((values[name] - value) ** 2)) < 1e-4, name
    assert {p.name for p in tmp_path.iterdir()} == {"f", "f.html", "f.npz", "f.json"}

"""A training run as a program of its own, which writes what tests compare: losses of every step and final tensors.

    program.py DATASET OUT STEPS [DEATH]

DEATH is `step N` (dies before that step) or `write N` (dies inside the N-th write of a checkpoint), by SIGKILL.
"""

import functools
import json
import os
import signal
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1]))

from train import two_spheres

from mi_ntf.train import fast, networks, parallel, train, trainer

trainer.KEEP, trainer.INTERVAL = 4, 0.0


def main(dataset: str, out: str, steps: str, death: str = "") -> None:
    losses, writes = {}, []
    advance, finish, replace = fast.Fast.advance, trainer.finish, os.replace

    def die_if(event: str) -> None:
        if event == death:
            os.kill(os.getpid(), signal.SIGKILL)

    def recorded(recipe):
        step = recipe.clock.step
        die_if(f"step {step}")
        losses[step] = advance(recipe)
        return losses[step]

    def replaced(source, target):
        writes.append(target)
        die_if(f"write {len(writes)}")
        replace(source, target)

    def finished(run, recipe, record, *rest):
        np.savez(f"{out}.npz", **networks.to_tensors(recipe.networks))
        Path(f"{out}.json").write_text(json.dumps({"losses": losses, "history": record.history}))
        return finish(run, recipe, record, *rest)

    fast.Fast.advance, trainer.finish, os.replace = recorded, finished, replaced
    fast.Fast.carve = functools.partialmethod(fast.Fast.carve, steps=20)
    two_spheres.coarsen(pytest.MonkeyPatch())
    two_spheres.glance(pytest.MonkeyPatch())
    report = train(Path(dataset), Path(out), steps=int(steps))
    assert bool(report) == (parallel.first() and os.environ.get("RANK", "0") == "0")


if __name__ == "__main__":
    main(*sys.argv[1:])

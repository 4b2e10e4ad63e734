"""Course of a run: validations, losses, faults and the best field so far. It is part of checkpoints."""

from dataclasses import dataclass, field
from typing import TypedDict

from .monitor import Validation
from .recipe import Snapshot

VALIDATED = 1 << 17
"""Pixels of a validation during the run, at most."""


class FaultEntry(TypedDict):
    """Entry of the list of faults."""

    step: int
    reason: str


class Best(TypedDict):
    """The field of the best validation so far."""

    psnr: float
    entry: Validation
    snapshot: Snapshot


@dataclass
class Record:
    """Course of a run; part of checkpoints."""

    history: list[Validation] = field(default_factory=list)
    trace: list[tuple[int, float]] = field(default_factory=list)
    """Steps and running means of the loss, a hundred in a run."""
    faults: list[FaultEntry] = field(default_factory=list)
    validated: float = 0.0  # Progress at the last validation
    pixels: int = VALIDATED  # Pixels of a validation
    best: Best | None = None
    chosen: Validation | None = None
    """Validation of the finished field; None before."""

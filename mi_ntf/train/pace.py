"""Speed of a run, from which the time for its scores and its page is reserved.

The speed is measured whenever photographs are rendered. Where the time that is left does not allow for all pixels of
the scores and the page, a fraction of them is rendered.
"""

import math
import time

from . import parallel, report, scoring
from .networks import Networks
from .rays import Photographs
from .recipe import Clock
from .record import VALIDATED
from .scoring import FieldView, Scores
from .training_data import TrainingData

PROBED = 1 << 12
"""Pixels from which the speed is first measured; a validation has no fewer."""
VALIDATION_TIME = 0.01
"""Fraction of the minutes that one of the ten validations may take."""
FINISH_TIME = 0.09
"""Fraction of the minutes that scores and page may take if not all of their pixels fit."""
LEAST = 1 / 16
"""Least fraction of these pixels: pictures are a quarter as wide."""


class Pace:
    """Speed of a run on the photographs `data` with the limit of `clock`."""

    def __init__(self, clock: Clock, data: TrainingData):
        self.clock, self.data = clock, data
        self.speed = math.inf  # Pixels a second that were rendered last
        self.fixed = 0.0  # Seconds that the finish takes besides pixels
        if clock.timed:
            clock.reserve = 60 * FINISH_TIME * clock.minutes

    def score(self, field: FieldView, pool: Photographs, most: float, views: int, passes: int) -> Scores:
        """Compare `field` with photographs, see :func:`mi_ntf.train.scoring.score`, and measure the speed."""
        start = time.monotonic()
        scores = scoring.score(field, pool, most, views, passes)
        self.speed = passes * min(most, views * pool.height * pool.width) / max(time.monotonic() - start, 1e-6)
        return scores

    def rehearse(self, networks: Networks, field: FieldView, pool: Photographs, views: int) -> int:
        """Measure the speed before the first validation of a run in minutes, and return the pixels of a validation."""
        if not self.clock.timed:
            return VALIDATED
        start = time.monotonic()
        scoring.occupied(networks)
        # Baked densities take about as long again, and so do the diagrams of the page.
        self.fixed = 3 * (time.monotonic() - start)
        self.score(field, pool, PROBED, views, 1)
        pixels = int(parallel.agreed(self.speed * 60 * self.clock.minutes * VALIDATION_TIME))
        return min(max(pixels, PROBED), VALIDATED)

    def reserve(self) -> None:
        """Reserve the time for all pixels of the scores and the page, or for as many as FINISH_TIME allows."""
        if not self.clock.timed:
            return
        minutes = self.clock.minutes
        whole = (report.scored_pixels(self.data) + report.page_pixels(self.data)) / self.speed
        fitting = 60 * FINISH_TIME * minutes - self.fixed
        seconds = self.fixed + min(max(fitting, LEAST * whole), whole)
        self.clock.reserve = parallel.agreed(min(seconds, 30 * minutes))

    def detail(self, pixels: float, fixed: float) -> float:
        """Return the fraction of `pixels` that there is time for besides `fixed` seconds, LEAST to 1."""
        if not self.clock.timed:
            return 1.0
        return min(max((self.clock.left - fixed) * self.speed / pixels, LEAST), 1.0)

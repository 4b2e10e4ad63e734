"""Which point to measure next: points are tried where the Pareto front of seconds and error is unknown, not on a grid.

Each method begins with the scene's own dials, cheap methods first, dear ones by turns with the rest. The rest are
neighbours of what is measured, coarse steps first, each with the samples a pixel of its neighbour and with more. For
each there is a hope: the seconds predicted for it and the least error that one may expect of it. Its worth is the area
that the hope would add to what the front dominates, on log axes, for each second that measuring it takes. A candidate
whose hope adds nothing is not tried; when none is left, half steps are; then, with what is left of the budget, curves
of methods off the front are drawn further.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

from ...infer.visibility import REGISTRY
from .measure import CHEAP, REPEATS
from .points import DIALS, STOCK, Limits, Point, dials, neighbours

MORE = (1, 4, 16)
"""Times the samples a pixel that another turn of a dial is tried with."""
LEAST_GAIN = 0.01
"""Area on log axes, in decades squared, below which a hope is not worth a measurement."""
WORST = 0.2
"""Error from which on none is told from another: such pictures are of no use."""
DEAR = 1 / 20
"""Of the budget: a method whose first point takes more begins with drawn lights."""
FIRST_SHARE = 1 / 20
"""Of the budget: methods whose first point takes more have their turn after each point of another kind."""
START_SHARE = 1 / 40
"""Of the budget, that the renderings of a method's first point may take: it has fewer samples a pixel otherwise."""


@dataclass(frozen=True)
class Result:
    """What is known of a measured point. Seconds: `build`, `render`; relative `noise` and `bias` of a picture;
    `failed`: nothing is known but that it did not work."""

    build: float = 0.0
    render: float = 0.0
    noise: float = 1.0
    bias: float = 1.0
    failed: bool = False

    @property
    def seconds(self) -> float:
        return self.build + self.render

    @property
    def error(self) -> float:
        return math.hypot(self.noise, self.bias)


@dataclass(frozen=True)
class Proposal:
    """A point to measure. `seconds`: predicted for one picture; `cost`: for its whole measurement; `why`: for the
    reader."""

    point: Point
    seconds: float
    cost: float
    why: str


def front(results: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Those of ``(seconds, error)`` pairs that no other is at least as good as in both and better in one; by
    seconds."""
    best: list[tuple[float, float]] = []
    for seconds, error in sorted(set(results)):
        if not best or error < best[-1][1]:
            best.append((seconds, error))
    return best


def area(results: Iterable[tuple[float, float]], horizon: float) -> float:
    """Decades squared that the front of ``(seconds, error)`` pairs dominates, up to `horizon` seconds and `WORST`."""
    total, ends = 0.0, front((t, e) for t, e in results if t < horizon and e < WORST)
    for i, (seconds, error) in enumerate(ends):
        above = ends[i - 1][1] if i else WORST
        total += (math.log10(above) - math.log10(error)) * (math.log10(horizon) - math.log10(seconds))
    return total


class Search:
    """Proposes points and hears what came of them.

    base       the scene's own point, whose `method` is not read
    methods    names to try
    limits     of the dials
    predict    point → ``(build, render)`` seconds, up to a factor that is learnt; raises where it cannot be rendered
    budget     seconds of all measurements
    compile    seconds that a new kernel takes, about
    """

    def __init__(self, base: Point, methods: Iterable[str], limits: Limits,
                 predict: Callable[[Point], tuple[float, float]], budget: float, compile: float = 2.0):
        self.base, self.limits, self.budget, self._predict, self._compile = base, limits, budget, predict, compile
        self.results: dict[Point, Result] = {}
        self.skipped: dict[Point, Proposal] = {}
        self._methods = list(methods)
        self._known: dict[Point, tuple[float, float] | None] = {}
        self._failed: set[Point] = set()
        self._turn = 0
        self._scaled: dict[Point, tuple[float, float] | None] = {}

    def add(self, point: Point, result: Result) -> None:
        """What came of measuring `point`."""
        self.results[point] = result
        self._scaled.clear()
        if result.failed:
            self._failed.add(point.settings)

    def next(self, left: float) -> Proposal | None:
        """The point to measure next with `left` seconds of the budget; None if nothing is left to learn in time. What
        would take longer is remembered in `skipped`."""
        firsts = self._firsts()
        cheap = [p for p in firsts if p.cost <= FIRST_SHARE * self.budget]
        turn = [p for p in firsts if p.cost <= left][: self._turn]
        groups = (lambda: cheap, lambda: turn, lambda: self._hopes(False), lambda: firsts, lambda: self._hopes(True),
                  self._curves)
        for found in (group() for group in groups):
            for proposal in found:
                if proposal.cost <= left:
                    self.skipped.pop(proposal.point, None)
                    self._turn = 0 if found is turn else 1
                    return proposal
                self.skipped.setdefault(proposal.point, proposal)
        return None

    def left_out(self) -> list[Proposal]:
        """What was not measured for want of time: of each method the cheapest few."""
        found: list[Proposal] = []
        for proposal in sorted(self.skipped.values(), key=lambda p: p.cost):
            alike = sum(p.point.method == proposal.point.method for p in found)
            if proposal.point not in self.results and alike < 2:
                found.append(proposal)
        return found

    def _firsts(self) -> list[Proposal]:
        """Every method's first point, cheap ones first."""
        begun = {p.method for p in self.results}
        starts = [self._start(method) for method in self._methods if method not in begun]
        found = [self._proposal(p, "the method's default") for p in starts if self._seconds(p)]
        return sorted(found, key=lambda p: p.cost)

    def _start(self, method: str) -> Point:
        """The scene's own dials, with fewer samples a pixel where those would take too much of the budget, and with
        drawn lights where one sample still does."""
        point = replace(self.base, method=method)
        if method == STOCK:
            point = Point(STOCK, self.base.spp, self.base.max_depth)
        elif REGISTRY[method].drawn:
            point = replace(point, light_samples=0)
        found = self._fewer(point)
        if self._proposal(found, "").cost > DEAR * self.budget and "light_samples" in dials(point, self.limits):
            drawn = self._fewer(replace(point, light_samples=point.light_samples or DIALS["light_samples"].first))
            if self._proposal(drawn, "").cost < 0.5 * self._proposal(found, "").cost:
                return drawn
        return found

    def _fewer(self, point: Point) -> Point:
        """The same with so few samples a pixel as the budget asks for."""
        while point.spp > 1 and _renderings((self._seconds(point) or (0, 0))[1]) > START_SHARE * self.budget:
            point = replace(point, spp=max(1, point.spp // 4))
        return point

    def _hopes(self, fine: bool) -> list[Proposal]:
        """Neighbours of measured points that may lie on the front, by their worth a second."""
        good = {point: result for point, result in self.results.items() if not result.failed}
        known = front((r.seconds, r.error) for r in good.values())
        now = area(known, self.budget)
        found: dict[Point, tuple[float, Proposal]] = {}

        def consider(proposal: Proposal, error: float) -> None:
            gain = area([*known, (max(proposal.seconds, 1e-4), error)], self.budget) - now
            worth = gain / proposal.cost
            if gain > LEAST_GAIN and worth > found.get(proposal.point, (0.0, proposal))[0]:
                found[proposal.point] = (worth, proposal)

        for point, result in good.items():
            tried = self._tried(point)
            for other, dial, way in self._moves(point, fine):
                proposal = self._proposal(other, f"{dial} {getattr(point, dial)} → {getattr(other, dial)}")
                consider(proposal, hoped_error(point, result, other, dial, way, tried))
        return [proposal for _, proposal in sorted(found.values(), key=lambda pair: -pair[0])]

    def _moves(self, point: Point, fine: bool) -> list[tuple[Point, str, int]]:
        """Neighbours that may be measured, and those of another dial with more samples a pixel besides: a dial that
        makes pictures cheap shows what it is worth where samples are many."""
        found = []
        for other, dial, way in neighbours(point, self.limits, fine):
            more = (1,) if dial == "spp" else MORE
            found += [(replace(other, spp=other.spp * n), dial, way) for n in more]
        return [move for move in found if self._open(move[0])]

    def _tried(self, point: Point) -> int:
        """How many other settings of the method err by the same bias or more: so often was it hoped to be less."""
        bias = self.results[point].bias
        alike = {p.settings for p, r in self.results.items()
                 if p.method == point.method and not r.failed and r.bias >= 0.9 * bias}
        return len(alike) - 1

    def _curves(self) -> list[Proposal]:
        """More samples a pixel for methods whose curve is short, cheap ones first."""
        found = []
        for method in self._methods:
            own = [p for p in self.results if p.method == method and not self.results[p].failed]
            if own:
                last = max(own, key=lambda p: p.spp)
                more = replace(last, spp=4 * last.spp)
                if self._open(more) and len({p.spp for p in own}) < 4:
                    found.append(self._proposal(more, "to draw the method's curve"))
        return sorted(found, key=lambda p: p.cost)

    def _open(self, point: Point) -> bool:
        """Whether it may be measured: it was not, and its settings did not fail."""
        if point in self.results or point.spp < 1:
            return False
        return point.settings not in self._failed and self._seconds(point) is not None

    def _seconds(self, point: Point) -> tuple[float, float] | None:
        """(build, render) predicted, scaled by the nearest measured point of the method; None where there is none."""
        if point not in self._scaled:
            self._scaled[point] = self._scale(point)
        return self._scaled[point]

    def _scale(self, point: Point) -> tuple[float, float] | None:
        own = self._model(point)
        if own is None:
            return None
        alike = [p for p, r in self.results.items() if not r.failed and p.method == point.method]
        others = [p for p, r in self.results.items() if not r.failed and p.method != STOCK]
        if not (alike or others) or (point.method == STOCK and not alike):
            return own
        nearest = min(alike or others, key=lambda p: _distance(p, point))
        result, guess = self.results[nearest], self._model(nearest)
        assert guess is not None  # it was measured
        return own[0] * _ratio(result.build, guess[0]), own[1] * _ratio(result.render, guess[1])

    def _model(self, point: Point) -> tuple[float, float] | None:
        if point not in self._known:
            try:
                self._known[point] = self._predict(point)
            except (ValueError, RuntimeError):
                self._known[point] = None
        return self._known[point]

    def _proposal(self, point: Point, why: str) -> Proposal:
        build, render = self._seconds(point) or (0.0, 0.0)
        return Proposal(point, build + render, self._compile + _renderings(build + render), why)


def _renderings(seconds: float) -> float:
    """Seconds of all renderings that measure a point whose pictures take `seconds`."""
    return (1 + REPEATS if seconds < CHEAP else 2) * seconds


def hoped_error(point: Point, result: Result, other: Point, dial: str, way: int, tried: int = 0) -> float:
    """The least error to be expected of `other`, one step of `dial` away from `point`: more samples take away noise;
    dearer or other settings the dial's share of the bias, less where other settings of the method, `tried` of them,
    did not; cheaper ones nothing."""
    noise, bias = result.noise * math.sqrt(point.spp / other.spp), result.bias
    if dial == "spp":
        return math.hypot(noise, bias)
    if dial == "light_samples" and way > 0:
        return math.hypot(0.7 * noise, bias)
    relief = DIALS[dial].relief if dial in DIALS else 0.5
    return math.hypot(noise, bias * (1 - relief * 0.5**tried) if way >= 0 else bias)


def _distance(a: Point, b: Point) -> float:
    """How many dials differ; more samples a pixel are nearly the same."""
    names = ("max_depth", "samples", "light_samples", "environment_lights", "map_resolution", "map_source",
             "map_components", "representation")
    return sum(getattr(a, n) != getattr(b, n) for n in names) + 0.1 * abs(math.log2(a.spp / b.spp))


def _ratio(measured: float, guess: float) -> float:
    """Measured over guessed seconds, within a factor of 30."""
    return min(max(measured / guess, 1 / 30), 30.0) if guess > 1e-6 and measured > 0 else 1.0

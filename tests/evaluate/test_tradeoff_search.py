"""Which points `mi-ntf tradeoff` tries: on landscapes whose front is known."""

import itertools
import math
from dataclasses import replace

import pytest

from mi_ntf.evaluate.tradeoff import points, search
from mi_ntf.evaluate.tradeoff.points import STOCK, Limits, Point
from mi_ntf.evaluate.tradeoff.search import Result, Search
from mi_ntf.infer.visibility import REGISTRY

BASE = Point("auto", 16, max_depth=2)
LIMITS = Limits(depth=2, environment=True, texels=2048)
METHODS = ("raymarch", "transmittance_map", "transmittance_atlas", "none", STOCK)


def landscape(point: Point) -> Result:
    """Marches are right and dear, maps quick and off by their texels, the atlas off by 2 %, none by 20 %."""
    if point.method == STOCK:
        return Result(0.0, 0.05 * point.spp, 0.8 / math.sqrt(point.spp), 0.0)
    lights = point.light_samples or min(point.environment_lights, LIMITS.texels)
    light_noise = 0.3 / math.sqrt(point.light_samples) if point.light_samples else 0.0
    noise = math.hypot(0.2, light_noise) / math.sqrt(point.spp)
    steps = point.samples / 384
    cut = 0.0 if point.light_samples else 0.005 * 512 / point.environment_lights
    per_pair, build, own = {
        "raymarch": (1e-3 * steps, 0.0, 0.0),
        "transmittance_map": (5e-5, 1e-5 * lights * point.map_resolution**2 / 192, 0.04 * 192 / point.map_resolution),
        "transmittance_atlas": (1e-4, 2.0, 0.02),
        "none": (1e-6, 0.0, 0.2),
    }[point.method]
    slow = 10 if point.representation == "network" else 1
    source = 0.02 if point.map_source == "network" else 0.0
    bias = math.hypot(own, cut, 0.01 / steps, source)
    return Result(build, slow * point.spp * (0.002 * steps + per_pair * lights), noise, bias)


def guess(point: Point) -> tuple[float, float]:
    """The cost model: wrong by factors that hold for a method."""
    true = landscape(point)
    factor = {"raymarch": 0.4, "none": 3.0}.get(point.method, 1.5)
    return true.build * 2 * factor, true.render * factor


def study(budget: float, measure=landscape, methods=METHODS):
    """``(search, order, spent)`` of a whole study whose clock runs as measurements cost."""
    found = Search(BASE, methods, LIMITS, guess, budget, compile=0.2)
    order, spent = [], 0.0
    while (proposal := found.next(budget - spent)) is not None:
        result = measure(proposal.point)
        found.add(proposal.point, result)
        order.append(proposal.point)
        spent += 0.2 + result.build + (4 if result.render < 1 else 2) * result.render
    return found, order, spent


@pytest.fixture(scope="module")
def whole():
    """A study of 200 s: 59 points."""
    return study(200.0)


def grid() -> list[Point]:
    """Every combination of the dials' coarse steps."""
    spp, samples, lights = (1, 4, 16, 64, 256, 1024), (48, 96, 192, 384, 768), (0, 1, 4, 16, 64)
    cells, sides = (8, 32, 128, 512, 2048), (48, 96, 192, 384)
    found = []
    for n, s, k, e, m in itertools.product(spp, samples, lights, cells, sides):
        point = Point("raymarch", n, 2, s, k, 512 if k else e)
        found += [point, replace(point, method="none"), replace(point, method="transmittance_atlas")]
        if not k:
            found.append(replace(point, method="transmittance_map", map_resolution=m))
    return sorted(set(found), key=str)


def test_the_front_is_found_with_a_twentieth_of_the_grid(whole):
    budget, (found, order, _) = 200.0, whole
    known = [(r.seconds, r.error) for r in found.results.values()]
    everything = grid()
    true = [(r.seconds, r.error) for p in everything if (r := landscape(p)).seconds < budget / 4]
    assert search.area(known, budget) > 0.9 * search.area(true, budget)
    assert len(order) < 0.05 * len(everything) and len(order) == len(set(order))
    ends = search.front(known)
    for limit in (0.1, 0.05):  # nearly as fast as anything on the grid
        ours, best = (min(t for t, e in some if e < limit) for some in (ends, true))
        assert ours < 2 * best
    assert {p.method for p in order} == set(METHODS)


def test_the_budget_is_kept_and_what_does_not_fit_is_told():
    found, order, spent = study(20.0)
    assert spent < 24 and len(order) >= 4  # predictions are wrong by factors at first
    assert found.left_out() and all(p.point not in found.results and p.cost > 0 for p in found.left_out())


def test_cheap_methods_come_first_and_defaults_have_the_scenes_dials(whole):
    _, order, _ = whole
    assert order[0].method == "none"
    assert order[0].settings == replace(BASE, method="none", spp=1)


def test_a_setting_that_failed_is_not_tried_again():
    def measure(point):
        return Result(failed=True) if point.method == "transmittance_atlas" else landscape(point)

    found, order, _ = study(100.0, measure, ("none", "transmittance_atlas"))
    assert sum(p.method == "transmittance_atlas" for p in order) == 1
    assert search.front((r.seconds, r.error) for r in found.results.values() if not r.failed)


def test_front_and_area():
    assert search.front([(1, 0.2), (2, 0.3), (3, 0.1), (1, 0.25)]) == [(1, 0.2), (3, 0.1)]
    assert search.area([(1, 0.02)], 100) == pytest.approx(2)
    assert search.area([(1, 0.02), (10, 0.002)], 100) == pytest.approx(3)
    assert search.area([(1, 0.02), (2, 0.02)], 100) == pytest.approx(2)
    assert search.area([(1, search.WORST), (100, 0.01)], 100) == 0


def test_hopes_take_away_noise_by_samples_and_a_share_of_the_bias_by_dials():
    result, point = Result(0, 1, 0.03, 0.04), Point("raymarch", 4)
    more = replace(point, spp=16)
    assert search.hoped_error(point, result, more, "spp", 1) == pytest.approx(math.hypot(0.015, 0.04))
    finer = replace(point, samples=768)
    assert search.hoped_error(point, result, finer, "samples", 1) == pytest.approx(math.hypot(0.03, 0.028))
    assert search.hoped_error(point, result, replace(point, samples=192), "samples", -1) == pytest.approx(0.05)
    assert search.hoped_error(point, result, finer, "samples", 1, 1) == pytest.approx(math.hypot(0.03, 0.034))


def test_every_dial_of_a_method_is_turned_or_known_not_to_be():
    for method in REGISTRY.values():
        assert set(method.dials) <= set(points.DIALS) | set(points.NOT_TURNED), method.name


def test_neighbours_are_one_step_away():
    near = points.neighbours(Point("transmittance_map", 4, max_depth=6), Limits(6, True, 2048))
    changed = {(dial, getattr(p, dial), way) for p, dial, way in near}
    assert changed == {
        ("spp", 16, 1), ("spp", 1, -1), ("samples", 768, 1), ("samples", 192, -1), ("environment_lights", 2048, 1),
        ("environment_lights", 128, -1), ("representation", "network", 0), ("map_resolution", 384, 1),
        ("map_resolution", 96, -1), ("map_source", "network", 0), ("map_components", 2, 0), ("max_depth", 2, -1)}
    drawn = points.neighbours(Point("raymarch", 4), LIMITS)
    assert ("light_samples", 16) in {(dial, getattr(p, dial)) for p, dial, _ in drawn}
    few = {dial for _, dial, _ in points.neighbours(Point("raymarch", 4, light_samples=4), LIMITS)}
    assert "environment_lights" not in few and "map_resolution" not in few
    assert [p.spp for p, _, _ in points.neighbours(Point("raymarch", 4), LIMITS, fine=True)][:2] == [8, 2]
    assert [p for p, _, _ in points.neighbours(Point(STOCK, 1), LIMITS)] == [Point(STOCK, 4)]


def test_labels_name_what_differs_from_the_scene():
    point = Point("transmittance_map", 4, 2, map_resolution=96, map_components=2)
    assert points.label(point, BASE) == "transmittance_map, maps of 96², 2 logistics, 4 spp"
    assert points.label(Point("raymarch", 1, 2, light_samples=4), BASE) == "raymarch, 4 drawn lights, 1 spp"
    assert points.label(Point(STOCK, 16), BASE) == "volpath, 16 spp"


@pytest.mark.parametrize(("point", "environment", "words"), [
    (Point("transmittance_atlas", 4), True, "atlas, 512 lights, 4 spp"),
    (Point("transmittance_map", 4, environment_lights=1, map_resolution=96), True, "map, maps of 96², 1 light, 4 spp"),
    (Point("neural_transmittance", 64, light_samples=16), True, "neural, 16 drawn lights, 64 spp"),
    (Point("ray_network", 1, light_samples=1), False, "ray network, 1 drawn light, 1 spp"),
    (Point("raymarch", 1, samples=96), False, "raymarch, 96 steps, 1 spp"),
    (Point(STOCK, 16, light_samples=4), True, "volpath, 16 spp")])
def test_short_words(point, environment, words):
    assert points.short(point, BASE, environment) == words
    assert points.from_dict(point.as_dict()) == point

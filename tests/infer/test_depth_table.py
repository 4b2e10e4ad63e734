"""Tables of optical depth along rays, beside closed forms."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ntf.infer.visibility import depth_table


@pytest.mark.parametrize(("power", "tolerance"), [(1, 1e-5), (2, 1e-5), (3, 0.015)])
@pytest.mark.parametrize("whole", [0.1, 2.0, 8.0])
def test_depth_between_the_places(power, tolerance, whole):
    """The depth grows as a power of the way from t' = 0.8 to −0.8; it is exact where extinction is constant."""
    places = [0.8 - 1.6 * fraction ** (1 / power) for fraction in depth_table.FRACTIONS]
    t = np.linspace(-1, 1, 1001)
    way = np.clip((0.8 - t) / 1.6, 0, 1)
    truth = np.exp(-whole * way**power)
    table = tuple(mi.Float(p) for p in places[:3]), (mi.Float(places[3]), mi.Float(places[4]), mi.Float(whole))
    tau = np.array(depth_table.tau(mi.Float(t.astype(np.float32)), table))
    # The depth before the first place, a thousandth of the whole, is left out.
    assert np.abs(tau - truth).max() < tolerance + whole * depth_table.FRACTIONS[0]


def test_a_clear_ray_keeps_its_light():
    zero = dr.zeros(mi.Float, 5)
    assert np.array(depth_table.tau(mi.Float(np.linspace(-1, 1, 5)), ((zero,) * 3, (zero,) * 3))).min() == 1

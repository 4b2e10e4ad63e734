"""Two logistics through rays with τ in closed form."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mi_ntf.infer.visibility import two_logistics

ENTER, LEAVE = 0.5, -0.3


def even(t, depth):
    """τ at `t` of rays through even smoke between `ENTER` and `LEAVE`, of optical depth `depth`."""
    return np.exp(-depth * np.clip((ENTER - t) / (ENTER - LEAVE), 0, 1))


def fitted(depth, effort, far):
    """Return the fitted τ as a function of t."""
    places = [mi.Float(ENTER - d / depth * (ENTER - LEAVE)) for d in effort.depths]
    n, end = len(depth), mi.Float(depth)
    last, far = (dr.full(mi.Float, t, n) for t in (LEAVE, far))
    mixture = two_logistics.fit(places, end, last, far, dr.full(mi.Bool, True, n), effort)
    (w1, a1, b1), (w2, a2, b2) = (tuple(np.array(c, np.float64) for c in part) for part in mixture)

    def tau(t):
        return w1 / (1 + np.exp(-a1 * (t - b1))) + w2 / (1 + np.exp(-a2 * (t - b2)))

    return tau


@pytest.mark.parametrize("far", [-0.32, -0.9])
def test_even_smoke_and_its_remaining_light(variant, far):
    """The smoke begins and ends at corners, which no logistic has. The second start helps if it ends at the
    sphere, and does no harm if it does not."""
    depth, rms = np.linspace(0.3, 2.5, 23), []
    for effort in (two_logistics.FINE, two_logistics.SMOKE):
        tau = fitted(depth, effort, far)
        error = np.stack([tau(t) - even(t, depth) for t in np.linspace(ENTER, LEAVE, 81)])
        after = np.stack([tau(t) - np.exp(-depth) for t in np.linspace(LEAVE, far, 31)])
        rms.append(np.sqrt((error**2).mean()))
        print(f"inside mean {error.mean():+.4f}, RMS {rms[-1]:.4f}, behind {np.sqrt((after**2).mean()):.4f}")
        assert abs(error.mean()) < 0.01 and rms[-1] < 0.035
        assert np.sqrt((after**2).mean()) < 0.025
    assert rms[1] < (0.8 if far > -0.5 else 1.0) * rms[0]

"""The micro benchmark of map lookups, small."""

from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest

import mi_ntf.render
from mi_ntf.core.errors import MiNtfError
from mi_ntf.evaluate import lookup
from mi_ntf.render import effects

STATUE = Path(__file__).parents[2] / "scenes/statue/scene.xml"


def test_what_is_measured():
    """Every kind of map and the bare gathers take time; the loop sums over all lights."""
    mi.set_variant("llvm_ad_rgb")
    mi_ntf.render.register()
    medium = effects.find_media(mi.load_file(str(STATUE)))[0]
    found = lookup.measure(medium, 1 << 12, 4, 16, repeats=1)
    assert set(found) == {"loop", "gathers", "directional", "point", "inside", "mixture"}
    assert found["loop"] > 0
    x = tuple(mi.Float([0.1, 0.2]) for _ in range(3))
    table = lookup._table(np.eye(3), False)
    np.testing.assert_allclose(np.array(lookup.total(x, table, None)), 3, atol=1e-6)
    with pytest.raises(MiNtfError, match="0 points and 4 lights leave nothing to measure"):
        lookup.measure(medium, 0, 4)

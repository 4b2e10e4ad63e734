"""Every table of the pages, from small values of the form that its script writes."""

import pytest

from benchmarks import dial, fields, loops, tables


def spread(value):
    return {"median": value, "min": 0.9 * value, "max": 1.1 * value, "repeats": 3}


def timed(**more):
    return {"seconds": spread(2.0), "ratio": spread(4.0), **more}


LOOPS = {
    "loop": {"statue": {kind: {"raymarch": spread(176.0), "transmittance_atlas": spread(18.7), "ratio": spread(9.4)}
                        for kind in ("random", "same")}},
    "whole": {"statue": {m: timed(error=0.01, brightness=0.0) for m in loops.METHODS}},
    "sampled": {"statue": {light: {m: timed(equal_noise=0.27, brightness=0.0) for m in loops.METHODS}
                           for light in ("env", "area")}},
    "floor": {"knot": {**{m: timed() for m in (*loops.METHODS[:2], "no field")}, "error": 0.008,
                       "error_of_shadow": 0.02, "brightness": 0.8}},
    "bounces": {"three_fields": {**{m: timed() for m in loops.METHODS[:2]}, "brightness": 0.001}},
}
ROW = {"scene": "statue", "light": "point", "frames": 1, "error": 0.012, "seconds": 3.2, "best_seconds": 3.0,
       "ratio": 1.07, "march_seconds": 9.0, "threshold": 0.03, "noise": 0.031, "reported": 0.03, "spp": 16,
       "budget": 5.0, "best": "raymarch", "best_error": 0.02, "whole_seconds": 5.0, "computed_seconds": 320.0}
FIELDS = {
    "brightness": {"statue": {"flash": {"brightness": -0.013, "relative_rmse": 0.12, "aligned": 0.11}}},
    "photographs": {"statue": {"psnr": spread(33.0), "ssim": spread(0.96), "normal_error": 7.25}},
    "transmittance": {"statue": {**dict.fromkeys(fields.WAYS, 0.024), "query_ns": spread(207.0)}},
}
SEQUENCE = {"frames": 120, "size": 256, "first": 2.1, "each": spread(0.4), "late": spread(0.4), "stock": spread(4.4),
            "ratio": 10.5, "memory": [400.0, 404.0]}
VALUES = {"loops": LOOPS, "dial": {case: [ROW] for case in dial.CASES}, "fields": FIELDS, "sequence": SEQUENCE}
EXPECTED = {
    "loops-loop": "| statue | random directions | `transmittance_atlas` | 18.7 (16.8 to 20.6) | 9.4 × (8.46 to 10.3) |",
    "loops-whole": "| statue | `transmittance_atlas` | 2.00 (1.80 to 2.20) | 4 × (3.6 to 4.4) | 1.0 % |",
    "loops-sampled": "| statue | area light | `raymarch` | 2.00 (1.80 to 2.20) |  | 0.27 |",
    "loops-floor": "| knot | `raymarch` | 2.00 (1.80 to 2.20) |  |",
    "dial-error": "| statue | point | 1 | 1.2 % | 3.20 | 3.00 | 1.07 | 9.00 |",
    "dial-noise": "| statue | point | 0.03 | 0.031 | 0.030 | 16 | 3.20 |",
    "dial-stock": "| statue | point | 3.20 | 16 | 320 | 1.07 |",
    "brightness": "| statue | flash | -1.3 % | 12.0 % | 11.0 % |",
    "photographs": "| statue | 33.0 (29.7 to 36.3) | 0.960 (0.864 to 1.056) | 7.2 |",
    "sequence": "| 120 calls over 120 frames | 10.5 × |",
}


@pytest.mark.parametrize("name", [name for name, (script, _) in tables.TABLES.items() if script in VALUES])
def test_a_table_has_equal_rows(name):
    script, make = tables.TABLES[name]
    lines = make(VALUES[script]).splitlines()
    assert len(lines) > 2 and len({line.count("|") for line in lines}) == 1
    assert EXPECTED.get(name, lines[0]) in lines


def test_numbers_have_three_digits():
    assert [tables.number(v) for v in (0.01234, 1.5, 47.9, 128.3, 47806.81)] == ["0.0123", "1.5", "47.9", "128",
                                                                                  "47 807"]
    assert tables.spread({"median": 2.0, "min": 2.0, "max": 2.0, "repeats": 1}, "s") == "2 s"

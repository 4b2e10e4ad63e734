"""Tables of `mi-ntf reproduce`: the paper's numbers, its layout, drops of known measures, LaTeX that is well formed."""

import re
from pathlib import Path

import numpy as np
import pytest

from benchmarks.bench_measure import FULL
from benchmarks.reproduce import costs, paper, tables
from benchmarks.reproduce.compared import METHODS, METRICS, Scene
from benchmarks.reproduce.results import Accuracy, Figure, drop

# Lines of the source's table 2: metrics side by side, NRF, Ours TM, Ours AG, No AG.
LINES = [
    ("Happy Buddha  & 0.963  & 0.954  & 0.954  & 0.948  & 0.049  & 0.055  & 0.055  & 0.058", "point", 0),
    ("Globe  & 0.107  & 0.126  & 0.126  & 0.127  & 0.739  & 0.732  & 0.732  & 0.732", "point", 1),
    ("Sitting Buddha  & 0.952  & 0.903  & 0.890  & 0.870  & 0.095  & 0.085  & 0.090  & 0.075", "environment", 0),
    ("Sitting Buddha  & 0.041  & 0.081  & 0.085  & 0.097  & 0.939  & 0.895  & 0.880  & 0.864", "environment", 1),
    ("Globe  & 0.159  & 0.240  & 0.281  & 0.281  & 0.899  & 0.851  & 0.831  & 0.835", "environment", 1),
]
SCENES = [Scene("statue", Path("statue"), "Sitting Buddha"), Scene("mine", Path("mine"))]


@pytest.mark.parametrize(("line", "kind", "block"), LINES, ids=[line[:14] for line, _, _ in LINES])
def test_the_papers_numbers_are_those_of_its_source(line, kind, block):
    name, *values = (word.strip() for word in line.split("&"))
    for k, metric in enumerate(tables.PAIRS[block]):
        ours = [paper.mean(name, kind, metric, method) for method in paper.METHODS]
        assert ours == [float(v) for v in values[4 * k:4 * k + 4]]


def test_the_papers_table_is_whole():
    assert len(paper.TABLE2) == 6 and all(set(block) == set(METRICS) for block in paper.TABLE2.values())
    assert paper.mean("Globe", "point", "ssim", "NeRV") is None and paper.mean("", "point", "ssim", "NRF") is None
    for row in paper.TABLE1.values():
        for fast, slow, ratio in row.values():
            assert slow / fast == pytest.approx(ratio, rel=0.01)
    assert paper.ideal_speed_up(1) == pytest.approx(2 * 192 / 193)
    assert paper.ideal_speed_up(10**9) == pytest.approx(192, rel=1e-3)


def picture(scene, light, method, **metrics):
    return {"scene": scene, "kind": light.split("-")[0], "light": light, "method": method, "seconds": 1.0,
            "metrics": {"ms_ssim": None, "lpips": None, "rmse": None, "ssim": None} | metrics}


@pytest.fixture
def found():
    """Two scenes; of one picture TM is not finished, and of another scene it is better than NRF."""
    return Accuracy([
        picture("statue", "point-000", "NRF", rmse=0.10, ssim=0.96, lpips=0.05),
        picture("statue", "point-001", "NRF", rmse=0.30, ssim=0.90, lpips=0.05),
        picture("statue", "point-000", "TM", rmse=0.12, ssim=0.95, lpips=0.08),
        picture("mine", "point-000", "NRF", rmse=0.20, ssim=0.80),
        picture("mine", "point-000", "TM", rmse=0.19, ssim=0.81),
        picture("mine", "environment-000", "TM", rmse=0.19, ssim=0.81),
    ], SCENES)


def test_means_are_of_all_pictures_and_drops_of_common_ones(found):
    statue, mine = SCENES
    assert found.mean(statue, "point", "rmse", "NRF") == Figure(pytest.approx(0.2), 2, 0.011)
    assert found.mean(mine, "point", "ms_ssim", "NRF") == Figure(None, 0, None)
    assert found.drop(statue, "point", "rmse", "TM") == Figure(pytest.approx(0.2), 1, pytest.approx(1.0))
    assert found.drop(statue, "point", "ssim", "TM") == Figure(pytest.approx(0.01), 1, pytest.approx(0.009))
    assert found.drop(statue, "point", "lpips", "TM") == Figure(pytest.approx(0.03), 1, pytest.approx(-0.017))
    assert found.drop(mine, "point", "ssim", "TM").ours == pytest.approx(-0.01)
    assert found.drop(mine, "environment", "ssim", "TM").ours is None  # no NRF to compare with
    both = found.over_scenes("drop", "point", "rmse", "TM")
    assert both.ours == pytest.approx((0.2 - 0.05) / 2) and both.images == 2
    assert both.paper == pytest.approx(((60 / 51 - 1) + 1 + (126 / 107 - 1)) / 3)
    assert found.over_scenes("drop", "point", "ssim", "TM").paper == pytest.approx(0.026 / 3)
    assert found.over_scenes("drop", "environment", "ssim", "TM").paper == pytest.approx(0.115 / 3)
    assert found.images() == (1, 2) and found.methods(METHODS) == ["NRF", "TM"]


def test_worse_is_above_zero_for_every_metric():
    assert drop("ssim", 0.9, 0.95) > 0 and drop("ms_ssim", 0.9, 0.95) > 0
    assert drop("lpips", 0.2, 0.1) == pytest.approx(0.1) and drop("rmse", 0.15, 0.1) == pytest.approx(0.5)
    assert np.isnan(drop("rmse", 0.1, 0.0))


def test_table_2_is_laid_out_as_in_the_paper(found):
    blocks = tables.table2(found, ["NRF", "TM"])
    assert [b.title for b in blocks] == ["Point light, MS-SSIM and LPIPS", "Point light, rMSE and SSIM",
                                         "Environment map, MS-SSIM and LPIPS", "Environment map, rMSE and SSIM"]
    block = blocks[1]
    assert block.groups == [("", 1), ("rMSE", 2), ("SSIM", 2), ("", 1)]
    assert block.header == ["scene", "NRF", "TM", "NRF", "TM", "pictures"]
    assert block.rows[0] == ["statue [Sitting Buddha]", "0.200 [0.011]", "0.120 [0.022]", "0.930 [0.976]",
                             "0.950 [0.967]", "1–2"]
    assert block.rows[1] == ["mine", "0.200", "0.190", "0.800", "0.810", "1"]
    assert block.rows[2][:2] == ["mean of 2 [of 3]", "0.200 [0.056]"]
    drops = tables.drops(found, ["NRF", "TM"])[1]
    assert drops.rows[0] == ["statue [Sitting Buddha]", "+20.0% [+100.0%]", "+0.0100 [+0.009]", "1"]
    assert blocks[0].rows[0][1] == "– [0.985]"


COSTS = {"camera": 1e-6, "points": 2.0, "query": 3e-6, "volume/192": 192e-6, "volume/256": 256e-6, "map": 1e-6,
         "ours": 1e-7, "shade/volume": 2e-9, "shade/map": 1e-9, "voxels": 7.0, "share/192": 0.1, "share/256": 0.2,
         "share/rays": 0.5}
PIXELS = 360_000


def test_table_1_is_composed_of_costs():
    table = tables.table1(COSTS, FULL)
    assert table.groups == [("", 1), ("Transmittance", 3), ("Overall", 3)]
    point, sky, *ours = table.rows
    assert point[:4] == ["Point light", "0.36 [0.25]", "69.12 [96.73]", "192 [384.10]"]
    fixed, shade = PIXELS * 192 * 3e-6, PIXELS * 192
    fast = fixed + 500 * (PIXELS * 1e-6 + shade * 1e-9)
    slow = fixed + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    assert sky[4:] == [f"{fast:.0f} [522.45]", f"{slow:.0f} [48151.80]", f"{slow / fast:.2f} [92.16]"]
    assert all("[" not in c for row in ours for c in row)  # the paper culls nothing
    assert costs.transmittance(COSTS, 1, "ours", True) == pytest.approx((7 + PIXELS * 1e-7, 7 + PIXELS * 19.2e-6))


def test_complexity_at_the_papers_sizes():
    table = tables.complexity(COSTS)
    assert table.header == ["", "Naive", "NRF", "AG", "TM"]
    assert table.rows[0] == ["formula", "l·n²·c", "l·m·n", "l·m·n", "l·m"]
    assert table.rows[1][1:] == ["6.64e+12", "3.46e+10", "3.46e+10", "1.80e+08"]
    assert table.rows[2][1:] == ["1.00", "1.00", "1.00", "1.00"] and table.rows[3][4] == "0.05"
    assert "1.99 × for one light" in table.note and "measured 192 × [391 ×]" in table.note


def test_time_to_make_maps():
    built = {"statue": {"resolution": 64, "lights": [1, 2, 4], "map": [1.1, 1.2, 1.4], "volume": [2.0, 3.0, 5.0]}}
    rows = tables.maps(COSTS, built).rows
    assert rows[0] == ["the paper's synthetic scenes", "600 × 600", "0.36 [0.24]", "69.12 [95.61]", "192 [391]"]
    assert rows[1][2:] == ["0.28", "54.33", "192"]
    assert rows[3] == ["statue, our field", "64²", "0.100", "1.000", "10.0"]


def test_ablation_of_networks():
    study = {"relative_rmse": {"ray_network": 0.283}}
    table = tables.ablation({("statue", "ag"): study, ("globe", "no_ag"): {"relative_rmse": {"ray_network": 0.41}}})
    assert table.header == ["scene", "AG", "No AG"]
    assert table.rows == [["statue", "28.3%", "–"], ["globe", "–", "41.0%"]]


def columns_of(line: str) -> int:
    """Columns of a row of a tabular."""
    cells = re.split(r"(?<!\\)&", line)
    return sum(int(m[1]) if (m := re.search(r"\\multicolumn\{(\d+)\}", cell)) else 1 for cell in cells)


def test_latex_is_well_formed(found):
    every = [*tables.table2(found, list(METHODS)), *tables.drops(found, list(METHODS)), tables.table1(COSTS, FULL),
             tables.complexity(COSTS), tables.maps(COSTS, {}), tables.Table("50 % & more_", ["a", "b"], [["{x}", "#"]])]
    for table in every:
        text = tables.latex(table)
        assert text.isascii()
        for name in ("table", "tabular"):
            assert text.count(f"\\begin{{{name}}}") == text.count(f"\\end{{{name}}}") == 1
        bare = re.sub(r"\\[{}]", "", text)
        depth = np.cumsum([(c == "{") - (c == "}") for c in bare])
        assert depth.min() >= 0 and depth[-1] == 0
        assert re.sub(r"\\\$", "", text).count("$") % 2 == 0
        spec = re.search(r"\\begin\{tabular\}\{([|lc]+)\}", text)[1]
        lines = [line for line in text.splitlines() if line.endswith(r"\\ \hline")]
        assert len(lines) == len(table.rows) + 1 + bool(table.groups)
        assert {columns_of(line) for line in lines} == {spec.count("c") + spec.count("l")} == {len(table.header)}
    assert r"50 \% \& more\_" in tables.latex(every[-1]) and r"\{x\} & \#" in tables.latex(every[-1])

"""The paper's numbers, and tables of known measurements beside them."""

import numpy as np
import pytest

from benchmarks import networks, paper, reproduce

# Lines of the source's table 2: two metrics side by side, each of NRF, Ours TM, Ours AG, No AG.
LINES = [
    ("Happy Buddha  & 0.963  & 0.954  & 0.954  & 0.948  & 0.049  & 0.055  & 0.055  & 0.058", "point", 0),
    ("Globe  & 0.107  & 0.126  & 0.126  & 0.127  & 0.739  & 0.732  & 0.732  & 0.732", "point", 1),
    ("Sitting Buddha  & 0.952  & 0.903  & 0.890  & 0.870  & 0.095  & 0.085  & 0.090  & 0.075", "environment", 0),
    ("Sitting Buddha  & 0.041  & 0.081  & 0.085  & 0.097  & 0.939  & 0.895  & 0.880  & 0.864", "environment", 1),
    ("Globe  & 0.159  & 0.240  & 0.281  & 0.281  & 0.899  & 0.851  & 0.831  & 0.835", "environment", 1),
]
PAIRS = ("ms_ssim", "lpips"), ("rmse", "ssim")


@pytest.mark.parametrize(("line", "kind", "block"), LINES, ids=[line[:14] for line, _, _ in LINES])
def test_the_papers_numbers_are_those_of_its_source(line, kind, block):
    name, *values = (word.strip() for word in line.split("&"))
    for k, metric in enumerate(PAIRS[block]):
        stored = [paper.mean(name, kind, metric, method) for method in paper.METHODS]
        assert stored == [float(v) for v in values[4 * k:4 * k + 4]]


def test_the_papers_table_is_whole():
    assert len(paper.TABLE2) == 6 and all(set(block) == set(paper.METRICS) for block in paper.TABLE2.values())
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
def values():
    """Two scenes; TM lacks one picture, and is better than NRF in another scene."""
    rows = [
        picture("statue", "point-000", "NRF", rmse=0.10, ssim=0.96, lpips=0.05),
        picture("statue", "point-001", "NRF", rmse=0.30, ssim=0.90, lpips=0.05),
        picture("statue", "point-000", "TM", rmse=0.12, ssim=0.95, lpips=0.08),
        picture("mine", "point-000", "NRF", rmse=0.20, ssim=0.80),
        picture("mine", "point-000", "TM", rmse=0.19, ssim=0.81),
        picture("mine", "environment-000", "TM", rmse=0.19, ssim=0.81),
    ]
    return reproduce.summary(rows) | {"methods": ["NRF", "TM"]}


def test_means_are_of_all_pictures_and_drops_of_common_ones(values):
    statue, mine = values["accuracy"]["statue"]["point"], values["accuracy"]["mine"]
    assert statue["NRF"]["rmse"]["mean"] == pytest.approx(0.2) and statue["NRF"]["rmse"]["images"] == 2
    for metric, drop in (("rmse", 0.2), ("ssim", 0.01), ("lpips", 0.03)):
        assert statue["TM"][metric]["drop"] == pytest.approx(drop) and statue["TM"][metric]["common"] == 1
    assert mine["point"]["TM"]["ssim"]["drop"] == pytest.approx(-0.01)
    assert mine["environment"]["TM"]["ssim"]["drop"] is None  # no NRF to compare with
    assert "ms_ssim" not in statue["NRF"]
    rmse = (60 / 51 - 1) + (22 / 11 - 1) + (126 / 107 - 1)
    assert paper.mean_over_scenes("point", "rmse", "TM", True) == pytest.approx(rmse / 3)
    assert paper.mean_over_scenes("point", "ssim", "TM", True) == pytest.approx(0.026 / 3)
    assert paper.mean_over_scenes("environment", "ssim", "TM", True) == pytest.approx(0.115 / 3)
    assert paper.mean_over_scenes("point", "ssim", "March") is None


def test_worse_is_above_zero_for_every_metric():
    assert paper.drop("ssim", 0.9, 0.95) > 0 and paper.drop("ms_ssim", 0.9, 0.95) > 0
    assert paper.drop("lpips", 0.2, 0.1) == pytest.approx(0.1) and paper.drop("rmse", 0.15, 0.1) == pytest.approx(0.5)
    assert np.isnan(paper.drop("rmse", 0.1, 0.0))


def test_accuracy_and_drops_beside_the_papers(values):
    lines = paper.accuracy_table(values).splitlines()
    assert lines[0] == "| mean over scenes | NRF | TM |"
    assert "| point light, rMSE | 0.200 [0.056] | 0.155 [0.069] |" in lines
    assert "| environment map, SSIM | – [0.925] | 0.810 [0.887] |" in lines
    assert not any("MS-SSIM" in line for line in lines)  # no picture has it
    drops = paper.drops_table(values).splitlines()
    assert "| point light, rMSE | +7.5% [+45.1%] |" in drops and "| point light, SSIM | +0.0000 [+0.009] |" in drops


COSTS = {"camera": 1e-6, "points": 2.0, "query": 3e-6, "volume/192": 192e-6, "volume/256": 256e-6, "map": 1e-6,
         "ours": 1e-7, "shade/volume": 2e-9, "shade/map": 1e-9, "voxels": 7.0, "fraction/192": 0.1,
         "fraction/256": 0.2, "fraction/rays": 0.5}
SPEED = {"costs": {"rounds": [COSTS]}}
PIXELS = 360_000


def test_table_1_is_composed_of_costs():
    lines = paper.times_table(SPEED).splitlines()[2:]
    assert lines[0] == "| transmittance, point light | 0.36 [0.25] | 69.12 [96.73] | 192 [384.10] |"
    fixed, shade = PIXELS * 192 * 3e-6, PIXELS * 192
    fast = fixed + 500 * (PIXELS * 1e-6 + shade * 1e-9)
    slow = fixed + 500 * (PIXELS * 192e-6 + shade * 2e-9)
    assert lines[3] == (f"| overall, environment map | {fast:.0f} [522.45] | {slow:.0f} [48151.80] | "
                        f"{slow / fast:.2f} [92.16] |")
    assert all("[" not in line for line in lines[4:])  # the paper culls nothing
    assert networks.stage(COSTS, 1, "ours", True, 192) == pytest.approx((7 + PIXELS * 1e-7, 7 + PIXELS * 19.2e-6))


def test_complexity_at_the_papers_sizes():
    lines = paper.complexity_table(SPEED).splitlines()
    assert lines[0] == "|  | Naive | NRF | AG | TM |" and lines[2] == "| formula | l·n²·c | l·m·n | l·m·n | l·m |"
    assert lines[3].endswith("| 6.64e+12 | 3.46e+10 | 3.46e+10 | 1.80e+08 |")
    assert lines[4].endswith("| 1.00 | 1.00 | 1.00 | 1.00 |") and lines[5].endswith("| 0.05 |")


def test_time_to_make_maps():
    row = {"resolution": 64, "lights": [1, 2, 4], "map": [1.1, 1.2, 1.4], "volume": [2.0, 3.0, 5.0]}
    assert paper.build_table({"build": {"statue": row}}).endswith("| statue | 64² | 0.100 | 1.000 | 10.0 |")


def test_ablation_of_networks():
    table = paper.ablation_table({"ablation": {"statue": {"AG": {"ray_network": 0.283}},
                                               "globe": {"No AG": {"ray_network": 0.41}}}})
    assert table.splitlines()[0] == "| relative RMSE | AG | No AG |"
    assert table.splitlines()[2:] == ["| statue | 28.3% | – |", "| globe | – | 41.0% |"]

"""Exit codes, messages and JSON of `mi-ntf`."""

import json
import sys
import types
from importlib.metadata import version
from pathlib import Path

import pytest
from helpers.programs import run_on_one_core, run_program

from mi_ntf import cli, doctor
from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs import Workers


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list:
    """Arguments of the calls of stand-ins for the functions behind the commands."""
    calls: list = []

    def note(result=None):
        def function(*args, **kwargs):
            calls.append((args, kwargs))
            return result

        return function

    def stand_in(module: str, **functions):
        monkeypatch.setitem(sys.modules, module, types.SimpleNamespace(**functions))

    table = {"psnr": 30.5, "inner": {"a": 1}}
    stand_in("mi_ntf.data.capture", capture=note())
    stand_in("mi_ntf.data.inspect", inspect=note(table), print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.train", train=note(table))
    stand_in("mi_ntf.swap", swap=note([]))
    stand_in("mi_ntf.view", view=note())
    stand_in("mi_ntf.evaluate.compare", compare=note(table), print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.render.commands.explain", explain=note(table),
             print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.core.field_file", describe=note(table))
    stand_in("mi_ntf.evaluate.tradeoff", study=types.SimpleNamespace(
        tradeoff=note(table), print_table=lambda values: print("table", values["psnr"])))
    return calls


@pytest.mark.parametrize(
    ("line", "args", "kwargs"),
    [
        (
            "capture s.xml data --views 7 --size 32",
            (Path("s.xml"), Path("data")),
            {"views": 7, "size": 32, "test_views": 20, "spp": 64, "seed": 0, "flash_offset": (0.0, 0.0, 0.0),
             "workers": Workers()},
        ),
        (
            "capture s.xml data --flash-offset=-1,2e-1,0",
            (Path("s.xml"), Path("data")),
            {"views": 100, "size": 128, "test_views": 20, "spp": 64, "seed": 0, "flash_offset": (-1.0, 0.2, 0.0),
             "workers": Workers()},
        ),
        (
            "train data -o f.safetensors --minutes 2.5",
            (Path("data"), Path("f.safetensors")),
            {"preset": "fast", "minutes": 2.5, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "ntf": None, "augmentation": True, "colour_loss": True, "visibility_mlp": False,
             "bounces": True, "fresnel": True, "gains": True, "estimate": False, "view": False,
             "reading": {"size": None, "masks": None, "background": None, "flash_offset": None}},
        ),
        (
            "train data -o f --steps 9 --field g --ntf ray --no-augmentation --no-colour-loss --no-bounces "
            "--no-fresnel --visibility-mlp",
            (Path("data"), Path("f")),
            {"preset": "fast", "minutes": None, "steps": 9, "seed": 0, "tensorboard": None, "field": Path("g"),
             "ntf": "ray", "augmentation": False, "colour_loss": False, "visibility_mlp": True,
             "bounces": False, "fresnel": False, "gains": True, "estimate": False, "view": False,
             "reading": {"size": None, "masks": None, "background": None, "flash_offset": None}},
        ),
        (
            "train data -o f --size 768 --background black --flash-offset estimate --no-gains",
            (Path("data"), Path("f")),
            {"preset": "fast", "minutes": None, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "ntf": None, "augmentation": True, "colour_loss": True, "visibility_mlp": False,
             "bounces": True, "fresnel": True, "gains": False, "estimate": True, "view": False,
             "reading": {"size": 768, "masks": None, "background": "black", "flash_offset": None}},
        ),
        (
            "train data -o f --masks m --flash-offset 0.1,0.2,-0.3",
            (Path("data"), Path("f")),
            {"preset": "fast", "minutes": None, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "ntf": None, "augmentation": True, "colour_loss": True, "visibility_mlp": False,
             "bounces": True, "fresnel": True, "gains": True, "estimate": False, "view": False,
             "reading": {"size": None, "masks": Path("m"), "background": None, "flash_offset": (0.1, 0.2, -0.3)}},
        ),
        (
            "view s.xml -D light=env -D spp=2 --size 128 --samples 8 --port 9000",
            (Path("s.xml"), {"light": "env", "spp": "2"}, 128, 8, "127.0.0.1", 9000),
            {},
        ),
        (
            "inspect data",
            (Path("data"), None),
            {"size": None, "masks": None, "background": None, "flash_offset": None},
        ),
        (
            "inspect data -o p.html --size 64 --masks m --background black --flash-offset=-1,0,2",
            (Path("data"), Path("p.html")),
            {"size": 64, "masks": Path("m"), "background": "black", "flash_offset": (-1.0, 0.0, 2.0)},
        ),
        ("swap s.xml f.safetensors -o out.xml", (Path("s.xml"), Path("f.safetensors"), Path("out.xml")), {}),
        ("compare a.exr b.exr", (Path("a.exr"), Path("b.exr"), None), {}),
        ("compare a.exr b.exr -o c.png", (Path("a.exr"), Path("b.exr"), Path("c.png")), {}),
        ("explain s.xml -D spp=4 -D light=env", (Path("s.xml"), {"spp": "4", "light": "env"}, False), {}),
        ("explain s.xml --measure", (Path("s.xml"), {}, True), {}),
        ("tradeoff s.xml -D a=4 --budget 2m", (Path("s.xml"), Path("tradeoff"), {"a": "4"}, 120.0, None, False), {}),
        ("tradeoff s.xml -o d --reference m.xml", (Path("s.xml"), Path("d"), {}, 300.0, Path("m.xml"), False), {}),
        ("info f.safetensors", (Path("f.safetensors"),), {}),
    ],
)
def test_commands_pass_their_arguments_on(calls: list, line: str, args: tuple, kwargs: dict):
    assert cli.main(line.split()) == 0
    assert calls == [(args, kwargs)]


@pytest.mark.parametrize("line", ["compare a b --json", "train d -o f --json", "explain s.xml --json", "info f --json",
                                  "inspect d --json", "tradeoff s.xml --json"])
def test_json(calls: list, line: str, capsys: pytest.CaptureFixture[str]):
    assert cli.main(line.split()) == 0
    assert json.loads(capsys.readouterr().out) == {"psnr": 30.5, "inner": {"a": 1}}


def test_limits_of_compare_decide_the_exit_code(calls: list, capsys: pytest.CaptureFixture[str]):
    assert cli.main("compare a b --min-psnr 30.5".split()) == 0
    assert capsys.readouterr() == ("table 30.5\n", "")
    assert cli.main("compare a b --min-psnr 31 --max-flip 0.5".split()) == 1
    out, err = capsys.readouterr()
    assert out == "table 30.5\n"
    assert err == ("mi-ntf: PSNR is 30.5 dB, less than --min-psnr 31 allows\n"
                   "mi-ntf: HDR-FLIP was not measured, so --max-flip 0.5 cannot be judged: "
                   "it is not among the figures\n")
    assert cli.main("compare a b --min-psnr 31 --json".split()) == 1
    [failure] = json.loads(capsys.readouterr().out)["exceeded"]
    assert (failure["metric"], failure["value"], failure["limit"]) == ("psnr", 30.5, 31)
    assert cli.main("compare a b --min-psnr 20 --json".split()) == 0
    assert json.loads(capsys.readouterr().out)["exceeded"] == []


@pytest.mark.parametrize(
    "line",
    [
        "",
        "nonsense",
        "train",
        "capture s.xml data --views many",
        "train data -o f --minutes 1 --steps 5",
        "train data -o f --flash-offset 1,2",
        "train data -o f --flash-offset up",
        "capture s.xml data --flash-offset estimate",
        "inspect data --flash-offset estimate",
        "compare a.exr b.exr --masked",
        "compare a.exr b.exr --max-psnr 30",
        "compare a.exr b.exr --max-flip little",
        "explain s.xml -D spp",
        "tradeoff s.xml --budget soon",
        "render",
        "render -D spp scene.xml",
        "render --nonsense scene.xml",
    ],
)
def test_bad_usage_is_2(calls: list, line: str):
    assert cli.main(line.split()) == 2
    assert calls == []


@pytest.mark.parametrize("line", ["-h", "train -h", "render -h"])
def test_help_is_0(line: str):
    assert cli.main(line.split()) == 0


@pytest.mark.parametrize("error", [MiNtfError("the field is bad"), OSError("the field is bad")])
def test_failed_work_is_1_and_one_line(calls: list, monkeypatch, capsys, error: Exception):
    def fail(path):
        raise error

    monkeypatch.setattr(sys.modules["mi_ntf.core.field_file"], "describe", fail)
    monkeypatch.delenv("MI_NTF_DEBUG", raising=False)
    assert cli.main(["info", "f"]) == 1
    assert capsys.readouterr().err == "mi-ntf: error: the field is bad\n"
    monkeypatch.setenv("MI_NTF_DEBUG", "1")
    assert cli.main(["info", "f"]) == 1
    assert "Traceback" in capsys.readouterr().err


def test_missing_extra_points_to_doctor(calls: list, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mi_ntf.train", None)
    assert cli.main(["train", "data", "-o", "f"]) == 1
    assert "`mi-ntf doctor` names the package" in capsys.readouterr().err


def test_defect_shows_its_traceback(calls: list, monkeypatch, capsys):
    monkeypatch.setattr(sys.modules["mi_ntf.core.field_file"], "describe", lambda path: {}["key"])
    assert cli.main(["info", "f"]) == 1
    assert "KeyError" in capsys.readouterr().err


def test_module_is_the_command(tmp_path: Path):
    done = run_program("python", "-m", "mi_ntf", "info", "nothing.safetensors", cwd=tmp_path)
    assert done.returncode == 1
    assert done.stderr.startswith("mi-ntf: error: ")
    assert "nothing.safetensors" in done.stderr


def test_render_names_a_missing_scene(tmp_path: Path):
    done = run_program("mi-ntf", "render", "-m", "scalar_rgb", "nothing.xml", cwd=tmp_path)
    assert done.returncode == 1
    assert "mi-ntf: error: scene nothing.xml does not exist" in done.stderr


def test_render_names_an_unknown_variant(tmp_path: Path):
    done = run_program("mi-ntf", "render", "-m", "llvm_rgb", "nothing.xml", cwd=tmp_path)
    assert done.returncode == 1
    assert "unknown variant 'llvm_rgb'; this Mitsuba has scalar_rgb" in done.stderr


def test_doctor_as_json(tmp_path: Path):
    done = run_program("mi-ntf", "doctor", "--json", cwd=tmp_path)
    report = json.loads(done.stdout)
    checks = {check["name"]: check for check in report["checks"]}
    assert done.returncode == 0 and report["ok"]
    assert checks["mitsuba"]["found"] == version("mitsuba")
    assert checks["bridge"]["found"].startswith(f"built for mitsuba {version('mitsuba')} ")
    assert all(check["remedy"] == "" for check in checks.values() if check["needed"])


def test_doctor_knows_what_one_core_does(tmp_path: Path):
    done = run_on_one_core("mi-ntf", "doctor", "--json", cwd=tmp_path)
    report = json.loads(done.stdout)
    check = {check["name"]: check for check in report["checks"]}["cores"]
    assert report["ok"] and (check["ok"], check["found"]) == (False, "1")
    assert "`mitsuba -t 3`" in check["remedy"] and "drjit.set_thread_count(2)" in check["remedy"]


def test_doctor_survives_a_missing_llvm(tmp_path: Path):
    done = run_program("mi-ntf", "doctor", "--json", cwd=tmp_path, DRJIT_LIBLLVM_PATH=str(tmp_path / "nothing.so"))
    llvm = next(check for check in json.loads(done.stdout)["checks"] if check["name"] == "LLVM")
    assert done.returncode == 1
    assert not llvm["ok"]
    assert "libllvm19" in llvm["remedy"]


def test_doctor_prints_a_remedy_on_one_line(capsys):
    remedy = "a command " + "that is long " * 20 + "and whole"
    check = doctor.Check("thing", False, True, "broken", remedy)
    doctor.print_table(doctor.Report(False, "1", [check]))
    assert f"thing: {remedy}" in capsys.readouterr().out

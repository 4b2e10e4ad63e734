"""Exit codes, messages and JSON of `mi-ntf`."""

import json
import re
import sys
import types
import typing
from pathlib import Path
from unittest.mock import ANY

import pytest
from helpers.programs import run_program

import mi_ntf
from mi_ntf import cli
from mi_ntf.commands import fields
from mi_ntf.core.errors import MiNtfError
from mi_ntf.jobs import Workers
from mi_ntf.render.scene.environment_option import Environment


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
    stand_in("mi_ntf.data.capture", capture=note({"rendered": 1, "kept": 0}))
    stand_in("mi_ntf.data.inspect", inspect=note(table), print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.train", train=note(table))
    stand_in("mi_ntf.swap", swap=note(types.SimpleNamespace(notes=[])))
    stand_in("mi_ntf.view", view=note())
    stand_in("mi_ntf.evaluate.compare", compare=note(table), print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.render.commands.explain", explain=note(table),
             print_table=lambda values: print("table", values["psnr"]))
    stand_in("mi_ntf.core.field_file", describe=note(table), print_summary=lambda values: None)
    stand_in("mi_ntf.evaluate.tradeoff", study=types.SimpleNamespace(
        tradeoff=note(table), print_table=lambda values, out: print("table", values["psnr"])))
    return calls


@pytest.mark.parametrize(
    ("line", "args", "kwargs"),
    [
        (
            "capture s.xml data --views 7 --size 32",
            (Path("s.xml"), Path("data")),
            {"views": 7, "size": 32, "test_views": 20, "spp": 64, "seed": 0, "flash_offset": (0.0, 0.0, 0.0),
             "shapes": "", "parameters": {}, "workers": Workers()},
        ),
        (
            "capture s.xml data --flash-offset=-1,2e-1,0",
            (Path("s.xml"), Path("data")),
            {"views": 100, "size": 128, "test_views": 20, "spp": 64, "seed": 0, "flash_offset": (-1.0, 0.2, 0.0),
             "shapes": "", "parameters": {}, "workers": Workers()},
        ),
        (
            "train data -o f.safetensors --minutes 2.5",
            (Path("data"), Path("f.safetensors")),
            {"preset": "fast", "minutes": 2.5, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "further": False, "began": ANY, "ntf": None, "augmentation": True, "colour_loss": True,
             "visibility_mlp": False, "bounces": True, "fresnel": True, "gains": True, "smoke": None, "estimate": False,
             "view": False, "reading": {"size": None, "masks": None, "background": None, "flash_offset": None}},
        ),
        (
            "train data -o f.safetensors --steps 9 --field g --ntf ray --no-augmentation --no-colour-loss --no-bounces "
            "--no-fresnel --visibility-mlp --flash-offset estimate",
            (Path("data"), Path("f.safetensors")),
            {"preset": "fast", "minutes": None, "steps": 9, "seed": 0, "tensorboard": None, "field": Path("g"),
             "further": False, "began": ANY, "ntf": "ray", "augmentation": False, "colour_loss": False,
             "visibility_mlp": True, "bounces": False, "fresnel": False, "gains": True, "smoke": None,
             "estimate": True, "view": False,
             "reading": {"size": None, "masks": None, "background": None, "flash_offset": "estimate"}},
        ),
        (
            "train data -o f.safetensors --size 768 --background black --smoke --asymmetry=-0.5 --no-gains",
            (Path("data"), Path("f.safetensors")),
            {"preset": "fast", "minutes": None, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "further": False, "began": ANY, "ntf": None, "augmentation": True, "colour_loss": True,
             "visibility_mlp": False, "bounces": True, "fresnel": True, "gains": False, "smoke": -0.5,
             "estimate": False, "view": False,
             "reading": {"size": 768, "masks": None, "background": "black", "flash_offset": None}},
        ),
        (
            "train data -o f.safetensors --masks m --flash-offset 0.1,0.2,-0.3",
            (Path("data"), Path("f.safetensors")),
            {"preset": "fast", "minutes": None, "steps": None, "seed": 0, "tensorboard": None, "field": None,
             "further": False, "began": ANY, "ntf": None, "augmentation": True, "colour_loss": True,
             "visibility_mlp": False, "bounces": True, "fresnel": True, "gains": True, "smoke": None, "estimate": False,
             "view": False,
             "reading": {"size": None, "masks": Path("m"), "background": None, "flash_offset": (0.1, 0.2, -0.3)}},
        ),
        (
            "view s.xml -D light=env -D spp=2 --size 128 --samples 8 --port 9000",
            (Path("s.xml"), {"light": "env", "spp": "2"}, 128, 8, "127.0.0.1", 9000, Environment()),
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
        ("swap s.xml f.safetensors -o out.xml", (Path("s.xml"), Path("f.safetensors"), Path("out.xml"), "", {}), {}),
        ("compare a.exr b.exr", (Path("a.exr"), Path("b.exr"), None), {}),
        ("compare a.exr b.exr -o c.png", (Path("a.exr"), Path("b.exr"), Path("c.png")), {}),
        ("explain s.xml -D spp=4 -D light=env", (Path("s.xml"), {"spp": "4", "light": "env"}, False,
                                                Environment()), {}),
        ("explain s.xml --measure --env-rotate 90", (Path("s.xml"), {}, True, Environment(rotate=90.0)), {}),
        ("tradeoff s.xml -D a=4 --budget 2m --env-scale 0.5",
         (Path("s.xml"), Path("tradeoff"), {"a": "4"}, 120.0, None), {"environment": Environment(scale=0.5)}),
        ("tradeoff s.xml -o d --reference m.xml", (Path("s.xml"), Path("d"), {}, 300.0, Path("m.xml")),
         {"environment": Environment()}),
        ("info f.safetensors", (Path("f.safetensors"),), {}),
    ],
)
def test_commands_pass_their_arguments_on(calls: list, line: str, args: tuple, kwargs: dict):
    assert cli.main(line.split()) == 0
    assert calls == [(args, kwargs)]


@pytest.mark.parametrize("line", ["compare a b --json", "train d -o f.safetensors --json", "explain s.xml --json",
                                  "info f --json", "inspect d --json", "tradeoff s.xml --json"])
def test_json(calls: list, line: str, capsys: pytest.CaptureFixture[str]):
    assert cli.main(line.split()) == 0
    assert json.loads(capsys.readouterr().out) == {"psnr": 30.5, "inner": {"a": 1}}


def test_limits_of_compare_decide_the_exit_code(calls: list, capsys: pytest.CaptureFixture[str]):
    assert cli.main("compare a b --min-psnr 30.5".split()) == 0
    out, err = capsys.readouterr()
    first = "starting compare\n"  # only before the first import of a package that takes long
    assert (out, err.removeprefix(first)) == ("table 30.5\n", "comparing a\n")
    assert cli.main("compare a b --min-psnr 31 --max-flip 0.5".split()) == 1
    out, err = capsys.readouterr()
    assert out == "table 30.5\n"
    assert err.removeprefix(first) == (
        "comparing a\nmi-ntf: PSNR is 30.5 dB, less than --min-psnr 31 allows\n"
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
        "train data -o f.safetensors --minutes 1 --steps 5",
        "train data -o f.safetensors --continue --overwrite",
        "train data -o f.safetensors --asymmetry 0.5",
        "train data -o f.safetensors --flash-offset 1,2",
        "train data -o f.safetensors --flash-offset up",
        "capture s.xml data --flash-offset estimate",
        "inspect data --flash-offset up",
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


@pytest.mark.parametrize(("line", "said"), [
    ("train x", "train needs -o FILE"),
    ("capture", "capture needs SCENE.xml and DIR"),
    ("train x -o", "--output needs a value"),
    ("train x -o f --minutes ten", "--minutes is 'ten', must be a number"),
    ("inspect x --size=2.5", "--size is '2.5', must be a whole number"),
    ("explain x --env-scale z", "--env-scale is 'z', must be a number"),
    ("train x -o f --preset slow", "--preset is 'slow', must be fast or paper"),
    ("train x -o f --ntf slow", "--ntf is 'slow', must be logistic, mixture2, paper or ray"),
    ("train x -o f --background white", "--background is 'white', must be black"),
    ("sequence x -o d --engine pbs", "--engine is 'pbs', must be dask, local or submitit"),
    ("train x -o f --minuts=3", "train has no option --minuts; did you mean --minutes?"),
    ("train x -o f --zzz", "train has no option --zzz"),
    ("capture s.xml -o DIR", "capture has no option -o"),  # in place of "folder needs a value"
    ("capture s.xml --vews 3", "capture has no option --vews; did you mean --views?"),
    ("train x -m cuda_ad_rgb", "train has no option -m"),
    ("capture s.xml -D", "--define needs a value"),
    ("capture s.xml d --flash-offset -1,2 --test_views x", "--test-views is 'x', must be a whole number"),
    ("capture a b c", "capture has no place for 'c': it is one argument too many"),
    ("render", "the following arguments are required: SCENE.xml"),
    ("render --env-rotate far x", "argument --env-rotate: invalid float value: 'far'"),
])
def test_bad_usage_is_one_sentence_with_option_value_and_what_is_legal(line: str, said: str, capsys):
    assert cli.main(line.split()) == 2
    remedy = "" if said.endswith("?") else f"; `mi-ntf {line.split()[0]} -h` describes the options"
    assert capsys.readouterr().err == f"mi-ntf: error: {said}{remedy}\n"


@pytest.mark.parametrize("name", cli.COMMANDS)
def test_every_command_answers_bad_usage_with_one_line(name: str, capsys):
    for words in ([name, "--no-such-option"], [name, *["a"] * 9, "--size"]):
        assert cli.main(words) == 2
        assert re.fullmatch(r"mi-ntf: error: .*\n", capsys.readouterr().err)


HELP = re.compile(r"^  (?:--?\w|SCENE\.xml|[A-Z]{3,}\b)")
"""Beginning of the lines of a help that name an argument."""


@pytest.mark.parametrize("command", ["", *cli.COMMANDS])
def test_help_fits_a_terminal_and_describes_every_argument(command: str, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main([*command.split(), "-h"]) == 0
    text = capsys.readouterr().out
    assert max(map(len, text.splitlines())) <= 80
    assert "None" not in text and "PATH PATH" not in text and "False" not in text
    lines = text.partition("\n\n")[2].splitlines()
    named = [i for i, line in enumerate(lines) if command and HELP.match(line)]
    assert bool(named) == bool(command)
    for i in named:  # a description beside the name, or below it
        assert re.match(r" +\S.*? {2,}\S", lines[i]) or re.match(r" {5,}[A-Za-z.]", lines[i + 1]), lines[i]


def test_help_of_the_program_names_every_command(capsys):
    assert cli.main(["--help"]) == 0
    whole = capsys.readouterr().out
    assert all(re.search(rf"^  {name} +\S", whole, re.M) for name in cli.COMMANDS)
    assert cli.main([]) == 2
    assert capsys.readouterr().err == whole
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"mi-ntf {mi_ntf.__version__}\n"
    assert cli.main(["tradoff"]) == 2
    assert "there is no command 'tradoff'; did you mean tradeoff?" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["render", "sequence", "view", "explain", "tradeoff", "bake"])
def test_commands_that_render_a_scene_have_the_same_options_for_it(command: str, capsys):
    assert cli.main([command, "-h"]) == 0
    text = capsys.readouterr().out
    for option in ("-m VARIANT, --mode VARIANT", "-D KEY=VALUE, --define KEY=VALUE", "--env FILE", "--env-rotate DEG",
                   "--env-scale S"):
        assert option in text


@pytest.mark.parametrize("command", ["explain s.xml", "bake s.xml -o m.exr", "sequence s.xml -o d", "render s.xml",
                                     "capture s.xml d", "view s.xml", "tradeoff s.xml"])
def test_an_unknown_variant_is_named_by_every_command(command: str, calls: list, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main([*command.split(), "-m", "llvm_rgb"]) == 1
    assert "unknown variant 'llvm_rgb'; this Mitsuba has scalar_rgb" in capsys.readouterr().err
    assert calls == []


def test_choices_of_the_training_are_those_of_the_help():
    pytest.importorskip("torch")
    from mi_ntf.train import config

    hints = typing.get_type_hints(fields.Train)
    assert typing.get_args(hints["preset"]) == tuple(config.PRESETS)
    assert typing.get_args(typing.get_args(hints["ntf"])[0]) == tuple(config.NTF)


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


def test_a_finished_field_is_trained_further_or_replaced_only_on_request(calls: list, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("f.safetensors").write_text("finished")
    assert cli.main("train d -o f.safetensors".split()) == 1
    assert capsys.readouterr().err == ("mi-ntf: error: f.safetensors exists; add --continue to train it further or "
                                       "--overwrite to replace it, or choose another name\n")
    assert calls == [] and Path("f.safetensors").read_text() == "finished"
    assert cli.main("train d -o f.safetensors --overwrite".split()) == 0
    assert cli.main("train d -o f.safetensors --continue".split()) == 0
    assert [kwargs["further"] for _, kwargs in calls] == [False, True]


@pytest.mark.parametrize(("manifest", "following"), [
    (None, "mi-ntf info out/f.safetensors"),
    ('{"scene": "gone.xml", "folder": ".."}', "mi-ntf info out/f.safetensors"),
    ('{"scene": "m.xml"}', "mi-ntf swap m.xml out/f.safetensors -o nrf.xml"),
    ('{"scene": "m.xml", "shapes": "not:floor"}', "mi-ntf swap m.xml out/f.safetensors -o nrf.xml --shapes not:floor"),
    ('{"scene": "n.xml", "folder": "../a scene", "parameters": {"size": "2"}}',
     "mi-ntf swap 'a scene/n.xml' out/f.safetensors -o nrf.xml -D size=2"),
])
def test_training_ends_with_the_files_a_verdict_and_the_next_command(calls: list, tmp_path, monkeypatch, capsys,
                                                                     manifest, following):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys.modules["mi_ntf.train"], "train",
                        lambda *_, **__: {"verdict": "the field is good: test views have 31.2 dB"})
    for folder in (Path("d"), Path("a scene")):
        folder.mkdir()
    for scene in (Path("m.xml"), Path("a scene/n.xml")):
        scene.touch()
    if manifest:
        Path("d/capture.json").write_text(manifest)
    assert cli.main("train d -o out/f.safetensors".split()) == 0
    assert capsys.readouterr().out.splitlines() == [
        "field: out/f.safetensors", "page: out/f.html (open it in a browser)",
        "the field is good: test views have 31.2 dB", f"next: {following}"]


def test_missing_extra_points_to_doctor(calls: list, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "mi_ntf.train", None)
    assert cli.main(["train", "data", "-o", "f.safetensors"]) == 1
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

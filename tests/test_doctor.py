"""Checks and remedies of `mi-ntf doctor`."""

import json
from importlib.metadata import version
from pathlib import Path

from helpers.programs import run_on_one_core, run_program

from mi_ntf import doctor


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
    printed = capsys.readouterr().out
    assert f"thing: {remedy}" in printed and printed.endswith("no scene can be rendered; mend what is marked ✘\n")

"""Decisions of the set-up script before it touches the machine."""

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[1] / "tools" / "setup_env.py"


@pytest.fixture
def setup_env(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """The script as a module; it must not run anything in these tests."""
    spec = importlib.util.spec_from_file_location("setup_env", SCRIPT)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    monkeypatch.setattr(module, "run", lambda *command: pytest.fail(f"ran {command}"))
    return module


def libraries(module: ModuleType, monkeypatch: pytest.MonkeyPatch, folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).touch()
    monkeypatch.setattr(module, "LLVM_FOLDERS", (str(folder),))


def test_newest_good_llvm_wins(setup_env, monkeypatch, tmp_path):
    names = ("libLLVM-14.so.1", "libLLVM-17.so.1", "libLLVM.so.19.1", "libLLVM-9.so", "libLLVM.so", "libLLVMFoo.so.30")
    libraries(setup_env, monkeypatch, tmp_path, *names)
    assert setup_env.find_llvm() == tmp_path / "libLLVM.so.19.1"


def test_old_llvm_does_not_count(setup_env, monkeypatch, tmp_path):
    libraries(setup_env, monkeypatch, tmp_path, "libLLVM-15.so.1", "libLLVM-16.so")
    assert setup_env.find_llvm() is None


def test_explicit_llvm_is_taken(setup_env, monkeypatch, tmp_path):
    libraries(setup_env, monkeypatch, tmp_path, "mine.so")
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", str(tmp_path / "mine.so"))
    assert setup_env.find_llvm() == tmp_path / "mine.so"


def test_ordinary_user_gets_the_command(setup_env, monkeypatch):
    monkeypatch.setattr(setup_env, "find_llvm", lambda: None)
    monkeypatch.setattr(setup_env.os, "geteuid", lambda: 1000)
    monkeypatch.setattr(setup_env.shutil, "which", lambda name: "/usr/bin/apt-get" if name == "apt-get" else None)
    with pytest.raises(
        SystemExit, match=r"system packages are missing. Run:\n    sudo apt-get install g\+\+ .*libllvm19"
    ):
        setup_env.system_packages()


def test_other_systems_get_the_names(setup_env, monkeypatch):
    monkeypatch.setattr(setup_env, "find_llvm", lambda: None)
    monkeypatch.setattr(setup_env.shutil, "which", lambda name: "/usr/bin/c++" if name == "c++" else None)
    with pytest.raises(SystemExit, match=r"missing: .*libllvm19 \(names of Debian\)[^$]*package manager"):
        setup_env.system_packages()


def test_fingerprint_follows_the_sources(setup_env, monkeypatch, tmp_path):
    for name in ("pyproject.toml", "constraints.txt", "mi_ntf/bridge_source/bridge.cpp"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(name)
    monkeypatch.setattr(setup_env, "ROOT", tmp_path)
    monkeypatch.setattr(setup_env, "CONSTRAINTS", tmp_path / "constraints.txt")
    before = setup_env.fingerprint()
    assert setup_env.fingerprint() == before
    (tmp_path / "mi_ntf" / "bridge_source" / "bridge.cpp").write_text("changed")
    assert setup_env.fingerprint() != before

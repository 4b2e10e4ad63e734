"""Places, suffixes and extras that `mi-ntf` checks before the work."""

import sys

import pytest

from mi_ntf import cli


@pytest.mark.parametrize(("line", "name", "right"), [
    ("train d -o f.png", "f.png", ".safetensors"),
    ("refine s.xml d -o f.png", "f.png", ".safetensors"),
    ("export f.safetensors -o m.png", "m.png", ".ply, .obj, .glb, .stl, .vol or .vdb"),
    ("swap s.xml f.safetensors -o n.exr", "n.exr", ".xml"),
    ("bake s.xml -o m.png", "m.png", ".exr"),
    ("inspect d -o p.txt", "p.txt", ".html"),
    ("compare a.exr b.exr -o c.exr", "c.exr", ".png"),
])
def test_a_wrong_suffix_is_an_error_before_the_work(line, name, right, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(line.split()) == 1
    assert f"{name}: the name ends in '.{name[-3:]}', expected {right}" in capsys.readouterr().err


@pytest.mark.parametrize("line", ["export f.safetensors -o new/m.ply", "swap s.xml f.safetensors -o new/n.xml",
                                  "bake s.xml -o new/m.exr"])
def test_a_finished_file_is_replaced_only_on_request(line, tmp_path, monkeypatch, capsys):
    """The folder is made; then the scene or field that does not exist ends the work."""
    monkeypatch.chdir(tmp_path)
    path = tmp_path / line.split()[-1]
    assert cli.main(line.split()) == 1
    assert "does not exist" in capsys.readouterr().err and path.parent.is_dir()
    path.write_text("finished")
    assert cli.main(line.split()) == 1
    assert f"new/{path.name} exists; choose another name, or add --overwrite to replace it" in capsys.readouterr().err
    assert cli.main([*line.split(), "--overwrite"]) == 1
    assert "does not exist" in capsys.readouterr().err and path.read_text() == "finished"


@pytest.mark.parametrize(("line", "module", "extra"), [
    ("train d -o f.safetensors", "torch", "train"),
    ("train d -o f.safetensors --view", "viser", "view"),
    ("inspect d", "matplotlib", "train"),
    ("refine s.xml d -o f.safetensors", "matplotlib", "train"),
    ("view s.xml", "viser", "view"),
    ("export f.safetensors -o m.ply", "trimesh", "mesh"),
    ("compare a.exr b.exr", "skimage", "eval"),
    ("compare a.exr b.exr -o c.png", "matplotlib", "eval"),
    ("tradeoff s.xml", "matplotlib", "eval"),
    ("sequence s.xml -o d --film f.mp4", "imageio_ffmpeg", "video"),
    ("sequence s.xml -o d --engine dask --workers 2", "distributed", "cluster"),
    ("capture s.xml d --engine submitit --workers 2", "submitit", "cluster"),
])
def test_a_missing_extra_is_named_before_the_work(line, module, extra, tmp_path, monkeypatch, capsys):
    """The scenes, fields and photographs do not exist, which would be the next error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, module, None)
    assert cli.main(line.split()) == 1
    message = capsys.readouterr().err
    assert message.endswith(f"needs the extra `{extra}` ({module} missing): run pip install 'mi-ntf[{extra}]'\n")
    assert list(tmp_path.iterdir()) == []

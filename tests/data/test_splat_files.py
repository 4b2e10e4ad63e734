"""Files of Gaussian splats: what is read, and one sentence for whatever is damaged or foreign."""

import gzip
import warnings

import numpy as np
import pytest
from helpers import mutate
from helpers.splats import spz_bytes, write_ply

from mi_ntf.core.errors import MiNtfError
from mi_ntf.core.splats import Splats, matrices
from mi_ntf.data import splat_files


@pytest.fixture(scope="module")
def splats() -> Splats:
    rng = np.random.default_rng(7)
    turns = rng.normal(size=(30, 4))
    return Splats(rng.uniform(-2, 2, (30, 3)), np.exp(rng.uniform(-5, 0, (30, 3))),
                  turns / np.linalg.norm(turns, axis=1, keepdims=True), rng.uniform(0.02, 0.98, 30),
                  rng.uniform(0, 1, (30, 3)))


def same(read: Splats, splats: Splats, place=1e-6, scale=1e-5, turn=1e-5, value=1e-5) -> bool:
    turned = np.abs(matrices(read.rotations) - matrices(splats.rotations)).max()
    return (np.abs(read.centres - splats.centres).max() < place and turned < turn
            and np.abs(np.log(read.scales / splats.scales)).max() < scale
            and np.abs(read.opacities - splats.opacities).max() < value
            and np.abs(read.colours - splats.colours).max() < value)


def test_a_ply_of_gaussian_splatting_is_read(splats, tmp_path):
    assert same(splat_files.read(write_ply(tmp_path / "a.ply", splats)), splats)


@pytest.mark.parametrize("form", ["ascii", "binary_big_endian"])
def test_other_forms_of_ply_hold_the_same(splats, tmp_path, form):
    """Text, and bytes in the other order, with comments and further properties."""
    data = write_ply(tmp_path / "a.ply", splats).read_bytes()
    end = data.index(b"end_header\n") + len(b"end_header\n")
    table = np.frombuffer(data[end:], "<f4").reshape(len(splats), -1)
    body = "\n".join(" ".join(repr(float(v)) for v in row) for row in table).encode() if form == "ascii" else (
        table.astype(">f4").tobytes())
    header = data[:end].replace(b"binary_little_endian", form.encode()).replace(b"\nelement", b"\ncomment x\nelement")
    (tmp_path / "b.PLY").write_bytes(header + body)
    assert same(splat_files.read(tmp_path / "b.PLY"), splats)


@pytest.mark.parametrize("version", [1, 2, 3])
def test_spz_holds_the_same_to_its_precision(splats, tmp_path, version):
    """Scales have steps of 1/16 in the logarithm; version 3 has finer rotations."""
    path = tmp_path / "a.spz"
    path.write_bytes(spz_bytes(splats, version))
    read = splat_files.read(path)
    assert same(read, splats, 2e-3, 0.04, 0.006 if version == 3 else 0.2, 0.02)


def test_splats_without_finite_values_are_left_out(splats, tmp_path):
    path = write_ply(tmp_path / "a.ply", splats)
    data = bytearray(path.read_bytes())
    begin = data.index(b"end_header\n") + len(b"end_header\n")
    data[begin : begin + 4] = np.float32(np.nan).tobytes()
    path.write_bytes(data)
    assert len(splat_files.read(path)) == len(splats) - 1


def test_each_fault_has_its_sentence(splats, tmp_path):
    """Files that are missing, foreign, cut off, compressed or newer."""
    ply = write_ply(tmp_path / "a.ply", splats).read_bytes()
    mesh = (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"end_header\n0 0 0\n")
    newer = bytearray(gzip.decompress(spz_bytes(splats)))
    newer[4] = 9
    cases = {
        "none.ply": (None, "cannot read"), "a.obj": (b"", "expected .ply or .spz"), "b.ply": (b"solid", "is no PLY"),
        "c.ply": (mesh, "f_dc_0.*holds no Gaussian splats"), "d.ply": (ply[:-50], "ends after 29 of 30 splats"),
        "e.ply": (mesh.replace(b"float x", b"uint packed_position"), "compressed"),
        "f.ply": (ply.replace(b"vertex 30", b"vertex 0"), "has 0 splats"),
        "g.ply": (ply.replace(b"element vertex", b"element chunk 1\nelement vertex"), "first element is"),
        "h.ply": (ply.replace(b"property float nx", b"property list uchar int nx"), "header is damaged"),
        "a.spz": (b"NGSP" + bytes(40), "version 4 or newer"), "b.spz": (b"PK", "is no .spz"),
        "c.spz": (gzip.compress(newer), "version 9"), "d.spz": (gzip.compress(bytes(newer[:4]) + b"\x02" + bytes(3)
                                                                              + bytes(newer[8:60])), "announces 30"),
        "i.ply": (ply[: ply.index(b"end_header\n") + 11] + b"\xff" * (30 * 17 * 4), "none of its 30 splats"),
    }
    for name, (content, expected) in cases.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(MiNtfError, match=expected):
            splat_files.read(tmp_path / name)


def fuzz(splats: Splats, folder, count: int) -> int:
    """Read files with seeded damage; return the number of those that were refused by a sentence."""
    ply, refused = write_ply(folder / "a.ply", splats).read_bytes(), 0
    text = ply[: ply.index(b"end_header\n") + 11].decode()
    for seed in range(count):
        rng = np.random.default_rng(seed)
        kind = seed % 4
        path = folder / ("b.spz" if kind > 1 else "b.ply")
        if kind == 0:
            path.write_bytes(mutate.blob(rng, ply, len(text)))
        elif kind == 1:
            path.write_bytes(mutate.words(rng, text).encode() + ply[len(text):])
        else:
            content = spz_bytes(splats, 2 + seed // 4 % 2)
            path.write_bytes(mutate.blob(rng, content) if kind == 2 else gzip.compress(
                mutate.blob(rng, gzip.decompress(content), 16)))
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                read = splat_files.read(path)
                assert all(np.isfinite(getattr(read, name)).all() for name in ("centres", "scales", "colours"))
            except MiNtfError as error:
                refused += 1
                assert str(path) in str(error) and "\n" not in str(error) and len(str(error)) < 400
    return refused


def test_damaged_files_are_read_or_refused(splats, tmp_path):
    assert fuzz(splats, tmp_path, 60) > 10


@pytest.mark.slow
def test_many_damaged_files_are_read_or_refused(splats, tmp_path):
    assert fuzz(splats, tmp_path, 1200) > 200

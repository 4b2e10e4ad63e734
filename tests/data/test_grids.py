"""Grids of other programs: every name and form arrives at its place, and other forms are one sentence."""

import importlib.util
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from mi_ntf.core.errors import MiNtfError
from mi_ntf.data import grids, vdb

X_FIRST = np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
"""Density (x, y, z) of 2 × 3 × 4 voxels."""
Z_FIRST = X_FIRST.transpose(2, 1, 0)
COLOURS = np.stack([Z_FIRST / 30, Z_FIRST / 50, 1 - Z_FIRST / 24], -1)
BOX = np.array([[-1.0, 0.0, 2.0], [1.0, 0.5, 7.0]])


def saved(folder, **arrays):
    """Return an archive of these arrays."""
    np.savez(folder / "grid.npz", **arrays)
    return folder / "grid.npz"


@pytest.mark.parametrize("density", ["density", "sigma", "sigmas", "grid", "arr_0"])
@pytest.mark.parametrize("colour, box", [("albedo", "bounds"), ("rgb", "aabb"), ("colors", "bbox")])
def test_the_names_of_arrays(tmp_path, density, colour, box):
    """Density, colours and box are found by the names that programs write."""
    grid = grids.read(saved(tmp_path, **{density: Z_FIRST, colour: COLOURS, box: BOX.ravel()}))
    assert (grid.density == Z_FIRST).all() and np.allclose(grid.albedo, COLOURS) and (grid.bounds == BOX).all()


def test_x_first(tmp_path):
    """The option turns density and colours."""
    grid = grids.read(saved(tmp_path, density=X_FIRST, rgb=COLOURS.transpose(2, 1, 0, 3)), "xyz")
    assert (grid.density == Z_FIRST).all() and np.allclose(grid.albedo, COLOURS)


def test_colour_and_density_in_four_channels(tmp_path):
    """As instant-ngp samples them, in .npy and .npz."""
    rgba = np.concatenate([COLOURS, Z_FIRST[..., None]], -1)
    np.save(tmp_path / "grid.npy", rgba)
    for path in (tmp_path / "grid.npy", saved(tmp_path, rgba=rgba)):
        grid = grids.read(path)
        assert (grid.density == Z_FIRST).all() and np.allclose(grid.albedo, COLOURS)
        assert (grid.bounds == grids.UNIT).all()


@pytest.mark.parametrize("prefix", ["", "estimator."])
def test_the_occupancy_grid_of_nerfacc(tmp_path, prefix):
    """The first of two levels is read, x first, with the first box."""
    arrays = {"occs": np.concatenate([X_FIRST.ravel(), X_FIRST.ravel() + 9]), "resolution": np.array([2, 3, 4]),
              "aabbs": np.stack([BOX.ravel(), 2 * BOX.ravel()])}
    grid = grids.read(saved(tmp_path, **{prefix + name: value for name, value in arrays.items()}))
    assert (grid.density == Z_FIRST).all() and (grid.bounds == BOX).all()
    binaries = np.stack([X_FIRST > 5, X_FIRST > 7])
    assert (grids.read(saved(tmp_path, binaries=binaries), "xyz").density == (Z_FIRST > 5)).all()


def test_a_checkpoint_of_plenoxels(tmp_path):
    """Links lead to density and to the constant harmonic of the colours; negative density is empty."""
    links = np.full((2, 3, 4), -1)
    links[1, 2, 3], links[0, 1, 2] = 0, 1
    harmonics = np.zeros((2, 27), np.float16)
    harmonics[0, [0, 9, 18]] = 0.5, 1.0, -1.0
    grid = grids.read(saved(tmp_path, links=links, density_data=np.array([[3.0], [-2.0]]), sh_data=harmonics,
                            center=np.array([1.0, 2, 3]), radius=np.array([1.0, 1, 2]), basis_type=np.array(1)))
    expected = np.zeros((4, 3, 2))
    expected[3, 2, 1] = 3
    assert (grid.density == expected).all()
    assert np.allclose(grid.albedo[3, 2, 1], 0.5 + grids.SH_CONSTANT * np.array([0.5, 1, -1]), atol=1e-3)
    assert (grid.bounds == [[0, 1, 1], [2, 3, 5]]).all()


def test_a_volume_of_mitsuba(tmp_path):
    """Box and values return; three equal channels are one extinction, others are refused."""
    grids.write_vol(tmp_path / "a.vol", Z_FIRST, BOX)
    grid = grids.read(tmp_path / "a.vol")
    assert (grid.density == Z_FIRST).all() and (grid.bounds == BOX).all()
    data = bytearray((tmp_path / "a.vol").read_bytes())
    data[20:24] = (3).to_bytes(4, "little")
    for values, good in ((np.repeat(Z_FIRST[..., None], 3, 3), True), (COLOURS, False)):
        (tmp_path / "b.vol").write_bytes(data[:48] + values.astype("<f4").tobytes())
        if good:
            assert (grids.read(tmp_path / "b.vol").density == Z_FIRST).all()
        else:
            assert np.allclose(grids.read_albedo(tmp_path / "b.vol"), COLOURS)
            with pytest.raises(MiNtfError, match="another extinction in each"):
                grids.read(tmp_path / "b.vol")


@pytest.mark.parametrize("arrays, expected", [
    ({"weights": Z_FIRST}, "has the arrays 'weights', none of which is a density; name it one of density"),
    ({"density": -Z_FIRST}, "23 values outside the range"),
    ({"density": 0 * Z_FIRST}, "no density above 0"),
    ({"density": Z_FIRST.ravel()}, "expected three axes"),
    ({"density": Z_FIRST, "rgb": 2 * COLOURS}, "expected 0 to 1"),
    ({"density": Z_FIRST, "aabb": BOX[::-1]}, "expected two corners"),
    ({"occs": X_FIRST.ravel()}, "resolution` of 3 numbers"),
    ({"density": Z_FIRST.astype("U4")}, "expected real numbers"),
])
def test_other_archives_are_one_sentence(tmp_path, arrays, expected):
    """The sentence names the array and what is expected."""
    with pytest.raises(MiNtfError, match=expected):
        grids.read(saved(tmp_path, **arrays))


@pytest.mark.parametrize("name, expected", [("none.vol", "does not exist"), ("grid.obj", "the name ends in '.obj'")])
def test_other_files_are_one_sentence(tmp_path, name, expected):
    """The sentence names the endings that are read."""
    (tmp_path / "grid.obj").write_text("v 0 0 0")
    with pytest.raises(MiNtfError, match=expected):
        grids.read(tmp_path / name)


def test_no_reader_of_openvdb_is_one_sentence(tmp_path, monkeypatch):
    """The sentence names the packages."""
    for name in ("openvdb", "pyopenvdb", "bpy"):
        monkeypatch.setitem(sys.modules, name, None)
    (tmp_path / "a.vdb").write_bytes(b"x")
    with pytest.raises(MiNtfError, match="install Debian's python3-openvdb"):
        grids.read(tmp_path / "a.vdb")


class Transform:
    """Scale and translation of an OpenVDB grid."""

    def __init__(self, size):
        self.size, self.offset = size, np.zeros(3)

    def indexToWorld(self, index):
        return tuple(np.array(index) * self.size + self.offset)

    def move(self, offset):
        self.offset = self.offset + offset


class FloatGrid:
    """The part of OpenVDB's grids that is used: dense values from the index (0, 0, 0)."""

    valueTypeName, gridClass = "float", "unknown"

    def copyFromArray(self, values):
        self.values = values.copy()

    def evalActiveVoxelBoundingBox(self):
        active = np.argwhere(self.values)
        return tuple(active.min(0).tolist()), tuple(active.max(0).tolist())

    def copyToArray(self, values, ijk):
        values[:] = 0
        for index in np.argwhere(self.values):
            values[tuple(index - ijk)] = self.values[tuple(index)]


INSTALLED = [name for name in ("openvdb", "pyopenvdb") if importlib.util.find_spec(name)]
"""OpenVDB's own module, where there is one. These tests passed with Debian's OpenVDB 10."""


@pytest.fixture(params=["translate", "postTranslate", *INSTALLED])
def openvdb(request, monkeypatch):
    """Return OpenVDB's module, or a stand-in in its place, with one file in memory.

    OpenVDB 10 has a function called translate, which is called postTranslate in OpenVDB 12.
    """
    if request.param in INSTALLED:
        return importlib.import_module(request.param)
    store = {}
    module = SimpleNamespace(
        __name__="openvdb", FloatGrid=FloatGrid,
        GridClass=SimpleNamespace(FOG_VOLUME="fog volume", LEVEL_SET="level set"),
        createLinearTransform=lambda voxelSize: type("", (Transform,), {request.param: Transform.move})(voxelSize),
        write=lambda path, grids: (open(path, "wb").close(), store.clear(), store.update({g.name: g for g in grids})),
        readAllGridMetadata=lambda path: list(store.values()), read=lambda path, name: store[name])
    monkeypatch.setitem(sys.modules, "openvdb", module)
    return module


def test_openvdb_there_and_back(tmp_path, openvdb):
    """A grid of cubes returns with its values. Its box grows by a voxel of background around the active voxels."""
    box = np.array([[1.0, 2.0, 3.0], [2.0, 3.5, 5.0]])
    vdb.write(tmp_path / "a.vdb", Z_FIRST, box)
    grid = grids.read(tmp_path / "a.vdb")
    first = np.argwhere(Z_FIRST).min(0)
    inside = tuple(slice(1 - a, 1 - a + n) for a, n in zip(first, Z_FIRST.shape, strict=True))
    assert first.max() == 0 and (grid.density[inside] == Z_FIRST).all() and grid.density.sum() == Z_FIRST.sum()
    assert np.allclose(grid.bounds, box + np.array([[-0.5], [0.5]]))


@pytest.mark.parametrize(("names", "level_set", "said"), [
    (("heat", "smoke"), False, "has the grids of numbers 'heat, smoke' apart from level sets, none of which"),
    (("density",), True, "convert a level set to a fog volume"),
])
def test_openvdb_names_the_density(tmp_path, openvdb, names, level_set, said):
    """Two grids of other names, and distances of a level set, are no density."""
    found = []
    for name in names:
        grid = openvdb.FloatGrid()
        grid.copyFromArray(np.ones((3, 3, 3), np.float32))
        grid.name, grid.transform = name, openvdb.createLinearTransform(voxelSize=1.0)
        if level_set:
            grid.gridClass = openvdb.GridClass.LEVEL_SET
        found.append(grid)
    openvdb.write(str(tmp_path / "a.vdb"), grids=found)
    with pytest.raises(MiNtfError, match=said):
        grids.read(tmp_path / "a.vdb")


def test_openvdb_of_another_numpy(tmp_path, monkeypatch):
    """A module that cannot exchange arrays is named, and the file is not called damaged."""
    def fail(self, values):
        raise ImportError("numpy.core.multiarray failed to import")

    monkeypatch.setattr(FloatGrid, "copyFromArray", fail)
    monkeypatch.setitem(sys.modules, "openvdb", SimpleNamespace(__name__="openvdb", FloatGrid=FloatGrid))
    (tmp_path / "a.vdb").write_bytes(b"x")
    with pytest.raises(MiNtfError, match="OpenVDB's module openvdb cannot read arrays of NumPy"):
        grids.read(tmp_path / "a.vdb")


def test_openvdb_has_cubes(tmp_path, openvdb):
    """Voxels of three lengths are refused with a remedy."""
    with pytest.raises(MiNtfError, match=r"write a \.vol file"):
        vdb.write(tmp_path / "a.vdb", Z_FIRST, BOX)


def test_the_axes_of_an_albedo_are_turned_with_those_of_its_density(tmp_path):
    np.save(tmp_path / "albedo.npy", np.moveaxis(COLOURS, (0, 1, 2), (2, 1, 0)))
    np.testing.assert_array_equal(grids.read_albedo(tmp_path / "albedo.npy", "xyz"), COLOURS)


def test_a_density_of_one_channel(tmp_path):
    assert (grids.read(saved(tmp_path, density=Z_FIRST[..., None])).density == Z_FIRST).all()

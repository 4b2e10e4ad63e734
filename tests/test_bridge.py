"""The stock program `mitsuba` of the wheel loads plugins written in Python.

A stand-in for `mi_ntf.render` registers Mitsuba's `prb` as the integrator `nrf`, and a medium of that name.
"""

import os
import re
import shutil
import subprocess
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
from helpers.programs import run_program

from mi_ntf import bridge, build_bridge
from mi_ntf.core.errors import MiNtfError

SCENE = """
<scene version="3.0.0">
  <default name="integrator" value="nrf"/>
  <integrator type="$integrator"><integer name="max_depth" value="3"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
    <film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="8"/></film>
    <sampler type="independent"><integer name="sample_count" value="4"/></sampler>
  </sensor>
  <emitter type="point"><point name="position" value="1,2,4"/></emitter>
  <shape type="sphere"/>
</scene>
"""

# Python reads a module of this name at its start, wherever it lies on the path.
STAND_IN = """
import importlib.util, sys, types

def register():
    import mitsuba as mi

    class Fog(mi.Medium):
        def __init__(self, props):
            mi.Medium.__init__(self, props)
            self.density = props["density"]

    class Traced(mi.ad.integrators.prb.PRBIntegrator):
        def render(self, scene, sensor=0, seed=0, spp=0, develop=True, evaluate=True):
            assert "torch" not in sys.modules
            if self.max_depth == 77:
                raise ValueError("a fault while rendering")
            image = super().render(scene, sensor, seed, spp, True, evaluate)
            return image if develop else mi.TensorXf()

    kinds = lambda props: Fog(props) if "density" in props else Traced(props)
    keep.append(kinds)
    mi.register_integrator("nrf", kinds)

keep = []
stand_in = types.ModuleType("mi_ntf.render")
stand_in.register = register
stand_in.__path__ = [importlib.util.find_spec("mi_ntf").submodule_search_locations[0] + "/render"]  # its rooms are real
sys.modules["mi_ntf.render"] = stand_in
"""


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    return path


@pytest.fixture
def stand_in(tmp_path: Path) -> dict[str, str]:
    """Environment variables under which a stand-in takes the place of mi_ntf.render."""
    folder = tmp_path / "stand_in"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(STAND_IN)
    return {"PYTHONPATH": str(folder)}


def test_it_is_installed_for_this_mitsuba_under_every_name():
    assert build_bridge.missing_names() == []


def test_no_plugin_of_mitsubas_own_is_replaced(tmp_path: Path):
    """An older build of this package replaced six of them."""
    ours = {file.stem for file in build_bridge.plugin_folder().glob("*.so") if build_bridge.built_for(file)}
    assert ours == {"nrf", "ntf"}
    code = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
integrators = "prb", "prb_basic", "prbvolpath", "direct_projective", "prb_projective", "volprim_rf_basic"
for name in integrators:
    assert type(mi.load_dict({"type": name})).__module__ == f"mitsuba.python.ad.integrators.{name}", name
"""
    done = run_program("python", "-c", code, cwd=tmp_path)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def plugin_folder(tmp_path: Path, monkeypatch) -> Path:
    """An empty folder in place of that of Mitsuba's plugins."""
    monkeypatch.setattr(build_bridge, "plugin_folder", lambda: tmp_path)
    return tmp_path


def test_it_is_built_and_removed_again(plugin_folder: Path):
    assert build_bridge.missing_names() == ["nrf", "ntf"]
    assert {file.name for file in build_bridge.build()} == {"nrf.so", "ntf.so"} == set(os.listdir(plugin_folder))
    assert build_bridge.built_for(plugin_folder / "ntf.so") == mi.__version__ and build_bridge.missing_names() == []
    assert len(build_bridge.remove()) == 2 and not os.listdir(plugin_folder) and build_bridge.remove() == []


@pytest.mark.parametrize("compiler, expected", [("", "no C.. compiler"), ("false", "did not compile")])
def test_a_missing_or_failing_compiler_is_named_and_changes_nothing(plugin_folder, monkeypatch, compiler, expected):
    (plugin_folder / "nrf.so").write_bytes(b"former")
    monkeypatch.setenv("CXX", compiler)
    monkeypatch.setattr(build_bridge, "COMPILERS", ())
    with pytest.raises(MiNtfError, match=expected):
        build_bridge.build()
    assert os.listdir(plugin_folder) == ["nrf.so"] and (plugin_folder / "nrf.so").read_bytes() == b"former"


def test_the_version_is_read_from_the_library(tmp_path: Path):
    library = tmp_path / "nrf.so"
    assert build_bridge.built_for(library) == ""
    library.write_bytes(b"\x7fELF\0mi_ntf bridge for mitsuba 3.8.0\0more")
    assert build_bridge.built_for(library) == "3.8.0"
    library.write_bytes(b"\x7fELF\0more")
    assert build_bridge.built_for(library) == ""


def test_a_bridge_for_another_mitsuba_names_the_remedy():
    assert "built for mitsuba 3.8.0" in bridge.serve("nrf", "llvm_ad_rgb", "mitsuba 3.8.0")
    assert "run `mi-ntf bridge`" in bridge.serve("nrf", "llvm_ad_rgb")


@pytest.mark.parametrize("runs", [4, pytest.param(20, marks=pytest.mark.slow)])
def test_runs_in_a_row_end_well(scene: Path, stand_in: dict[str, str], runs):
    for _ in range(runs):
        done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""


def test_program_equals_python(scene: Path, stand_in: dict[str, str]):
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-o", "image.exr", scene, cwd=scene.parent, **stand_in)
    assert done.returncode == 0, done.stderr
    mi.set_variant("llvm_ad_rgb")
    expected = np.array(mi.render(mi.load_file(str(scene), integrator="prb"), seed=0))
    image = np.array(mi.Bitmap(str(scene.parent / "image.exr")))[..., :3]
    # The film stores 16-bit floats: relative error 2^-11, here of values up to about 0.1.
    np.testing.assert_allclose(image, expected[..., :3], rtol=5e-4, atol=1e-6)
    assert expected.max() > 0.01


@pytest.mark.parametrize("name", ["prb", "direct_projective"])
def test_look_alike_renders_mitsubas_python_integrators(scene: Path, name: str):
    """The stock program cannot load them, since it has no Python."""
    flags = ("-m", "llvm_ad_rgb", f"-Dintegrator={name}", "-o", "image.exr")
    done = run_program("mi-ntf", "render", *flags, scene, cwd=scene.parent)
    assert done.returncode == 0, done.stderr
    assert np.array(mi.Bitmap(str(scene.parent / "image.exr")))[..., :3].max() > 0.01
    done = run_program("mitsuba", *flags, scene, cwd=scene.parent)
    assert done.returncode != 0 and f'Plugin "{name}" not found' in done.stderr


def test_from_another_folder_by_relative_path(scene: Path, stand_in: dict[str, str], tmp_path: Path):
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", "-o", "here.exr", f"../{scene.name}", cwd=elsewhere, **stand_in)
    assert done.returncode == 0, done.stderr
    assert (elsewhere / "here.exr").is_file()


def test_program_keeps_its_messages(scene: Path, stand_in: dict[str, str]):
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
    # Importing Mitsuba in Python raises the log level; messages after that show it was put back.
    assert 'Developing "' in done.stdout


def test_scalar_variant_is_refused_in_one_sentence(scene: Path):
    done = run_program("mitsuba", "-m", "scalar_rgb", scene, cwd=scene.parent)
    assert done.returncode != 0
    assert 'plugin "nrf" works in ' in done.stderr
    assert 'not in "scalar_rgb": run `mitsuba -m llvm_ad_rgb' in done.stderr
    assert "Traceback" not in done.stderr


def test_spectral_variant_is_refused_for_fields():
    with pytest.raises(ValueError, match=r'"nrf" works in cuda_ad_rgb and llvm_ad_rgb, not in "llvm_ad_spectral"'):
        bridge.check_variant("nrf", "llvm_ad_spectral")


def test_misspelt_property_is_named_with_its_line(scene: Path, stand_in: dict[str, str]):
    scene.write_text(SCENE.replace("max_depth", "max_deep"))
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
    assert done.returncode != 0
    assert "line 4" in done.stderr
    assert 'unreferenced property in integrator plugin of type "nrf"' in done.stderr
    assert "max_deep" in done.stderr


def test_constructor_fault_reaches_the_terminal(scene: Path, stand_in: dict[str, str]):
    scene.write_text(SCENE.replace('value="3"', 'value="-3"'))
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
    assert done.returncode == 1
    assert "Traceback" not in done.stderr
    assert re.search(r'"max_depth" must be set to -1.*\(MI_NTF_DEBUG=1 shows where\)', done.stderr)


def test_rendering_fault_reaches_the_terminal(scene: Path, stand_in: dict[str, str]):
    scene.write_text(SCENE.replace('value="3"', 'value="77"'))
    flags = ("-m", "llvm_ad_rgb")
    done = run_program("mitsuba", *flags, scene, cwd=scene.parent, **stand_in)
    assert done.returncode == 1
    assert "exception: ValueError: a fault while rendering (MI_NTF_DEBUG=1 shows where)\n" in done.stderr
    shown = run_program("mitsuba", *flags, scene, cwd=scene.parent, **stand_in, MI_NTF_DEBUG="1")
    assert shown.returncode == 1
    assert "Traceback" in shown.stderr and "in render\nValueError: a fault while rendering\n" in shown.stderr


def test_one_name_serves_medium_and_integrator(scene: Path, stand_in: dict[str, str]):
    medium = (
        '<shape type="sphere"><medium name="interior" type="nrf"><float name="density" value="1"/></medium></shape>'
    )
    scene.write_text(SCENE.replace('<shape type="sphere"/>', medium))
    for _ in range(5):  # medium and integrator are made by threads that may run at the same time
        done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
        assert done.returncode == 0, done.stderr


def test_name_that_registers_nothing_is_an_error(scene: Path, stand_in: dict[str, str]):
    scene.write_text(SCENE.replace('<emitter type="point">', '<emitter type="ntf">'))
    done = run_program("mitsuba", "-m", "llvm_ad_rgb", scene, cwd=scene.parent, **stand_in)
    assert done.returncode != 0
    assert 'mi_ntf registered no plugin "ntf" for variant "llvm_ad_rgb"' in done.stderr


def test_look_alike_writes_the_same_image(scene: Path, stand_in: dict[str, str]):
    flags = ("-m", "llvm_ad_rgb", "-s", "0")
    for program, name in ((["mitsuba"], "a.exr"), (["mi-ntf", "render"], "b.exr")):
        done = run_program(*program, *flags, "-o", name, scene, cwd=scene.parent, **stand_in)
        assert done.returncode == 0, done.stderr
    a, b = (np.array(mi.Bitmap(str(scene.parent / name))) for name in ("a.exr", "b.exr"))
    np.testing.assert_array_equal(a, b)  # same kernels, same seed
    assert a.max() > 0.01


def test_python_registration_survives_the_native_entry(scene: Path, stand_in: dict[str, str]):
    # load_dict asks for the type of "nrf", which loads the native entry over the one from Python.
    code = """
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from mi_ntf.render import register
register()
for _ in range(2):
    assert type(mi.load_dict({"type": "nrf", "density": 2.0})).__name__ == "Fog"
    assert type(mi.load_dict({"type": "nrf"})).__name__ == "Traced"
    assert type(mi.load_dict({"type": "prb"})).__name__ == "PRBIntegrator"
"""
    done = run_program("python", "-c", code, cwd=scene.parent, **stand_in)
    assert done.returncode == 0, done.stderr


NO_LIBPYTHON = """
#include <dlfcn.h>
#include <string.h>
extern "C" void *dlopen(const char *name, int flags) {
    static auto real = (void *(*)(const char *, int)) dlsym(RTLD_NEXT, "dlopen");
    return name && strstr(name, "libpython") ? nullptr : real(name, flags);
}
"""


@pytest.mark.skipif(shutil.which("c++") is None, reason="needs a C++ compiler to hide libpython from the program")
def test_without_shared_libpython_the_look_alike_takes_over(scene: Path, stand_in: dict[str, str]):
    source, library = scene.with_name("hide.cpp"), scene.with_name("hide.so")
    source.write_text(NO_LIBPYTHON)
    subprocess.run(["c++", "-shared", "-fPIC", source, "-o", library, "-ldl"], check=True)
    program = Path(mi.__path__[0]) / "mitsuba"
    flags = ("-m", "llvm_ad_rgb", "-o", "image.exr")
    done = run_program(program, *flags, scene, cwd=scene.parent, LD_PRELOAD=str(library), **stand_in)
    assert done.returncode == 0, done.stderr
    assert "log.py" in done.stdout  # the stock program logs from no Python file here
    assert (scene.parent / "image.exr").is_file()
    done = run_program(program, "-m", "scalar_rgb", scene, cwd=scene.parent, LD_PRELOAD=str(library), **stand_in)
    assert done.returncode == 1
    assert 'not in "scalar_rgb"' in done.stderr

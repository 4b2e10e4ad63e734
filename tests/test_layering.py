"""The direction of dependencies: core ← infer ← render ← sequence ← evaluate, core ← jobs ← data ← train.

Training never imports Mitsuba or Dr.Jit, rendering never imports PyTorch.
"""

import ast
import graphlib
import re
import sys
from pathlib import Path

import pytest
from helpers.programs import run_program

from mi_ntf.core.extras import EXTRAS

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PACKAGE = Path(__file__).parents[1] / "mi_ntf"

MAY_IMPORT = {
    "core": {"core"},
    "jobs": {"core", "jobs"},
    "infer": {"core", "infer"},
    "render": {"core", "infer", "render"},
    "data": {"core", "jobs", "data"},
    "train": {"core", "data", "train"},
    "evaluate": {"core", "jobs", "infer", "render", "data", "evaluate", "sequence"},
    "sequence": {"core", "jobs", "infer", "render", "sequence"},
    "view": {"core", "infer", "render", "evaluate", "view"},
    "refine": {"core", "infer", "render", "data", "refine"},
}
"""Which folders of the package a folder may import."""

ENGINES = {"submitit", "distributed", "dask"}
RENDERER, TORCH = {"mitsuba", "drjit"}, {"torch", "torchmetrics", "tensorboard", "lpips"}

FORBIDDEN = {
    "core": RENDERER | TORCH,
    "jobs": TORCH,  # Dr.Jit's threads are set there, where it is installed
    "infer": TORCH,
    "render": TORCH,
    "data": TORCH,
    "train": RENDERER,
    "sequence": TORCH,
    # Metrics that live in PyTorch are offered where it is installed.
    "evaluate": set(),
    "view": TORCH,
    "refine": TORCH,
}
"""Third parties that a folder must not import, not even inside a function."""

ROOMS = ("log", "timing", "machine", "user_cache", "scene", "lights", "maps", "transport", "plugins", "commands")
"""Of `render`: each may import those before it."""

PACKAGE_OF = {"cv2": "opencv-python-headless", "drjit": "mitsuba", "flip_evaluator": "flip-evaluator",
              "imageio_ffmpeg": "imageio-ffmpeg", "mpl_toolkits": "matplotlib", "PIL": "pillow",
              "skimage": "scikit-image"}
"""What brings a module of another name."""

TOP_LEVEL_FORBIDDEN = TORCH
"""The same for the modules at the top of the package and in `commands`."""


class RunTime(ast.NodeTransformer):
    """Leaves out what is imported for annotations alone."""

    def visit_If(self, node: ast.If):
        return None if ast.unparse(node.test) == "TYPE_CHECKING" else self.generic_visit(node)


def imports_of(file: Path, annotations: bool = True) -> set[str]:
    """Dotted names that a file imports anywhere, for annotations too; relative imports made absolute."""
    names = set()
    package = ("mi_ntf", *file.relative_to(PACKAGE).parent.parts)
    tree = ast.parse(file.read_text())
    for node in ast.walk(tree if annotations else RunTime().visit(tree)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(package[: len(package) - node.level + 1]) if node.level else ""
            module = ".".join(filter(None, [base, node.module]))
            names |= {f"{module}.{alias.name}" for alias in node.names}
    return names


FILES = sorted(PACKAGE.rglob("*.py"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_follow_the_picture(file: Path):
    parts = file.relative_to(PACKAGE).parts
    folder = parts[0] if len(parts) > 1 and parts[0] != "commands" else None
    forbidden = FORBIDDEN[folder] if folder else TOP_LEVEL_FORBIDDEN
    if parts in (("data", "capture.py"), ("data", "capture_scene.py")):
        pass  # the files of `data` that render
    elif folder == "data":
        forbidden = forbidden | RENDERER
    for name in imports_of(file):
        top, *rest = name.split(".")
        assert top not in forbidden, f"{file} imports {name}"
        inner = rest[0] if top == "mi_ntf" and rest else None
        if folder and inner in MAY_IMPORT:
            assert inner in MAY_IMPORT[folder], f"{file} imports {name}"


def module_of(name: str) -> str | None:
    """The module of the package that an imported dotted name is, or lies in; None for others."""
    parts = name.split(".")
    while parts and parts[0] == "mi_ntf":
        path = PACKAGE.parent.joinpath(*parts)
        if path.with_suffix(".py").is_file() or (path / "__init__.py").is_file():
            return ".".join(parts)
        parts.pop()
    return None


@pytest.mark.parametrize("file", sorted((PACKAGE / "render").rglob("*/*.py")), ids=lambda f: "/".join(f.parts[-2:]))
def test_rooms_of_the_renderer_import_those_before_them(file: Path):
    own = ROOMS.index(file.relative_to(PACKAGE / "render").parts[0])
    for name in imports_of(file):
        top, *rest = name.split(".")
        if top == "mi_ntf" and rest[0] == "render":
            assert rest[1] in ROOMS[: own + 1], f"{file} imports {name}"


def test_no_module_imports_itself_by_way_of_others():
    """No import inside a function closes a circle either."""
    graph = {}
    for file in FILES:
        name = ".".join(file.relative_to(PACKAGE.parent).with_suffix("").parts).removesuffix(".__init__")
        graph[name] = {module_of(other) for other in imports_of(file, annotations=False)} - {None, name}
    try:
        graphlib.TopologicalSorter(graph).prepare()
        cycle = []
    except graphlib.CycleError as error:
        cycle = error.args[1]
    assert cycle == []


def test_third_parties_are_declared_where_they_are_used_and_nowhere_else():
    project = tomllib.loads((PACKAGE.parent / "pyproject.toml").read_text())["project"]
    kinds = {"": project["dependencies"], **project["optional-dependencies"]}
    declared = {kind: {re.split("[=<>[;]", name)[0].lower() for name in names} for kind, names in kinds.items()}
    shipped = set().union(*(declared[kind] for kind in kinds if kind not in ("dev", "docs")))
    tops = {name.split(".")[0] for file in FILES for name in imports_of(file)} - {"mi_ntf"} - sys.stdlib_module_names
    # tensorboard is used by way of torch.utils.tensorboard, bokeh by distributed, nanobind's headers by the bridge.
    assert {PACKAGE_OF.get(name, name.lower()) for name in tops} | {"tensorboard", "bokeh", "nanobind"} == shipped
    for extra, modules in EXTRAS.items():
        assert {PACKAGE_OF.get(name, name.lower()) for name in modules} == declared[extra]


def test_relative_imports_are_resolved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    file = PACKAGE / "infer" / "imaginary.py"
    monkeypatch.setattr(Path, "read_text", lambda self: "from ..train import loss\nfrom . import grid\nimport torch.nn")
    assert imports_of(file) == {"mi_ntf.train.loss", "mi_ntf.infer.grid", "torch.nn"}


@pytest.mark.parametrize(
    ("modules", "absent"),
    [
        ("mi_ntf, mi_ntf.cli, mi_ntf.core.field_file", RENDERER | TORCH),
        ("mi_ntf.jobs, mi_ntf.jobs.worker, mi_ntf.jobs.local_engine", RENDERER | TORCH | ENGINES | {"numpy"}),
        ("mi_ntf.data.capture", ENGINES),
        ("mi_ntf.bridge, mi_ntf.launcher, mi_ntf.doctor", TORCH),
    ],
)
def test_nothing_heavy_comes_along(tmp_path: Path, modules: str, absent: set[str]):
    code = f"import sys, {modules}\nprint(sorted({absent!r} & set(sys.modules)))"
    done = run_program("python", "-c", code, cwd=tmp_path)
    assert done.stdout == "[]\n", done.stderr + done.stdout

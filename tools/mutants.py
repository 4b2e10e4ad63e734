"""Change single expressions of the package and see whether the quick tests notice: a seeded sample of such mutants.

    python tools/mutants.py --seed 42 --count 60

Each mutant runs in a copy of the package against its nearest quick tests, up to the first failure: those that
``mutants.toml`` names, else the test files that import the module. Results go to ``out/mutants.json`` after each
mutant; a run that is started again goes on where it ended. What a survivor is stands in ``mutants.toml``, too:
``equivalent`` (no result changes), ``performance`` (time or noise changes, no expected value), or ``gap`` of the tests.
"""

import argparse
import ast
import json
import os
import random
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[1]
FOLDERS = "core", "infer", "render/transport", "render/lights"
CHOOSER = {"choosing", "trials", "probing", "ranking", "omissions", "glints", "estimate", "choice", "passes"}
"""Modules of render/transport that choose a method; left out."""
LIMIT = 180
"""CPU seconds for the tests of one mutant, about 150 s on two cores."""

SWAPS = {ast.Lt: "<=", ast.LtE: "<", ast.Gt: ">=", ast.GtE: ">", ast.Eq: "!=", ast.NotEq: "==", ast.Is: "is not",
         ast.IsNot: "is", ast.In: "not in", ast.NotIn: "in", ast.Add: "-", ast.Sub: "+", ast.Mult: "/", ast.Div: "*",
         ast.FloorDiv: "*", ast.Mod: "*", ast.Pow: "*", ast.BitAnd: "|", ast.BitOr: "&", ast.BitXor: "&",
         ast.LShift: ">>", ast.RShift: "<<", ast.And: "or", ast.Or: "and"}  # fmt: skip
NAMES = {"minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min", "any": "all", "all": "any",
         "sin": "cos", "cos": "sin", "floor": "ceil", "ceil": "floor"}  # fmt: skip
TYPES = re.compile(r"(mi|dr|np|dj|self\.dj)\.\w+|ops|floats?|uint|bool|\w*type|'.*'|type\(.*\)|\*.*|self")
"""Arguments whose swap is an error of Python's, no change of a value."""
SILENT = {"label", "strict", "summary", "mode", "match"}
"""Keyword arguments that decide nothing."""


def skipped(node) -> bool:
    """True for nodes whose content is no behaviour: messages, types, texts."""
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.arg | ast.Import | ast.ImportFrom):
        return True
    if isinstance(node, ast.keyword) and node.arg in SILENT:
        return True
    return isinstance(node, ast.Call) and ast.unparse(node.func) == "mi.Log"


def candidates(path: Path) -> list[dict]:
    """All mutants of a module: place, kind, text before and after."""
    source = path.read_text()
    found: list[dict] = []

    def add(kind, node, text):
        found.append({"file": str(path.relative_to(ROOT)), "line": node.lineno, "column": node.col_offset, "kind": kind,
                      "before": ast.get_source_segment(source, node), "after": text,
                      "statement": isinstance(node, ast.stmt)})

    def visit(node):
        if skipped(node):
            return
        if isinstance(node, ast.Compare) and len(node.ops) == 1:
            left, right = ast.unparse(node.left), ast.unparse(node.comparators[0])
            add("comparison", node, f"{left} {SWAPS[type(node.ops[0])]} {right}")
        elif isinstance(node, ast.BinOp) and type(node.op) in SWAPS:
            add("arithmetic", node, f"({ast.unparse(node.left)}) {SWAPS[type(node.op)]} ({ast.unparse(node.right)})")
        elif isinstance(node, ast.BoolOp):
            add("boolean", node, f" {SWAPS[type(node.op)]} ".join(f"({ast.unparse(v)})" for v in node.values))
        elif isinstance(node, ast.UnaryOp):
            add("boolean" if isinstance(node.op, ast.Not | ast.Invert) else "arithmetic", node,
                f"({ast.unparse(node.operand)})")
        elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
            add("boolean", node, str(not node.value))
        elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
            whole = float(node.value).is_integer() and abs(node.value) < 1e9
            up = node.col_offset % 2
            add("constant", node, repr(node.value + (1 if up else -1) if whole else node.value * (1.25 if up else 0.8)))
        elif isinstance(node, ast.AugAssign) and type(node.op) in SWAPS:
            add("arithmetic", node, f"{ast.unparse(node.target)} {SWAPS[type(node.op)]}= {ast.unparse(node.value)}")
        elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple) and len(node.value.elts) > 1:
            first, second, *rest = (ast.unparse(e) for e in node.value.elts)
            add("return", node, "return " + ", ".join([second, first, *rest]))
        elif isinstance(node, ast.Call):
            calls(node)
        for name, child in ast.iter_fields(node):
            if name in ("annotation", "returns", "decorator_list", "type_params"):
                continue
            for each in child if isinstance(child, list) else [child]:
                if isinstance(each, ast.AST):
                    visit(each)

    def calls(node):
        arguments = [ast.unparse(a) for a in node.args]
        name = ast.unparse(node.func)
        last = name.split(".")[-1]
        if last in NAMES:
            inside = ", ".join(ast.unparse(a) for a in (*node.args, *node.keywords))
            add("function", node, f"{name.removesuffix(last)}{NAMES[last]}({inside})")
        k = 1 if last in ("select", "where") else 0  # the values, not the condition
        pair = arguments[k : k + 2]
        if len(set(pair)) == 2 and last not in ("dot", *NAMES) and not any(TYPES.fullmatch(a) for a in pair):
            arguments[k], arguments[k + 1] = arguments[k + 1], arguments[k]
            inside = ", ".join([*arguments, *(ast.unparse(kw) for kw in node.keywords)])
            add("arguments", node, f"{name}({inside})")

    visit(ast.parse(source))
    return [m for m in found if m["before"] is not None]


def sample(seed: int, count: int) -> list[dict]:
    """`count` mutants, each of another line, drawn evenly from all."""
    files = [f for folder in FOLDERS for f in sorted((ROOT / "mi_ntf" / folder).rglob("*.py"))
             if not (folder == "render/transport" and f.stem in CHOOSER)]
    everything = [m for f in files for m in candidates(f)]
    random.Random(seed).shuffle(everything)
    lines: dict[tuple, dict] = {}
    for m in everything:
        lines.setdefault((m["file"], m["line"]), m)
    print(f"{len(everything)} mutants in {len(files)} modules, {count} drawn with seed {seed}")
    return list(lines.values())[:count]


def tests_of(file: str, nearest: dict) -> list[str]:
    """The test files that are nearest to a module."""
    module = file.removeprefix("mi_ntf/").removesuffix(".py")
    if module in nearest:
        return [f"tests/{name}" for name in nearest[module]]
    stem, dotted = Path(module).name, "mi_ntf." + module.replace("/", ".")
    found = [f for f in sorted((ROOT / "tests").rglob("test_*.py")) if dotted in imports(f)]
    found.sort(key=lambda f: (f.stem != f"test_{stem}", f.parent.name != module.split("/")[0]))
    return [str(f.relative_to(ROOT)) for f in found[:3]] or ["tests/render/test_integrator.py"]


def imports(path: Path) -> set[str]:
    """Names of the modules that a test file imports from, and of what it imports from them."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            found |= {str(node.module), *(f"{node.module}.{alias.name}" for alias in node.names)}
    return found


def changed(mutant: dict) -> str:
    """Text of the mutated module."""
    lines = (ROOT / mutant["file"]).read_text().splitlines(keepends=True)
    begin = sum(len(line.encode()) for line in lines[: mutant["line"] - 1]) + mutant["column"]
    source, before = "".join(lines).encode(), mutant["before"].encode()
    assert source[begin : begin + len(before)] == before, f"{mutant['file']} has changed since the sample was drawn"
    after = mutant["after"] if mutant["statement"] else f"({mutant['after']})"
    return (source[:begin] + after.encode() + source[begin + len(before) :]).decode()


def run(mutant: dict, tests: list[str]) -> dict:
    """Status, seconds and first failure of the `tests` on a copy of the package with this mutant."""
    missing = [test for test in tests if not (ROOT / test).exists()]
    assert not missing, f"mutants.toml names {missing}"
    with tempfile.TemporaryDirectory(prefix="mutant_") as folder:
        copy = Path(folder)
        for part in ("mi_ntf", "tests"):
            shutil.copytree(ROOT / part, copy / part, ignore=shutil.ignore_patterns("__pycache__"))
        for part in ("pyproject.toml", "README.md", "scenes", "examples", "docs", "plugins", "tools"):
            (copy / part).symlink_to(ROOT / part)
        (copy / mutant["file"]).write_text(changed(mutant))
        # An editable installation would find the package before the copy is looked at.
        (copy / "sitecustomize.py").write_text(
            "import sys\nsys.meta_path[:] = [f for f in sys.meta_path if 'Scikit' not in type(f).__name__]\n")
        command = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-m", "not slow and not gpu", "-p",
                   "no:cacheprovider", "--no-header", "--tb=line", *tests]  # fmt: skip
        begin = time.monotonic()
        with open(copy / "log", "w") as log:
            process = subprocess.Popen(command, cwd=copy, stdout=log, stderr=log,
                                       env={**os.environ, "PYTHONPATH": str(copy), "OMP_NUM_THREADS": "2"},
                                       preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 5)))
            code = process.wait()
        text = (copy / "log").read_text()
    failures = [line for line in text.splitlines() if line.startswith(("FAILED", "ERROR"))]
    status = {0: "survived", -signal.SIGXCPU: "stopped"}.get(code, "killed")
    return {"status": status, "code": code, "seconds": round(time.monotonic() - begin), "tests": tests,
            "by": (failures or text.splitlines()[-1:] or [""])[0][:160]}  # fmt: skip


def table(done: list[dict], classes: dict) -> str:
    """All mutants, a line each, and how many there are of each status and class."""
    for m in done:
        m["class"] = "" if m["status"] == "killed" else classes.get(name(m), "not classified")
    lines = [f"{m['status']:8} {m['class']:14} {m['seconds']:4} s  {m['kind']:10} {name(m)}" for m in done]
    counts = Counter(f"{m['status']} {m['class']}" for m in done)
    killed = sum(m["status"] == "killed" for m in done)
    changing = len(done) - sum(m["class"] in ("equivalent", "performance") for m in done)
    return "\n".join([*lines, *(f"{n:4} {what}" for what, n in sorted(counts.items())),
                      f"killed: {killed} of {changing} that change results, {killed / max(changing, 1):.0%}"])


def name(mutant: dict) -> str:
    """Name of a mutant in tables: place, text before and after, on one line."""
    before, after = (" ".join(mutant[key].split()) for key in ("before", "after"))
    return f"{mutant['file'].removeprefix('mi_ntf/')}: {before} → {after}"


def place(mutant: dict) -> tuple:
    """Key of a mutant in a file of results."""
    return mutant["line"], mutant["column"], name(mutant)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--out", type=Path, default=ROOT / "out" / "mutants.json")
    parser.add_argument("--again", action="store_true", help="run those that were not killed once more")
    given = parser.parse_args()
    lists = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    known = {place(m): m for m in (json.loads(given.out.read_text()) if given.out.exists() else [])}
    done = []
    for m in sample(given.seed, given.count):
        found = known.get(place(m))
        if found is None or (given.again and found["status"] != "killed"):
            found = {**m, **run(m, tests_of(m["file"], lists["nearest"]))}
            print(f"{len(done) + 1:3} {found['status']:8} {found['seconds']:4} s  {name(m)}", flush=True)
        done.append(found)
        known[place(m)] = found
        given.out.parent.mkdir(exist_ok=True)
        given.out.write_text(json.dumps(list(known.values()), indent=1, ensure_ascii=False))
    print(table(done, {m["mutant"]: m["class"] for m in lists.get("survivor", [])}))


if __name__ == "__main__":
    main()

"""Change single expressions of the package and see whether the quick tests notice: a seeded sample of such mutants.

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
from collections import Counter
from pathlib import Path

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
FOLDERS = "core", "infer", "render/transport", "render/lights"
CHOOSER = {"choosing", "trials", "probing", "ranking", "omissions", "glints", "estimate", "choice", "passes"}
"""Modules of render/transport that choose a method; left out."""
OUT = ROOT / "out" / "mutants.json"
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
    return (isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.arg | ast.Import | ast.ImportFrom)
            or (isinstance(node, ast.keyword) and node.arg in SILENT)
            or (isinstance(node, ast.Call) and ast.unparse(node.func) == "mi.Log"))  # fmt: skip


def changes(node):
    """``(kind, text)`` of each mutant of a node itself."""
    text, other = ast.unparse, SWAPS.get(type(getattr(node, "op", None)))
    if isinstance(node, ast.Compare) and len(node.ops) == 1:
        yield "comparison", f"{text(node.left)} {SWAPS[type(node.ops[0])]} {text(node.comparators[0])}"
    elif isinstance(node, ast.BinOp) and other:
        yield "arithmetic", f"({text(node.left)}) {other} ({text(node.right)})"
    elif isinstance(node, ast.BoolOp):
        yield "boolean", f" {other} ".join(f"({text(v)})" for v in node.values)
    elif isinstance(node, ast.UnaryOp):
        yield "boolean" if isinstance(node.op, ast.Not | ast.Invert) else "arithmetic", f"({text(node.operand)})"
    elif isinstance(node, ast.Constant) and isinstance(node.value, bool):
        yield "boolean", str(not node.value)
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        whole, up = float(node.value).is_integer() and abs(node.value) < 1e9, node.col_offset % 2
        yield "constant", repr(node.value + (1 if up else -1) if whole else node.value * (1.25 if up else 0.8))
    elif isinstance(node, ast.AugAssign) and other:
        yield "arithmetic", f"{text(node.target)} {other}= {text(node.value)}"
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.Tuple) and len(node.value.elts) > 1:
        first, second, *rest = (text(e) for e in node.value.elts)
        yield "return", "return " + ", ".join([second, first, *rest])
    elif isinstance(node, ast.Call):
        called, arguments, keywords = text(node.func), [text(a) for a in node.args], [text(k) for k in node.keywords]
        last = called.split(".")[-1]
        if last in NAMES:
            yield "function", f"{called.removesuffix(last)}{NAMES[last]}({', '.join([*arguments, *keywords])})"
        k = 1 if last in ("select", "where") else 0  # the values, not the condition
        pair = arguments[k : k + 2]
        if len(set(pair)) == 2 and last not in ("dot", *NAMES) and not any(TYPES.fullmatch(a) for a in pair):
            yield "arguments", f"{called}({', '.join([*arguments[:k], *pair[::-1], *arguments[k + 2 :], *keywords])})"


def candidates(path: Path) -> list[dict]:
    """Return all mutants of a module: place, kind, text before and after."""
    source, found = path.read_text(), []
    lines = source.splitlines()

    def visit(node):
        if skipped(node):
            return
        for kind, after in changes(node):
            found.append({"file": str(path.relative_to(ROOT)), "line": node.lineno, "column": node.col_offset,
                          "kind": kind, "before": ast.get_source_segment(source, node), "after": after,
                          "text": lines[node.lineno - 1].strip(), "statement": isinstance(node, ast.stmt)})  # fmt: skip
        for name, child in ast.iter_fields(node):
            if name not in ("annotation", "returns", "decorator_list", "type_params"):
                for each in child if isinstance(child, list) else [child]:
                    if isinstance(each, ast.AST):
                        visit(each)

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
    package, _, stem = f"mi_ntf.{module.replace('/', '.')}".rpartition(".")
    imported = re.compile(rf"from {package} import .*\b{stem}\b|from {package}\.{stem} import")
    found = [f for f in sorted((ROOT / "tests").rglob("test_*.py")) if imported.search(f.read_text())]
    found.sort(key=lambda f: (f.stem != f"test_{stem}", f.parent.name != module.split("/")[0]))
    return [str(f.relative_to(ROOT)) for f in found[:3]] or ["tests/render/test_integrator.py"]


def changed(mutant: dict) -> str:
    """Text of the mutated module."""
    lines = (ROOT / mutant["file"]).read_bytes().splitlines(keepends=True)
    begin = sum(map(len, lines[: mutant["line"] - 1])) + mutant["column"]
    source, before = b"".join(lines), mutant["before"].encode()
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
        found = subprocess.run(command, cwd=copy, env=os.environ | {"PYTHONPATH": str(copy)}, capture_output=True,
                               preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_CPU, (LIMIT, LIMIT + 5)))
    lines = found.stdout.decode(errors="replace").splitlines()
    failures = [line for line in lines if line.startswith(("FAILED", "ERROR"))]
    status = {0: "survived", -signal.SIGXCPU: "stopped"}.get(found.returncode, "killed")
    return {"status": status, "code": found.returncode, "seconds": round(time.monotonic() - begin), "tests": tests,
            "by": [*failures, *lines[-1:], ""][0][:160]}  # fmt: skip


def name(mutant: dict) -> str:
    """Name of a mutant in tables: module and line of text, and what of it is changed into what."""
    before, after = (" ".join(mutant[key].split()) for key in ("before", "after"))
    return f"{mutant['file'].removeprefix('mi_ntf/')}: {mutant['text']}: {before} → {after}"


def place(mutant: dict) -> tuple:
    """Key of a mutant among results."""
    return tuple(mutant[key] for key in ("file", "line", "column", "after"))


def table(done: list[dict], classes: dict) -> str:
    """Print all mutants, a line each, and the number of each status and class."""
    for m in done:
        m["class"] = "" if m["status"] == "killed" else classes.get(name(m), "not classified")
    lines = [f"{m['status']:8} {m['class']:14} {m['seconds']:4} s  {m['kind']:10} {name(m)}" for m in done]
    counts = Counter(f"{m['status']} {m['class']}" for m in done)
    killed = sum(m["status"] == "killed" for m in done)
    changing = len(done) - sum(m["class"] in ("equivalent", "performance") for m in done)
    return "\n".join([*lines, *(f"{n:4} {what}" for what, n in sorted(counts.items())),
                      f"killed: {killed} of {changing} that change results, {killed / max(changing, 1):.0%}"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seed", type=int, default=42)
    parser.add_argument("--count", type=int, default=60)
    parser.add_argument("--again", action="store_true", help="run those that were not killed once more")
    given = parser.parse_args()
    lists = tomllib.loads(Path(__file__).with_suffix(".toml").read_text())
    OUT.parent.mkdir(exist_ok=True)
    known = {place(m): m for m in (json.loads(OUT.read_text()) if OUT.exists() else [])}
    done = []
    for m in sample(given.seed, given.count):
        found = known.get(place(m), {}) | m
        if "status" not in found or (given.again and found["status"] != "killed"):
            found |= run(m, tests_of(m["file"], lists["nearest"]))
            print(f"{len(done) + 1:3} {found['status']:8} {found['seconds']:4} s  {name(m)}", flush=True)
        done.append(found)
        known[place(m)] = found
        OUT.write_text(json.dumps(list(known.values()), indent=1, ensure_ascii=False))
    print(table(done, {m["mutant"]: m["class"] for m in lists.get("survivor", [])}))


if __name__ == "__main__":
    main()

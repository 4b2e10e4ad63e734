"""The rules of language that a program can check: docstrings stand alone, and names say what a value is."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
FILES = [*sorted((ROOT / "mi_ntf").rglob("*.py")), *sorted((ROOT / "benchmarks").rglob("*.py"))]
FRAGMENTS = {"what", "whether", "where", "how", "of", "those", "as", "all", "one", "if", "no", "none", "same", "also",
             "nothing", "either", "whoever", "which", "whose", "why"}
"""Words that begin a fragment instead of a sentence or a noun phrase."""
EMPTY_NAMES = {"found", "share", "drawn", "told", "gone", "kept", "made", "wanted", "asked", "met", "came", "said",
               "either", "whose", "what", "which"}
"""Names that do not say what a value is."""
LONGEST = 40
"""Words of a sentence in a docstring. Style asks for 25; formulas and lists of names count as words here."""


def definitions(file: Path) -> Iterator[tuple[ast.AST, str]]:
    """Yield every module, class and function of a file with its docstring."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and (text := ast.get_docstring(node)):
            yield node, text


def where(file: Path, node: ast.AST) -> str:
    return f"{file.relative_to(ROOT)}:{getattr(node, 'lineno', 1)}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_first_lines_of_docstrings_stand_alone(file: Path):
    wrong = []
    for node, text in definitions(file):
        first, _, rest = text.partition("\n")
        word = re.sub(r"[^\w`]", "", first.split()[0]).lower()
        if word in FRAGMENTS or not first.rstrip().endswith((".", ":")) or (rest and not rest.startswith("\n")):
            wrong.append(f"{where(file, node)} {first}")
    assert wrong == []


def sentences(text: str) -> Iterator[str]:
    """Yield the sentences of a docstring's paragraphs of prose; tables, code and lists are left out."""
    for paragraph in re.split(r"\n\s*\n", text):
        if not re.search(r"^\s*(===|---|>>>|[-*] |\w[\w, *]*\n {4}|    |[\w, ]+ {2,}\S)", paragraph, re.M):
            yield from re.split(r"(?<=[.:;!?])\s+", " ".join(paragraph.split()))


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_sentences_are_short(file: Path):
    wrong = [f"{where(file, node)} {sentence}" for node, text in definitions(file) for sentence in sentences(text)
             if len(sentence.split()) > LONGEST]
    assert wrong == []


def names(file: Path) -> Iterator[tuple[str, ast.AST]]:
    """Yield the names that a file gives to variables, parameters, attributes, functions and classes."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node
        elif isinstance(node, ast.arg):
            yield node.arg, node
        elif isinstance(node, ast.FunctionDef | ast.ClassDef):
            yield node.name, node


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(ROOT)))
def test_names_say_what_a_value_is(file: Path):
    # `found` is a key of the report of `mi-ntf doctor`, and of the files of a study.
    wrong = [f"{where(file, node)} {name}" for name, node in names(file) if name.strip("_") in EMPTY_NAMES
             and not (file.name == "doctor.py" and name == "found")]
    assert wrong == []


def test_few_values_are_of_any_type():
    """Forty at most, since checking types is worth nothing where they are not given."""
    count = sum(len(re.findall(r"\bAny\b", line)) for file in (ROOT / "mi_ntf").rglob("*.py")
                for line in file.read_text().splitlines() if "import" not in line)
    assert count <= 40


def test_every_parameter_has_a_type():
    missing = []
    for file in (ROOT / "mi_ntf").rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.FunctionDef):
                arguments = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                missing += [f"{where(file, node)} {node.name}({a.arg})" for a in arguments
                            if a.annotation is None and a.arg not in ("self", "cls")]
    assert missing == []

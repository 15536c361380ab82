"""The paper's equations and the functions that are these: the tables of docs/method.md."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from pkgutil import resolve_name

import pytest

import gavo_jax

PACKAGE = Path(gavo_jax.__file__).parent
PAGE = (PACKAGE.parent / "docs" / "method.md").read_text(encoding="utf-8")
FUNCTIONS = {int(number): name for number, name in re.findall(r"^\| \((\d+)\) \|.*\| `([\w.]+)` \|$", PAGE, re.M)}
STOPS = re.findall(r"^\| \w+ stop: .*\| `([\w.]+)` \|$", PAGE, re.M)

UNNUMBERED = re.findall(r"^\| [^(|].*\| `(gavo_jax[\w.]+)` \|$", PAGE, re.M)

CLAIM = re.compile(r"(?:\bequations?|\bpaper's)((?:[\s,]|\band\b|\bto\b|\(\d+\))+)", re.I)
"""`Equation (n)`, or several numbers in one go."""


def numbers(docstring: str) -> set[int]:
    """Equations that a docstring claims."""
    return {int(number) for claim in CLAIM.findall(docstring) for number in re.findall(r"\d+", claim)}


def scopes(node: ast.AST, name: str) -> Iterator[tuple[str, str]]:
    """Text of every docstring below a node, those of attributes and constants too, with what it belongs to."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef | ast.ClassDef):
            yield from scopes(child, f"{name}.{child.name}")
        elif (
            isinstance(child, ast.Expr) and isinstance(child.value, ast.Constant) and isinstance(child.value.value, str)
        ):
            yield name, child.value.value


def claims() -> dict[int, set[str]]:
    """Names by the equation that they claim; a module's docstring may give a range of numbers."""
    found: dict[int, set[str]] = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ast.parse(path.read_text(encoding="utf-8"))
        if ast.get_docstring(module) is not None:
            del module.body[0]
        parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
        for name, text in scopes(module, ".".join(part for part in parts if part != "__init__")):
            for number in numbers(text):
                found.setdefault(number, set()).add(name)
    return found


def test_the_table_has_a_row_for_every_equation() -> None:
    assert list(FUNCTIONS) == list(range(1, 18))
    assert len(STOPS) == 2


@pytest.mark.parametrize("number", FUNCTIONS)
def test_the_function_of_an_equation_says_so(number: int) -> None:
    assert number in numbers(resolve_name(FUNCTIONS[number]).__doc__)


def test_no_other_docstring_claims_an_equation() -> None:
    assert claims() == {number: {name} for number, name in FUNCTIONS.items()}


@pytest.mark.parametrize("name", STOPS)
def test_the_stop_criteria_exist(name: str) -> None:
    assert "stop criterion" in resolve_name(name).__doc__


@pytest.mark.parametrize("name", UNNUMBERED)
def test_steps_without_a_number_have_a_function(name: str) -> None:
    assert callable(resolve_name(name))

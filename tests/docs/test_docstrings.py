"""Docstrings stand alone, and the names of this package that they mention are there."""

import ast
import importlib
import re
from pathlib import Path

import pytest
from pages import ROOT

from gavo_jax.camera import Camera
from gavo_jax.settings import AlignmentOptions, OdometryOptions

PACKAGE = ROOT / "gavo_jax"
PATHS = sorted(PACKAGE.rglob("*.py"))
DOTTED = re.compile(r"`([a-z_]\w*(?:\.\w+)+)`")
WRITTEN = [
    path for folder in ("gavo_jax", "benchmarks", "examples", "tests") for path in sorted((ROOT / folder).rglob("*.py"))
]
SMALL_WORD = re.compile(r"[a-z]+[,.:;]?(\s|$)")
"""A word that goes on a sentence; symbols, units, files' and other names have more than small letters."""
PREPOSITIONS = {"Of", "By", "As", "From", "With", "In", "At", "On", "Where", "For"}
"""What a function's docstring doesn't begin with: it would go on the name."""
FILES = (".json", ".csv", ".toml", ".py")
"""Endings of what is a file's name."""
VALUES = {"camera": Camera, "alignment": AlignmentOptions, "odometry": OdometryOptions}
"""By name: what is said of a value of the class, or of a key in a file of settings."""


def modules() -> dict[str, list[str]]:
    """Full names of modules and packages, by the last part of each."""
    found: dict[str, list[str]] = {}
    for path in PATHS:
        parts = path.relative_to(ROOT).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        for package in range(2, len(parts) + 1):
            full = ".".join(parts[:package])
            if full not in (names := found.setdefault(parts[package - 1], [])):
                names.append(full)
    return found


MODULES = modules()


def docstrings(source: str) -> list[tuple[int, str]]:
    """Line and text of all docstrings of a file, those of constants and fields included."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Expr)]
    texts = [(node.lineno, node.value.value) for node in nodes if isinstance(node.value, ast.Constant)]
    return [(line, text.strip()) for line, text in texts if isinstance(text, str)]


def functions(source: str) -> list[tuple[int, str]]:
    """Line and docstring of all functions of a file that have one."""
    nodes = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)]
    texts = [(node.body[0].lineno, ast.get_docstring(node)) for node in nodes]
    return [(line, text) for line, text in texts if text]


def stands_alone(docstring: str) -> bool:
    """Whether a docstring neither goes on what stands before it nor is gone on with after it."""
    return not SMALL_WORD.match(docstring) and not docstring.endswith((",", ";"))


def mentioned(path: Path) -> set[str]:
    """Dotted names in a file's docstrings that begin with a module of ours, from the package's own on."""
    texts = [text for _, text in docstrings(path.read_text(encoding="utf-8"))]
    names = {name.removeprefix("gavo_jax.") for text in texts for name in DOTTED.findall(text)}
    return {name for name in names if name.partition(".")[0] in MODULES and not name.endswith(FILES)}


def is_there(name: str) -> bool:
    """Whether a name is that of a module, of something in one, or of what a value has."""
    first, *rest = name.split(".")
    if len(rest) == 1 and (value := VALUES.get(first)) and rest[0] in {*value.__dataclass_fields__, *dir(value)}:
        return True
    return any(leads_to(full, rest) for full in MODULES[first])


def leads_to(full: str, rest: list[str]) -> bool:
    """Whether a module has what is named, part after part."""
    place = importlib.import_module(full)
    for number, part in enumerate(rest):
        inner = ".".join([full, *rest[: number + 1]])
        if inner in MODULES.get(part, []):
            place = importlib.import_module(inner)
        elif hasattr(place, part):
            place = getattr(place, part)
        else:
            return False
    return True


def test_names_in_docstrings_are_there() -> None:
    said = ((path.relative_to(ROOT), name) for path in WRITTEN for name in sorted(mentioned(path)))
    wrong = [f"{path}: {name}" for path, name in said if not is_there(name)]
    assert not wrong


def test_names_on_the_page_of_the_method_are_there_and_whole() -> None:
    text = (ROOT / "docs" / "method.md").read_text(encoding="utf-8")
    names = {name.removeprefix("gavo_jax.") for name in DOTTED.findall(text) if not name.endswith(".py")}
    ours = sorted(name for name in names if name.partition(".")[0] in MODULES)
    tops = {path.stem for path in PACKAGE.iterdir()}
    assert ours and not [name for name in ours if name.partition(".")[0] not in tops or not is_there(name)]


def test_what_is_not_there_is_told() -> None:
    assert is_there("objective.losses.LOSSES") and is_there("alignment.points") and is_there("pyramid.halve_grey")
    assert not is_there("objective.LOSSES") and not is_there("camera.focal") and not is_there("solvers.base.Nobody")


def test_docstrings_stand_alone() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in WRITTEN
        for line, text in docstrings(path.read_text(encoding="utf-8"))
        if not stands_alone(text)
    ]
    assert not wrong


def test_functions_say_what_they_do() -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {text}"
        for path in WRITTEN
        if "tests" not in path.relative_to(ROOT).parts
        for line, text in functions(path.read_text(encoding="utf-8"))
        if text.split()[0] in PREPOSITIONS
    ]
    assert not wrong


@pytest.mark.parametrize("text", ["and the largest one.", "Metres to the wall,", "metres", "radians: of it.", "One;"])
def test_a_docstring_that_goes_on_is_told(text: str) -> None:
    assert not stands_alone(text)


@pytest.mark.parametrize(
    "text", ["m/s and rad/s.", "c² log(1 + s/c²).", "target_T_reference of it.", "frames.csv: rows."]
)
def test_a_docstring_may_begin_with_a_symbol_or_a_name(text: str) -> None:
    assert stands_alone(text)

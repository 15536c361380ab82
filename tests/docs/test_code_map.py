"""The map of the code names every module, and its order is that of the imports."""

import ast
import re

from pages import ROOT

PACKAGE = ROOT / "gavo_jax"
ROWS = [line for line in (ROOT / "docs/code.md").read_text(encoding="utf-8").splitlines() if line.startswith("| `")]
PLACE = {
    name.removesuffix(".py"): number
    for number, row in enumerate(ROWS)
    for name in re.findall(r"`(\w+(?:\.py|(?=/)))", row.split("|")[1])
}
KNOW_EACH_OTHER = ({"odometry", "bodies"}, {"odometry", "mapping"})
SAID_IN_ONE = {"cli", "experiments"}
"""Packages whose row tells their subject in words."""


def modules() -> list[tuple[str, ...]]:
    """Of the package, by the parts of their names."""
    paths = [path.relative_to(PACKAGE).with_suffix("") for path in sorted(PACKAGE.rglob("*.py"))]
    return [path.parts for path in paths if path.name not in ("__init__", "__main__", "version")]


def test_every_module_is_on_the_map() -> None:
    for top, *inner in modules():
        assert top in PLACE, top
        assert not inner or top in SAID_IN_ONE or f"`{inner[-1]}`" in ROWS[PLACE[top]], (top, *inner)


def test_the_map_names_nothing_that_is_not_there() -> None:
    tops = {top for top, *_ in modules()}
    assert set(PLACE) <= tops, set(PLACE) - tops


def test_a_package_imports_from_those_above_it() -> None:
    for parts in modules():
        tree = ast.parse(PACKAGE.joinpath(*parts).with_suffix(".py").read_text(encoding="utf-8"))
        for node in tree.body:
            name = node.module if isinstance(node, ast.ImportFrom) else None
            if name is None or not name.startswith("gavo_jax."):
                continue
            imported, own = name.split(".")[1], parts[0]
            if imported in PLACE and {imported, own} not in KNOW_EACH_OTHER:
                assert PLACE[imported] <= PLACE[own], f"{'.'.join(parts)} imports {name}"

"""The library imports one way: no two folders know each other, no two modules, and the core knows no solver."""

import ast
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "osik_jax"


@cache
def imports() -> dict[Path, set[Path]]:
    """Return the modules of the package that each of its modules imports, lazily or for types too."""
    edges: dict[Path, set[Path]] = {path: set() for path in PACKAGE.rglob("*.py")}
    for path, found in edges.items():
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                start = path.parents[node.level - 1] if node.level else PACKAGE.parent
                base = start.joinpath(*(node.module or "").split("."))
                places = [base] * bool(node.module) + [base / alias.name for alias in node.names]
            elif isinstance(node, ast.Import):
                places = [PACKAGE.parent.joinpath(*alias.name.split(".")) for alias in node.names]
            else:
                continue
            places = [place for place in places if place != PACKAGE]
            found |= {
                file for place in places for file in (place.with_suffix(".py"), place / "__init__.py")
            } & edges.keys()
    return edges


def test_no_two_folders_know_each_other() -> None:
    """Nor the core a solver, or maps of reach and controllers in other programs a viewer."""
    edges: dict[str, set[str]] = {}
    for path, others in imports().items():
        name, *names = (each.relative_to(PACKAGE).parts[0].removesuffix(".py") for each in (path, *others))
        if path != PACKAGE / "__init__.py":
            edges.setdefault(name, set()).update(set(names) - {name})
    order = list(TopologicalSorter(edges).static_order())
    assert order.index("core") < order.index("solvers") < order.index("control")
    assert edges["core"] == {"_errors"}
    assert "viewer" not in edges["reachability"] | edges["interop"]


def test_no_two_modules_know_each_other() -> None:
    edges, robot = imports(), PACKAGE / "robot"
    assert {robot / "_model.py", robot / "loading" / "__init__.py"} <= edges[robot / "_robot.py"]
    list(TopologicalSorter(edges).static_order())

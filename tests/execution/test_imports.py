"""The library imports one way: no two folders know each other, no two modules, and the core knows no solver."""

import ast
from graphlib import TopologicalSorter
from pathlib import Path

PACKAGE = Path(__file__).parents[2] / "osik_jax"


def imported(source: str, place: tuple[str, ...]) -> set[str]:
    """Folders and modules right under the package that a module imports, lazily or for types too.

    Args:
        source: text of the module.
        place: folders of the module under the package.
    """
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            base = ("osik_jax", *place)
            names = (base[: len(base) - node.level + 1] if node.level else ()) + tuple((node.module or "").split("."))
            names = tuple(name for name in names if name)
            paths = [names] if len(names) > 1 else [(*names, alias.name) for alias in node.names]
        elif isinstance(node, ast.Import):
            paths = [tuple(alias.name.split(".")) for alias in node.names]
        else:
            continue
        found |= {path[1] for path in paths if path[0] == "osik_jax" and len(path) > 1}
    return found


def graph() -> dict[str, set[str]]:
    """Of each folder or module right under the package, those that it imports."""
    edges: dict[str, set[str]] = {}
    for path in PACKAGE.rglob("*.py"):
        place = path.relative_to(PACKAGE).parts
        if place != ("__init__.py",):
            name = place[0].removesuffix(".py")
            edges.setdefault(name, set()).update(imported(path.read_text(), place[:-1]) - {name})
    return edges


def test_no_two_folders_know_each_other() -> None:
    """Nor the core a solver, or maps of reach and controllers in other programs a viewer."""
    edges = graph()
    order = list(TopologicalSorter(edges).static_order())
    assert order.index("core") < order.index("solvers") < order.index("control")
    assert edges["core"] == {"_errors"}
    assert "viewer" not in edges["reachability"] | edges["interop"]


def test_every_form_of_import_is_seen() -> None:
    source = """
from ..solvers.qp._problem import QP
from .. import viewer
from ...tasks import Task
import osik_jax.control
def later():
    from osik_jax.physics import simulate
    from . import _own
    import numpy
"""
    assert imported(source, ("kernels",)) >= {"solvers", "viewer", "control", "physics", "kernels"}
    assert imported(source, ("viewer", "live")) >= {"tasks", "control", "physics", "viewer"}


def modules(folder: Path) -> dict[Path, set[Path]]:
    """Of each module of a folder, those of the folder that it imports from, for types too."""
    edges: dict[Path, set[Path]] = {}
    for path in folder.rglob("*.py"):
        edges[path] = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.level:
                base = path.parents[node.level - 1].joinpath(*(node.module or "").split("."))
                for place in [base] if node.module else [base / alias.name for alias in node.names]:
                    edges[path] |= {file for file in (place.with_suffix(".py"), place / "__init__.py") if file.exists()}
    return {path: {file for file in edges[path] if file in edges} for path in edges}


def test_no_two_modules_know_each_other() -> None:
    edges = modules(PACKAGE)
    robot = PACKAGE / "robot"
    assert {robot / "_model.py", robot / "loading" / "__init__.py"} <= edges[robot / "_robot.py"]
    list(TopologicalSorter(edges).static_order())

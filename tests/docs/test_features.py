"""The table of features: what it says of us is tested, its names exist, and nothing of ours is missing from it."""

from __future__ import annotations

import ast
import importlib
import re
from functools import cache
from pathlib import Path

import pytest

import osik_jax as osik
from benchmarks.data_file import DATA, read_csv

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "features.md").read_text(encoding="utf-8")
NONE = "—"
COLUMNS = 3


def rows(page: str) -> list[tuple[str, list[str]]]:
    """Return the heading and the cells of each row of the tables of features, heads left out."""
    found = []
    for section in page.split("\n## ")[1:]:
        title, *lines = section.splitlines()
        cells = [[cell.strip() for cell in line[1:-1].split("|")] for line in lines if line.startswith("|")]
        found += [(title, row) for row in cells[2:]]
    return found


def tests_by_feature() -> dict[tuple[str, str], list[str]]:
    """Return the tests that the data file names, by heading and feature."""
    found: dict[tuple[str, str], list[str]] = {}
    for title, feature, test in read_csv(DATA / "features.csv")[1]:
        found.setdefault((title, feature), []).append(test)
    return found


ROWS = rows(PAGE)
TESTS = tests_by_feature()


def _test_file(name: str) -> Path:
    """Return the path of a test file, which may stand in any folder of the tests."""
    return next((ROOT / "tests").rglob(name))


@cache
def functions_of(name: str) -> frozenset[str]:
    """``test_x`` and ``TestClass::test_x`` of a file."""
    found = set()
    for node in ast.parse(_test_file(name).read_text(encoding="utf-8")).body:
        inside = node.body if isinstance(node, ast.ClassDef) else [node]
        prefix = f"{node.name}::" if isinstance(node, ast.ClassDef) else ""
        found |= {prefix + part.name for part in inside if isinstance(part, ast.FunctionDef)}
    return frozenset(name for name in found if name.rpartition("::")[2].startswith("test_"))


def missing_tests(named: list[str]) -> list[str]:
    """Return the tests of a list that do not exist."""
    split = [test.partition("::")[::2] for test in named]
    return [f"{file}::{test}" for file, test in split if test not in functions_of(file)]


@pytest.mark.parametrize(("title", "row"), ROWS, ids=lambda given: given[0] if isinstance(given, list) else None)
def test_what_is_said_of_us_is_shown_by_a_test(title: str, row: list[str]):
    assert len(row) == COLUMNS
    shown = TESTS.get((title, row[0]), [])
    if row[1] == NONE or not shown:
        assert not shown
        assert "`" not in row[1], "a name of ours without a test"
    else:
        assert not missing_tests(shown)


def test_every_feature_of_the_data_file_is_on_the_page():
    assert len(TESTS) > 60
    assert set(TESTS) <= {(title, row[0]) for title, row in ROWS}


def test_names_of_ours_exist():
    """Every name in backquotes in our column: ``Name``, ``Name(option=)``, ``object.name``, ``package.name``."""
    checked = 0
    for _, row in ROWS:
        for name in re.findall(r"`([\w.]+)(?:\([^`]*\))?`", row[1]):
            checked += 1
            first, *rest = name.split(".")
            if first == "osik_jax":
                assert hasattr(importlib.import_module(".".join((first, *rest[:-1]))), rest[-1]), name
            elif first in ("robot", "solution", "jax"):
                owner = dict(robot=osik.Robot, solution=osik.Solution, jax=importlib.import_module("jax"))[first]
                assert rest[0] in dir(owner) or rest[0] in owner.__annotations__, name
            elif first[0].isupper():
                assert hasattr(osik, first), name
                assert all(hasattr(getattr(osik, first), part) for part in rest), name
    assert checked > 20


def test_every_task_limit_and_scheme_of_ours_is_in_it():
    ours = " ".join(row[1] for _, row in ROWS)
    bases = osik.Task, osik.Limit, osik.Scheme
    public = [getattr(osik, name) for name in dir(osik) if not name.startswith("_")]
    kinds = [kind for kind in public if isinstance(kind, type) and issubclass(kind, bases) and kind not in bases]
    assert len(kinds) >= 8
    assert [kind.__name__ for kind in kinds if f"`{kind.__name__}" not in ours] == []

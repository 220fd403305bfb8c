"""What tasks say of themselves, and that no other part of the package keeps lists of their classes."""

import ast
from pathlib import Path

import jax
import numpy as np
import pytest
from every_class import all_tasks

import osik_jax as osik
from osik_jax import tasks as module
from osik_jax.batching._names import leaf_names
from osik_jax.control._units import unit_of
from osik_jax.tasks._task import CoreCard

CLASSES = {name for name, own in vars(module).items() if isinstance(own, type) and issubclass(own, osik.Task)} - {
    "Task"
}
PACKAGE = Path(osik.__file__).parent


def named_in(node: ast.AST) -> set[str]:
    """Return the task classes that a part of a file names."""
    names = (getattr(own, "id", getattr(own, "attr", None)) for own in ast.walk(node))
    return CLASSES & set(names)


def lists_of_classes(tree: ast.Module) -> list[set[str]]:
    """Return the task classes of each ``isinstance``, of what follows each ``in``, and of each constant."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("isinstance", "issubclass"):
            found.append(named_in(node.args[1]))
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            found.append(named_in(node.comparators[0]))
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(
            node.value, ast.Tuple | ast.Set | ast.List | ast.Dict
        ):
            found.append(named_in(node.value))
    return [own for own in found if len(own) > 1]


def test_no_other_part_keeps_a_list_of_task_classes():
    apart = {"tasks", "viewer", "demo", "saving"}
    files = [file for file in PACKAGE.rglob("*.py") if file.relative_to(PACKAGE).parts[0] not in apart]
    assert len(files) > 100
    lists = {str(file): lists_of_classes(ast.parse(file.read_text())) for file in files}
    assert not {file: own for file, own in lists.items() if own}
    assert lists_of_classes(ast.parse("KINDS = (ComTask, osik.FrameTask)")) == [{"ComTask", "FrameTask"}]
    assert lists_of_classes(ast.parse("f(isinstance(a, ComTask | FrameTask))")) == [{"ComTask", "FrameTask"}]


def test_a_card_of_the_core_has_the_rows_of_its_task(arm):
    tasks = all_tasks(arm) | {"place": osik.FrameTask(arm, "link4", rows="position")}
    shapes = jax.eval_shape(lambda q: osik.build_problem(arm, q, tasks).rows, arm.q0)
    cards = {name: task.core(arm) for name, task in tasks.items()}
    known = {name: card for name, card in cards.items() if isinstance(card, CoreCard)}
    assert known.keys() == {"bounds", "between", "com", "over", "posture", "place"}
    for name, card in known.items():
        assert card.rows == len(shapes[name].error)
        leaves = tasks[name].core_leaves()
        assert len(leaves) == 9 and leaves[0] is tasks[name].gain and leaves[1] is tasks[name].weight
        assert (leaves[4] is None) == shapes[name].is_equality
    assert cards["frame"] == "has error='se3'" and cards["look"] == "is of the class LookAtTask"


def test_a_class_of_ones_own_inherits_no_card(arm):
    class Own(osik.FrameTask):
        pass

    own = Own(arm, "hand")  # pyright: ignore[reportCallIssue]
    assert own.core(arm) == "is of the class Own"


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("look.target", "m"),
        ("look.axis", "1 (direction)"),
        ("axis.target_velocity", "rad/s"),
        ("axis.half_angle", "rad"),
        ("between.target[0]", "m"),
        ("between.target[1]", "1 (rotation matrix)"),
        ("com.target_velocity", "m/s"),
        ("posture.target_velocity", "rad/s or m/s"),
        ("momentum.target", "kg m^2/s"),
        ("frame.gain.decay", "1 / unit of the error"),
        ("damping.weight", "1"),
        ("couple.target", "the task's own"),
    ],
)
def test_a_task_says_the_unit_of_each_of_its_numbers(arm, name, unit):
    tasks = all_tasks(arm)
    assert name in leaf_names(tasks)
    assert unit_of(tasks, name) == unit


def test_a_task_says_which_rows_are_lengths(arm):
    tasks = all_tasks(arm)
    counts = {"between": (6, 3), "look": (2, 0), "axis": (1, 0), "com": (3, 3), "contact": (6, 3)}
    for name, (rows, lengths) in counts.items():
        assert np.asarray(tasks[name].are_lengths(rows)).sum() == lengths, name

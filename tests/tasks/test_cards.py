"""Tasks and limits tell their own facts, and no other part of the package keeps a list of their classes."""

import ast
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from every_class import all_limits, all_tasks

import osik_jax as osik
from osik_jax import limits, tasks
from osik_jax.batching._names import leaf_names
from osik_jax.control._units import unit_of
from osik_jax.robot._mujoco import mujoco_frame_pose, mujoco_poses, robot_com
from osik_jax.tasks._task import CoreCard

CLASSES = {
    name
    for module, base in ((tasks, osik.Task), (limits, osik.Limit))
    for name, own in vars(module).items()
    if isinstance(own, type) and issubclass(own, base) and own is not base
}
PACKAGE = Path(osik.__file__).parent


def named_in(node: ast.AST) -> set[str]:
    """Return the classes of tasks and limits that a part of a file names."""
    names = (getattr(own, "id", getattr(own, "attr", None)) for own in ast.walk(node))
    return CLASSES & set(names)


def is_asked(call: ast.Call) -> bool:
    """Return whether a call asks for the class of an object."""
    return getattr(call.func, "id", "") in ("isinstance", "issubclass")


def lists_of_classes(tree: ast.Module) -> list[set[str]]:
    """Return the classes of each function's ``isinstance``, each ``match``, ``in`` and constant."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef):
            asked = [own for own in ast.walk(node) if isinstance(own, ast.Call) and is_asked(own)]
            found.append(set().union(*(named_in(own.args[1]) for own in asked)))
        if isinstance(node, ast.Match):
            found.append(set().union(*(named_in(case.pattern) for case in node.cases)))
        if isinstance(node, ast.Call) and is_asked(node):
            found.append(named_in(node.args[1]))
        if isinstance(node, ast.Compare) and isinstance(node.ops[0], ast.In | ast.NotIn):
            found.append(named_in(node.comparators[0]))
    for node in tree.body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and isinstance(
            node.value, ast.Tuple | ast.Set | ast.List | ast.Dict
        ):
            found.append(named_in(node.value))
    return [own for own in found if len(own) > 1]


def test_no_other_part_keeps_a_list_of_classes():
    apart = {"tasks", "limits", "saving"}
    files = [file for file in PACKAGE.rglob("*.py") if file.relative_to(PACKAGE).parts[0] not in apart]
    assert len(files) > 100
    lists = {str(file): lists_of_classes(ast.parse(file.read_text())) for file in files}
    assert not {file: own for file, own in lists.items() if own}
    assert lists_of_classes(ast.parse("KINDS = (ComTask, osik.FrameTask)")) == [{"ComTask", "FrameTask"}]
    assert lists_of_classes(ast.parse("f(isinstance(a, ComTask | FrameTask))")) == [{"ComTask", "FrameTask"}]
    apart = "def f(a):\n return isinstance(a, ComTask) or isinstance(a, FrameTask)"
    matched = "match a:\n case ComTask(): pass\n case FrameTask(frame=f): pass"
    assert lists_of_classes(ast.parse(apart)) == lists_of_classes(ast.parse(matched)) == [{"ComTask", "FrameTask"}]


def test_a_card_of_the_core_has_the_rows_of_its_task(arm):
    tasks = all_tasks(arm) | {"place": osik.FrameTask(arm, "link4", rows="position")}
    shapes = jax.eval_shape(lambda q: osik.build_problem(arm, q, tasks).rows, arm.q0)
    cards = {name: task.core(arm) for name, task in tasks.items()}
    known = {name: card for name, card in cards.items() if isinstance(card, CoreCard)}
    assert known.keys() == {"bounds", "between", "look", "axis", "com", "over", "posture", "place"}
    for name, card in known.items():
        assert card.rows == len(shapes[name].error)
        leaves = tasks[name].core_leaves()
        assert len(leaves) == 9 and leaves[0] is tasks[name].gain and leaves[1] is tasks[name].weight
        assert (leaves[4] is None) == shapes[name].is_equality
    assert cards["frame"] == "has error='se3'" and cards["energy"] == "is of the class KineticEnergyTask"


def test_a_class_of_ones_own_inherits_no_card(arm):
    class Own(osik.FrameTask):
        pass

    class Slower(osik.VelocityLimit):
        pass

    own = Own(arm, "hand")  # pyright: ignore[reportCallIssue]
    assert own.core(arm) == "is of the class Own"
    assert not Slower(arm).core_has_box  # pyright: ignore[reportCallIssue]


def test_a_limit_says_what_the_core_reads_of_it_and_whether_it_keeps_places(arm):
    known = {type(limit).__name__: limit for limit in all_limits(arm)}
    read = {name for name, limit in known.items() if limit.core_has_box}
    assert read == {"ConfigurationLimit", "VelocityLimit", "NoLimits"}
    for name in read:
        leaves = known[name].core_leaves()
        assert len(leaves) in (0, 5)
        assert {id(leaf) for leaf in leaves[1:]} == {id(leaf) for leaf in jax.tree.leaves(known[name])}
    assert {name for name, limit in known.items() if limit.sees_places} == {
        "CollisionAvoidanceLimit",
        "PositionBarrier",
    }
    assert all(limit.sought(arm) is not None for limit in known.values() if limit.sees_places)


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


@jax.jit
def rows_at(robot, q, tasks):
    return osik.build_problem(robot, q, tasks).rows


def test_a_task_says_the_bounds_of_its_error(arm):
    tasks = all_tasks(arm) | {"room": osik.PostureTask(arm, lower=-0.1, upper=0.1)}
    q = arm.q0 + 0.4 * np.random.default_rng(0).normal(size=arm.nq)
    known = {name: np.broadcast_arrays(*own) for name, task in tasks.items() if (own := task.error_bounds())}
    rows = rows_at(arm, q, {name: tasks[name] for name in known})
    assert known.keys() == {"bounds", "axis", "over", "room"}
    assert all(not rows[name].is_equality for name in known)
    for name, (lower, upper) in known.items():
        error = np.asarray(rows[name].error)
        # a row that asks for a velocity of one sign is outside
        asks = (np.asarray(rows[name].lower) > 0.0) | (np.asarray(rows[name].upper) < 0.0)
        np.testing.assert_array_equal((error > upper) | (error < lower), asks, err_msg=name)
    assert (np.asarray(rows["room"].error) > 0.1).any()


def test_a_task_whose_grip_is_dragged_to_a_pose_is_met_there(arm):
    tasks = all_tasks(arm) | {"point": osik.FrameTask(arm, "link4", rows="position")}
    grips = {name: grip for name, task in tasks.items() if (grip := task.grip()) is not None}
    assert {name: rotation is not None for name, (_, rotation) in grips.items()} == {
        "frame": True,
        "com": False,
        "point": False,
    }
    q = arm.q0 + 0.3 * np.random.default_rng(1).normal(size=arm.nq)
    data = next(mujoco_poses(arm, q))
    poses = {name: mujoco_frame_pose(arm, data, frame) for name, frame in (("frame", "hand"), ("point", "link4"))}
    poses["com"] = robot_com(arm, data), np.eye(3)
    dragged = {name: tasks[name].replace(target=tasks[name].gripped(*pose)) for name, pose in poses.items()}
    for name, own in rows_at(arm, q, dragged).items():
        np.testing.assert_allclose(own.error, 0.0, atol=1e-9, err_msg=name)
    point: Any = tasks["point"]
    assert point.gripped(np.zeros(3), np.eye(3))[1] is point.target[1]
    with pytest.raises(TypeError, match="no target to drag"):
        tasks["look"].gripped(np.zeros(3), np.eye(3))


def test_a_task_says_which_rows_are_lengths(arm):
    tasks = all_tasks(arm)
    counts = {"between": (6, 3), "look": (2, 0), "axis": (1, 0), "com": (3, 3), "contact": (6, 3)}
    for name, (rows, lengths) in counts.items():
        assert np.asarray(tasks[name].are_lengths(rows)).sum() == lengths, name

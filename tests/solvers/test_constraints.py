"""Limits with rows and hard tasks in the three schemes: against quadprog, the lexicographic oracle and NumPy."""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quadprog
from derivative_checks import assert_exact, check
from hierarchy_families import Hierarchies, Rows
from lexicographic import certificate, norms, reference
from refusals import refuses
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax.limits import limit_rows
from osik_jax.schemes import VelocityProblem
from osik_jax.solvers import Status

DT, LANES = 0.01, 12
ORDER = ("elbow", "side", "hand", "posture")
SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-4, curvature_damping=0.0),
    "null-space": osik.NullSpace(damping=1e-4, curvature_damping=0.0, potential_gain=0.0),
    "saturated": osik.NullSpace(method="saturated", curvature_damping=0.0),
    "hierarchical": osik.HierarchicalQP(curvature_damping=0.0),
}
"""The oracles have no curvature damping."""


class Case(eqx.Module):
    """All that a step takes; arrays may have a leading axis, the lanes."""

    robot: osik.Robot
    q: Any
    tasks: dict[str, osik.Task]
    limits: tuple[osik.Limit, ...]


@pytest.fixture(scope="module")
def lanes(arm):
    """Configurations around home, bounds and places for the hand; rows that bind."""
    rng = np.random.default_rng(5)
    q = np.asarray(arm.q0) + rng.uniform(-0.1, 0.1, (LANES, arm.nv))
    place = rng.uniform(-0.3, 0.3, (LANES, 3))
    matrix = rng.normal(size=(LANES, 3, arm.nv))
    lower = rng.uniform(-0.15, 0.05, (LANES, 3))
    return tuple(map(jnp.asarray, (q, place, matrix, lower, lower + rng.uniform(0.0, 0.2, (LANES, 3)))))


def case(arm, lane, *, hard=("elbow",), bound=2.0):
    """The elbow's position kept, the hand far from its place, rows on the joints."""
    q, place, matrix, lower, upper = lane
    p, R = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
    tasks = {
        "elbow": osik.FrameTask(arm, "link4", rows=(True, True) + (False,) * 4, gain=1.0, hard="elbow" in hard),
        "side": osik.FrameTask(
            arm, "hand", rows="position", lower=-0.05, upper=0.05, priority=2, gain=1.0, hard="side" in hard
        ),
        "hand": osik.FrameTask(arm, "hand", target=(p + place, R), orientation_weight=0.1, priority=3),
        "posture": osik.PostureTask(arm, priority=4, weight=1e-3),
    }
    rows = osik.LinearLimit(arm, matrix, lower, upper)
    limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": bound}), rows
    return Case(arm, q, tasks, limits)


@partial(jax.jit, static_argnames="hard")
def cases(arm, lanes, *, hard=("elbow",)):
    return jax.vmap(lambda lane: case(arm, lane, hard=hard))(lanes)


@jax.jit
def solve_lanes(cases, scheme):
    return jax.vmap(lambda c: osik.solve(c.robot, c.q, c.tasks, scheme=scheme, limits=c.limits, dt=DT))(cases)


@jax.jit
def problem(case):
    """Rows of each task, and the box."""
    kinematics = osik.forward_kinematics(case.robot, case.q)
    rows = {name: task.rows(case.robot, kinematics, case.q) for name, task in case.tasks.items()}
    return rows, osik.limit_box(case.robot, case.q, case.limits, DT)


class Problem(NamedTuple):
    """One lane in NumPy: the groups of tasks, what is hard first."""

    groups: list[Rows]
    box: tuple[np.ndarray, np.ndarray]


def numbers(cases, i, groups) -> Problem:
    one = jax.tree.map(lambda leaf: np.asarray(leaf)[i], cases)
    rows, box = jax.tree.map(np.asarray, problem(one))

    def together(names, more=()):
        parts = [(r.jacobian, r.lower, r.upper, r.weight) for r in (rows[n] for n in names)]
        return Rows(*(np.concatenate(column) for column in zip(*parts, *more, strict=True)))

    linear = one.limits[-1]
    limit = linear.matrix, linear.lower, linear.upper, np.ones(3)
    hard = [name for name, task in one.tasks.items() if task.hard]
    return Problem([together(hard, [limit]), *map(together, groups)], box)


def weighted_answer(p: Problem, damping: float) -> np.ndarray:
    """quadprog over (v, t): t is by how much inequality rows of soft tasks give way."""
    hard, *soft = p.groups
    rows = Rows(*(np.concatenate(column) for column in zip(*soft, strict=True)))
    n = hard.A.shape[1]
    equal = rows.lower == rows.upper
    A, w, B = rows.A[equal], rows.weight[equal], rows.A[~equal]
    m = len(B)
    H = np.zeros((n + m, n + m))
    H[:n, :n] = A.T @ (w[:, None] * A) + damping * np.eye(n)
    H[n:, n:] = np.diag(rows.weight[~equal])
    pinned = hard.lower == hard.upper
    pieces = [
        (hard.A[pinned], hard.lower[pinned], 0),
        (hard.A[~pinned], hard.lower[~pinned], 0),
        (-hard.A[~pinned], -hard.upper[~pinned], 0),
        (np.eye(n), p.box[0], 0),
        (-np.eye(n), -p.box[1], 0),
        (B, rows.lower[~equal], 1),
        (-B, -rows.upper[~equal], -1),
    ]
    C = np.vstack([np.hstack([G, gives * np.eye(m) if gives else np.zeros((len(G), m))]) for G, _, gives in pieces])
    b = np.concatenate([h for _, h, _ in pieces])
    finite = np.isfinite(b)
    g = np.concatenate([A.T @ (w * rows.lower[equal]), np.zeros(m)])
    return quadprog.solve_qp(H, g, C[finite].T, b[finite], int(pinned.sum()))[0][:n]


class TestAgainstOthers:
    """In each lane some rows of the limit bind."""

    @pytest.mark.variants(slow=["equality"], release=["inequality"])
    @pytest.mark.parametrize("hard", [("elbow",), ("elbow", "side")], ids=["equality", "inequality"])
    def test_weighted(self, arm, lanes, hard):
        some = cases(arm, lanes, hard=hard)
        ours = solve_lanes(some, SCHEMES["weighted"])
        assert (ours.status == Status.SOLVED).all()
        assert (ours.box_violation < 1e-13).all()
        soft = [[name] for name in ORDER if name not in hard]
        for i in range(LANES):
            truth = weighted_answer(numbers(some, i, soft), 1e-4)
            np.testing.assert_allclose(ours.velocity[i], truth, rtol=0, atol=1e-8)
        for name in hard:
            assert np.abs(ours.slack[name]).max() < 1e-13
        heavy = eqx.tree_at(lambda c: c.tasks["hand"].weight, some, 1e6 * some.tasks["hand"].weight)
        pulled = solve_lanes(heavy, SCHEMES["weighted"])
        assert (pulled.status == Status.SOLVED).all() and np.abs(pulled.slack["hand"]).max() > 1.0
        assert max(np.abs(pulled.slack[name]).max() for name in hard) < 1e-12

    @pytest.mark.slow
    def test_hierarchical(self, arm, lanes):
        some = cases(arm, lanes)
        ours = solve_lanes(some, SCHEMES["hierarchical"])
        assert (ours.status == Status.SOLVED).all()
        assert (ours.box_violation < 1e-12).all()
        for i in range(LANES):
            p = numbers(some, i, [[name] for name in ORDER[1:]])
            whole = Hierarchies([Rows(*(a[None] for a in g)) for g in p.groups], p.box[0][None], p.box[1][None])
            x = np.asarray(ours.velocity[i])
            np.testing.assert_allclose(norms(whole, 0, x), reference(whole, 0)[1], rtol=0, atol=1e-8)
            assert certificate(whole, 0, x).max() < 1e-7
        assert np.abs(ours.slack["elbow"]).max() < 1e-12

    def test_projection(self, arm, lanes):
        """The first level is undamped and has the rows that standing still violates; below it nothing looks at them."""
        some = cases(arm, lanes, hard=("elbow",))
        ours = solve_lanes(some, SCHEMES["null-space"])
        assert (ours.status == Status.SOLVED).all()
        for i in range(LANES):
            p = numbers(some, i, [[name] for name in ORDER[1:]])
            x, P = np.zeros(arm.nv), np.eye(arm.nv)
            for k, group in enumerate(p.groups):
                root = np.sqrt(group.weight)
                value = group.A @ x
                wanted = root * (np.clip(value, group.lower, group.upper) - value)
                counts = (group.lower == group.upper) | (wanted != 0.0)
                U, s, V = np.linalg.svd((root[:, None] * group.A)[counts] @ P, full_matrices=False)
                real = s > 1e-9
                U, s, V = U[:, real], s[real], V[real]
                x = x + V.T @ (s / (s**2 + (1e-4 if k else 0.0)) * (U.T @ wanted[counts]))
                P = P - V.T @ V
            np.testing.assert_allclose(ours.velocity[i], x, rtol=0, atol=1e-9)
            first = p.groups[0]
            broken = first.A @ x - np.clip(first.A @ x, first.lower, first.upper)
            box = np.maximum(np.maximum(p.box[0] - x, x - p.box[1]), 0.0).max()
            np.testing.assert_allclose(ours.box_violation[i], max(np.abs(broken).max(), box), atol=1e-12)

    @pytest.mark.release
    def test_saturation(self, arm, lanes):
        some = cases(arm, lanes, hard=("elbow",))
        ours = solve_lanes(some, SCHEMES["saturated"])
        assert (ours.status == Status.SOLVED).all()
        assert np.abs(ours.slack["elbow"]).max() < 1e-12
        linear = some.limits[-1]
        value = np.einsum("bmn,bn->bm", linear.matrix, ours.velocity)
        needed = np.asarray(linear.lower) > 0.0
        assert needed.any()
        assert (value - linear.lower)[needed].min() > -1e-12


@pytest.fixture(scope="module")
def spoiled(lanes):
    """Lane 3: one joint has to turn both ways; lane 5: a NaN."""
    q, place, matrix, lower, upper = map(np.array, lanes)
    matrix[3, 0] = matrix[3, 1] = np.eye(7)[0]
    lower[3, 0], upper[3, 0], lower[3, 1], upper[3, 1] = 1.0, np.inf, -np.inf, -1.0
    matrix[5, 2, 4] = np.nan
    return tuple(map(jnp.asarray, (q, place, matrix, lower, upper)))


@pytest.mark.variants(slow=["hierarchical"], release=["saturated"])
@pytest.mark.parametrize("name", SCHEMES)
def test_contradictions_stay_in_their_lane(arm, lanes, spoiled, name):
    clean = solve_lanes(cases(arm, lanes), SCHEMES[name])
    some = cases(arm, spoiled)
    ours = solve_lanes(some, SCHEMES[name])
    expected = np.full(LANES, Status.SOLVED)
    expected[3], expected[5] = Status.INFEASIBLE, Status.NUMERICAL_ERROR
    np.testing.assert_array_equal(ours.status, expected)
    others = np.flatnonzero(expected == Status.SOLVED)
    np.testing.assert_allclose(ours.velocity[others], clean.velocity[others], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(ours.velocity[5], 0.0)
    for leaf in jax.tree.leaves(ours):
        assert np.isfinite(leaf).all()
    if name in ("weighted", "hierarchical"):
        p = numbers(some, 3, [[name] for name in ORDER[1:]])
        v = np.asarray(ours.velocity[3])
        assert (p.box[0] <= v).all() and (v <= p.box[1]).all()
        whole = Hierarchies([Rows(*(a[None] for a in g)) for g in p.groups], p.box[0][None], p.box[1][None])
        np.testing.assert_allclose(norms(whole, 0, v)[0], reference(whole, 0)[1][0], rtol=1e-6)
        assert 0.5 < ours.box_violation[3] <= 1.0 + 1e-9


@pytest.mark.variants(slow=["saturated", "hierarchical"])
@pytest.mark.parametrize("name", SCHEMES)
def test_nothing_to_do_is_no_contradiction(arm, lanes, name):
    """Where all is met to rounding the velocity is rounding, and what it misses of the constraints as large."""
    rng = np.random.default_rng(9)
    place = 10.0 ** rng.uniform(-16, -8, (LANES, 1)) * rng.normal(size=(LANES, 3))
    q, ones = jnp.tile(arm.q0, (LANES, 1)), jnp.ones((LANES, 3))
    still = cases(arm, (q, jnp.asarray(place), lanes[2], -ones, ones))
    ours = solve_lanes(still, SCHEMES[name])
    assert (ours.status == Status.SOLVED).all()
    if name != "null-space":
        assert np.abs(ours.velocity).max() < 1e-5


class TestPrograms:
    def test_other_numbers_compile_nothing(self, arm, lanes):
        """Rows, bounds, weights and gains of constraints are traced."""
        traces = []

        @jax.jit
        def step(case):
            traces.append(1)
            return osik.solve(
                case.robot, case.q, case.tasks, scheme=osik.NullSpace(), limits=case.limits, dt=DT
            ).velocity

        one, other = (case(arm, jax.tree.map(lambda leaf, i=i: leaf[i], lanes)) for i in range(2))
        tasks = {**other.tasks, "elbow": other.tasks["elbow"].replace(weight=3.0, gain=0.5)}
        assert np.abs(step(one) - step(Case(arm, other.q, tasks, other.limits))).max() > 1e-3
        assert len(traces) == 1

    def test_without_constraints_there_is_no_level_for_them(self, arm):
        tasks = {"posture": osik.PostureTask(arm, weight=1.0)}
        limits = osik.ConfigurationLimit(arm), osik.VelocityLimit(arm)
        kinematics = kinematics_at(arm, arm.q0)
        assert limit_rows(arm, kinematics, arm.q0, limits, DT) is None
        rows = {name: task.rows(arm, kinematics, arm.q0) for name, task in tasks.items()}
        free = jnp.full(arm.nv, jnp.inf)
        problem = VelocityProblem(rows, (("posture", 1),), -free, free, arm.q0, -free, free)
        assert problem.constraints() is None
        assert len(problem.levels(None)) == 1

    @pytest.mark.slow
    def test_single_precision(self, arm, lanes):
        wide = cases(arm, lanes)
        wide = Case(wide.robot, wide.q, {name: wide.tasks[name] for name in ("elbow", "posture")}, wide.limits)
        narrow = jax.tree.map(lambda leaf: leaf.astype(jnp.float32), (wide, osik.WeightedQP(damping=1e-2)))
        ours = solve_lanes(*narrow)
        assert ours.velocity.dtype == jnp.float32
        assert (ours.status == Status.SOLVED).all()
        assert np.abs(ours.slack["elbow"]).max() < 1e-5
        assert ours.box_violation.max() < 1e-5
        for i in range(LANES):
            exact = weighted_answer(numbers(wide, i, [["posture"]]), 1e-2)
            np.testing.assert_allclose(ours.velocity[i], exact, rtol=0, atol=1e-4)


def test_mistakes(arm):
    refuses(ValueError, r"matrix has shape \(2, 3\), expected \(m, 7\)", osik.LinearLimit, arm, np.ones((2, 3)), 0.0)
    refuses(ValueError, "needs lower, upper or both", osik.LinearLimit, arm, np.ones((2, 7)))
    with pytest.raises(ValueError, match=r"not finite in rows \[1\]"):
        osik.LinearLimit(arm, np.stack([np.ones(7), np.full(7, np.nan)]), 0.0)
    refuses(ValueError, "lower > upper", osik.LinearLimit, arm, np.ones((2, 7)), 1.0, 0.0)


@pytest.mark.release
@pytest.mark.parametrize("name", ["weighted", "null-space", "hierarchical"])
def test_derivatives_against_differences(arm, lanes, name):
    """With respect to the configuration, a target, and the rows and bounds of the limit."""
    rng = np.random.default_rng(6)
    rates = jax.tree.map(lambda leaf: jnp.asarray(rng.normal(size=leaf.shape)), lanes)

    def function(lane):
        c = case(arm, lane)
        s = osik.solve(c.robot, c.q, c.tasks, scheme=SCHEMES[name], limits=c.limits, dt=DT)
        return (s.velocity, s.slack), (s.status, s.warm_start)

    def path(both, t):
        return jax.tree.map(lambda leaf, rate: leaf + 0.01 * t * rate, *both)

    assert_exact(check(function, path, (lanes, rates)), most=0.7)

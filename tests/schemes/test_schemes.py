"""The three schemes against least squares whose optimality the test itself certifies, daqp, mink and NumPy."""

from __future__ import annotations

import dataclasses

import daqp
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from example_files import example_file
from hierarchy_families import Hierarchies, Rows
from lexicographic import certificate
from task_checks import kinematics_at, moved_by
from urdfs import joint, tree

import osik_jax as osik
from osik_jax.schemes._null_space import limit_potential_gradient

DT = 0.005
DAMPING = 1e-4
LANES = 6
G1 = "g1_description/urdf/g1_29dof_rev_1_0.urdf"


@dataclasses.dataclass(frozen=True)
class Case:
    robot: osik.Robot
    tasks: dict[str, osik.Task]
    limits: tuple[osik.Limit, ...]


@dataclasses.dataclass(frozen=True)
class Numbers:
    """One step's problem in NumPy: rows stacked, one entry of ``names`` for each row."""

    names: np.ndarray
    jacobian: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    weight: np.ndarray
    box: tuple[np.ndarray, np.ndarray]


def at_home(robot, frame):
    kinematics = kinematics_at(robot, robot.q0)
    return tuple(map(np.asarray, kinematics.frame_pose(robot, frame)))


def whole_body(robot, feet, hand, com, tight):
    """Feet, an inequality on the centre of mass, a hand that has far to go, posture; speeds that bind."""
    p, R = at_home(robot, hand)
    tasks = {
        **{foot: osik.FrameTask(robot, foot, weight=1e4) for foot in feet},
        "com": osik.ComTask(robot, **com, weight=1e-2, priority=2),
        "hand": osik.FrameTask(
            robot, hand, target=(p + np.array([0.2, 0.1, 0.1]), R), orientation_weight=0.1, priority=3
        ),
        "posture": osik.PostureTask(robot, weight=1e-2, gain=2.0, priority=4),
    }
    return Case(robot, tasks, (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity={"*": tight})))


@pytest.fixture(scope="module")
def nao():
    robot = osik.load_robot("nao")
    polygon = osik.support_polygon(robot, robot.q0, ("l_sole", "r_sole"), margin=0.04)
    return whole_body(robot, ("l_sole", "r_sole"), "l_gripper", {"polygon": polygon}, 1.0)


@pytest.fixture(scope="module")
def g1():
    robot = osik.Robot.from_urdf(example_file(G1), floating_base=True)
    feet = ("left_ankle_roll_link", "right_ankle_roll_link")
    bounds = {"axes": "xy", "lower": [0.02, -0.01], "upper": [0.05, 0.01]}
    return whole_body(robot, feet, "left_wrist_yaw_link", bounds, 1.5)


def arm_tasks(robot, priorities, weights=(1.0, 1.0, 1.0)):
    """A pose that contradicts a position."""
    p, R = at_home(robot, "hand")
    first, second, third = ({"priority": k, "weight": w} for k, w in zip(priorities, weights, strict=True))
    return {
        "position": osik.FrameTask(robot, "hand", target=(p + np.array([0.1, 0.2, -0.1]), R), rows="position", **first),
        "pose": osik.FrameTask(robot, "hand", target=(p + np.array([-0.1, 0.1, 0.2]), R), **second),
        "posture": osik.PostureTask(robot, **third),
    }


@pytest.fixture(scope="module")
def arm():
    robot = osik.load_robot("arm7")
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity={"*": 1.0})
    return Case(robot, arm_tasks(robot, (1, 2, 3)), limits)


def configurations(case, rng, spread=0.3):
    """Around home, inside the joints' ranges, some joints on their limits."""
    robot = case.robot
    moves = rng.uniform(-spread, spread, (LANES, robot.nv))
    moves[0] = 0.0
    if robot.floating_base:
        moves[:, :6] *= 0.1
    q = np.array(jax.vmap(moved_by, in_axes=(None, None, 0))(robot, robot.q0, jnp.asarray(moves)))
    joints = q[:, 7 * robot.floating_base :]
    low, high = (np.asarray(b)[6 * robot.floating_base :] for b in (robot.position_lower, robot.position_upper))
    np.clip(joints, low, high, out=joints)
    return q


@jax.jit
def rows_and_box(robot, tasks, limits, q, dt):
    kinematics = osik.forward_kinematics(robot, q)
    return {k: t.rows(robot, kinematics, q) for k, t in tasks.items()}, osik.limit_box(robot, q, limits, dt)


def numbers(case, q, names=None):
    rows, box = rows_and_box(case.robot, case.tasks, case.limits, q, DT)
    names = list(rows) if names is None else names
    fields = ("jacobian", "lower", "upper", "weight")
    stack = {f: np.concatenate([np.asarray(getattr(rows[n], f)) for n in names]) for f in fields}
    labels = np.concatenate([[n] * len(rows[n].weight) for n in names])
    return Numbers(names=labels, box=(np.asarray(box[0]), np.asarray(box[1])), **stack)


@jax.jit
def compiled_lanes(robot, q, tasks, scheme, limits):
    return jax.vmap(lambda q: osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=DT))(q)


def solve_lanes(case, q, scheme):
    """One program for all configurations, and for all cases with the same tasks."""
    return jax.tree.map(np.asarray, compiled_lanes(case.robot, jnp.asarray(q), case.tasks, scheme, case.limits))


def gap(value, lower, upper):
    return value - np.clip(value, lower, upper)


def weighted_qp(problem: Numbers, damping: float) -> np.ndarray:
    """min 1/2 sum w dist(J v, [l, u])^2 + 1/2 damping |v|^2 in the box: daqp's active set, solved anew and certified.

    daqp sees the textbook form over (v, s), with J v - s in its interval. Its active set then gives a least-squares
    problem without constraints, solved from the factors; the signs of the multipliers prove the optimum.
    """
    n, m = problem.jacobian.shape[1], len(problem.weight)
    H = np.diag(np.concatenate([np.full(n, damping), problem.weight]))
    A = np.concatenate([problem.jacobian, -np.eye(m)], 1)
    wide = np.full(m, 1e30)
    upper = np.nan_to_num(np.concatenate([problem.box[1], wide, problem.upper]), posinf=1e30)
    lower = np.nan_to_num(np.concatenate([problem.box[0], -wide, problem.lower]), neginf=-1e30)
    sense = np.where(upper == lower, 5, 0).astype(np.int32)
    x, _, flag, info = daqp.solve(H, np.zeros(n + m), A, upper, lower, sense, iter_limit=10000)
    assert flag == 1
    active = np.abs(info["lam"]) > 1e-9
    held = active[:n]
    v = np.where(held, np.where(np.abs(x[:n] - lower[:n]) < np.abs(x[:n] - upper[:n]), lower[:n], upper[:n]), 0.0)
    counts = (problem.lower == problem.upper) | active[n + m :]
    value = problem.jacobian @ x[:n]
    wanted = np.where(value < 0.5 * (problem.lower + problem.upper), problem.lower, problem.upper)
    wanted = np.where(np.isinf(problem.lower), problem.upper, np.where(np.isinf(problem.upper), problem.lower, wanted))
    root = np.where(counts, np.sqrt(problem.weight), 0.0)
    stacked = np.concatenate([root[:, None] * problem.jacobian, np.sqrt(damping) * np.eye(n)])
    target = np.concatenate([root * np.where(counts, wanted, 0.0), np.zeros(n)])
    v[~held] = np.linalg.lstsq(stacked[:, ~held], target - stacked @ v, rcond=None)[0]
    certify(problem, damping, v)
    return v


def certify(problem: Numbers, damping: float, v: np.ndarray) -> None:
    """v is in the box, and the cost falls in no direction that leads into it."""
    slack = gap(problem.jacobian @ v, problem.lower, problem.upper)
    gradient = problem.jacobian.T @ (problem.weight * slack) + damping * v
    small = 1e-10 * np.abs(problem.jacobian.T * problem.weight).max() * max(1.0, np.abs(v).max())
    low, high = problem.box
    assert (v >= low).all()
    assert (v <= high).all()
    assert (np.abs(gradient[(v > low) & (v < high)]) <= small).all()
    assert (gradient[(v == low) & (v < high)] >= -small).all()
    assert (gradient[(v == high) & (v > low)] <= small).all()


class TestWeightedQP:
    @pytest.mark.variants(slow=["nao"], release=["g1"])
    @pytest.mark.parametrize("name", ["nao", "g1"])
    def test_agrees_with_the_textbook_qp(self, name, request, rng):
        case = request.getfixturevalue(name)
        q = configurations(case, rng)
        ours = solve_lanes(case, q, osik.WeightedQP(damping=DAMPING, curvature_damping=0.0))
        np.testing.assert_array_equal(ours.status, osik.Status.SOLVED)
        bounded = violated = 0
        for k in range(LANES):
            problem = numbers(case, q[k])
            expected = weighted_qp(problem, DAMPING)
            np.testing.assert_allclose(ours.velocity[k], expected, rtol=0, atol=1e-8)
            assert (ours.velocity[k] >= problem.box[0]).all()
            assert (ours.velocity[k] <= problem.box[1]).all()
            slack = gap(problem.jacobian @ expected, problem.lower, problem.upper)
            for task, own in ours.slack.items():
                np.testing.assert_allclose(own[k], slack[problem.names == task], rtol=0, atol=1e-8)
            bounded += np.sum((expected == problem.box[0]) | (expected == problem.box[1]))
            violated += np.sum(np.abs(slack[problem.names == "com"]) > 1e-6)
        assert ours.box_violation.max() == 0.0
        assert bounded > 10
        assert violated > 0

    def test_a_row_of_weight_zero_costs_nothing(self, arm):
        """An inequality that is violated however the arm moves, and no other task of weight: nothing moves."""
        tasks = {"position": osik.FrameTask(arm.robot, "hand", rows="position", lower=1.0, weight=0.0)}
        scheme = osik.WeightedQP(damping=1e-6, curvature_damping=0.0)
        ours = osik.solve(arm.robot, arm.robot.q0, tasks, scheme=scheme, dt=DT, limits=osik.no_limits)
        np.testing.assert_allclose(ours.velocity, 0.0, rtol=0, atol=1e-12)
        assert int(ours.status) == osik.Status.SOLVED


def levels(case, q):
    """By priority: weighted rows and their bounds."""
    for rank in sorted({task.priority for task in case.tasks.values()}):
        problem = numbers(case, q, [name for name, task in case.tasks.items() if task.priority == rank])
        root = np.sqrt(problem.weight)
        yield root[:, None] * problem.jacobian, root * problem.lower, root * problem.upper


def projected(stack, n, secondary):
    """Eq. 7 with NumPy's pseudo-inverse."""
    x, P = np.zeros(n), np.eye(n)
    for A, b, _ in stack:
        inverse = np.linalg.pinv(A @ P, rcond=1e-9 * np.linalg.norm(A) / max(np.linalg.norm(A @ P), 1e-300))
        x, P = x + inverse @ (b - A @ x), P - inverse @ (A @ P)
    return x + P @ secondary


def unlimited(case):
    """The same limits, at infinity."""
    free = np.full(case.robot.nv, np.inf)
    limits = osik.ConfigurationLimit(case.robot, lower=-free, upper=free), osik.VelocityLimit(case.robot, velocity=free)
    return dataclasses.replace(case, limits=limits)


def undamped(gain=0.0):
    return osik.NullSpace(damping=0.0, curvature_damping=0.0, potential_gain=gain, rank_tolerance=1e-9)


class TestNullSpace:
    def test_agrees_with_numpy(self, arm, rng):
        """Equality tasks and the potential's descent in what is left."""
        tasks = {name: arm.tasks[name] for name in ("position",)}
        case = dataclasses.replace(arm, tasks=tasks)
        q = configurations(case, rng)
        ours = solve_lanes(case, q, undamped(0.02))
        for k in range(LANES):
            slope = limit_potential_gradient(jnp.asarray(q[k]), case.robot.position_lower, case.robot.position_upper)
            expected = projected(levels(case, q[k]), case.robot.nv, -0.02 * np.asarray(slope))
            np.testing.assert_allclose(ours.velocity[k], expected, rtol=0, atol=1e-9)
            np.testing.assert_allclose(ours.slack["position"][k], 0.0, rtol=0, atol=1e-10)

    def test_the_potential_leads_away_from_limits_and_keeps_the_task(self, arm):
        robot = arm.robot
        q0 = robot.configuration({"joint1": 2.6, "joint3": -2.6, "joint5": 2.6})
        p = np.asarray(kinematics_at(robot, q0).frame_pose(robot, "hand")[0])
        tasks = {"position": osik.FrameTask(robot, "hand", target=(p, np.eye(3)), rows="position")}
        run = {
            gain: osik.rollout(robot, q0, tasks, scheme=undamped(gain), limits=arm.limits, dt=0.01, steps=100)
            for gain in (0.0, 2.0)
        }
        middle = 0.5 * (robot.position_lower + robot.position_upper)
        span = robot.position_upper - robot.position_lower
        room = {gain: 0.5 - np.max(np.abs((t.q - middle) / span), 1) for gain, t in run.items()}
        np.testing.assert_allclose(run[0.0].q, np.broadcast_to(q0, (101, 7)), rtol=0, atol=1e-12)
        assert (np.diff(room[2.0]) > -1e-12).all()
        assert room[2.0][-1] > 1.5 * room[2.0][0]
        assert np.abs(run[2.0].solution.error["position"]).max() < 1e-3

    @pytest.mark.slow
    def test_says_by_how_much_it_leaves_the_box(self, arm, rng):
        q = configurations(arm, rng)
        ours = solve_lanes(arm, q, undamped())
        for k in range(LANES):
            low, high = numbers(arm, q[k]).box
            expected = np.max(np.maximum(np.maximum(low - ours.velocity[k], ours.velocity[k] - high), 0.0))
            assert ours.box_violation[k] == expected
        assert ours.box_violation.max() > 0.1


def lexicographic_residual(case, q, v):
    """How far v is from the lexicographic optimum: 0 proves it, for the problem of each level is convex."""
    stack = [Rows(A[None], low[None], high[None], np.ones((1, len(A)))) for A, low, high in levels(case, q)]
    low, high = numbers(case, q).box
    return certificate(Hierarchies(stack, low[None], high[None]), 0, v).max()


class TestHierarchicalQP:
    @pytest.mark.variants(release=["nao"])
    @pytest.mark.parametrize("name", ["arm", "nao"])
    def test_is_the_lexicographic_optimum_and_keeps_its_box_exactly(self, name, request, rng):
        """The arm: the second level contradicts the first. NAO: an inequality at the second. Speeds bind in both."""
        case = request.getfixturevalue(name)
        q = configurations(case, rng)
        ours = solve_lanes(case, q, osik.HierarchicalQP(curvature_damping=0.0))
        np.testing.assert_array_equal(ours.status, osik.Status.SOLVED)
        bounded = 0
        for k in range(LANES):
            low, high = numbers(case, q[k]).box
            v = ours.velocity[k]
            assert (v >= low).all()
            assert (v <= high).all()
            assert lexicographic_residual(case, q[k], v) < 1e-9
            assert lexicographic_residual(case, q[k], np.clip(v + 1e-5, low, high)) > 1e-7
            bounded += np.sum((v == low) | (v == high))
        assert ours.box_violation.max() == 0.0
        assert bounded > 5

    def test_equals_the_null_space_where_no_bound_is_active(self, arm, rng):
        """Both are eq. 7, though the second level contradicts the first."""
        case = unlimited(arm)
        q = configurations(case, rng)
        ours, projection = (
            solve_lanes(case, q, scheme) for scheme in (osik.HierarchicalQP(curvature_damping=0.0), undamped())
        )
        np.testing.assert_allclose(ours.velocity, projection.velocity, rtol=0, atol=1e-8)
        for k in range(LANES):
            expected = projected(levels(case, q[k]), case.robot.nv, np.zeros(case.robot.nv))
            np.testing.assert_allclose(ours.velocity[k], expected, rtol=0, atol=1e-8)


HELD = tree(
    joint("held", "a", "b", '<limit lower="0.3" upper="0.3" velocity="2" effort="1"/>'),
    joint("turn", "b", "c", axis="0 1 0"),
    joint("bend", "c", "d"),
)


@pytest.mark.variants(slow=["jax-saturated"])
@pytest.mark.parametrize("method", ["classical", "saturated"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
def test_a_joint_that_its_limits_hold_leaves_the_null_space_to_the_others(method, backend):
    with pytest.warns(osik.OsikWarning, match="these joints cannot move"):
        robot = osik.Robot.from_urdf(HELD, floating_base=False)
    tasks = {"posture": osik.PostureTask(robot, target=robot.q0 + jnp.array([0.0, 0.1, 0.1]), gain=10.0, weight=1.0)}
    solution = osik.solve(robot, robot.q0, tasks, scheme=osik.NullSpace(method=method, backend=backend))
    assert solution.status == osik.Status.SOLVED
    np.testing.assert_allclose(solution.velocity[1:], 1.0, rtol=1e-6)


@pytest.mark.variants(slow=["classical"], release=["saturated"])
@pytest.mark.parametrize("method", ["saturated", "classical"])
def test_damping_alone_leaves_a_residual_of_the_first_priority(method):
    """Out of reach, SOLVED and as exact as in reach; ``kkt_residual`` is not relative for this scheme."""
    arm = osik.load_robot("arm7")
    far = {"hand": osik.FrameTask(arm, "hand", target=jnp.array([2.0, 0.0, 1.0]), rows="position")}
    q = arm.q0 + 0.3 * jax.random.normal(jax.random.key(0), (8, arm.nq))

    @jax.jit
    def solved(damping, curvature_damping):
        scheme = osik.NullSpace(method=method, damping=damping, curvature_damping=curvature_damping)
        return jax.vmap(lambda q: osik.solve(arm, q, far, scheme=scheme, dt=0.01))(q)

    exact, damped = solved(0.0, 0.0), solved(1e-3, 1.0)
    assert not np.any(exact.status) and not np.any(damped.status)
    assert np.max(exact.kkt_residual) < 1e-12 < 1e-4 < np.max(damped.kkt_residual)

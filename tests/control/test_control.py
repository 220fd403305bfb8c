"""One step and many: the loop against itself in Python, batches against loops, derivatives, failures and mistakes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses
from task_checks import kinematics_at

import osik_jax as osik
from osik_jax import raise_if_failed

DT = 0.01
STEPS = 20
SCHEMES = {
    "weighted": osik.WeightedQP(damping=1e-4),
    "null-space": osik.NullSpace(damping=1e-6),
    "hierarchical": osik.HierarchicalQP(),
}
all_schemes = pytest.mark.parametrize("name", SCHEMES)


@pytest.fixture(scope="module")
def home(arm):
    return tuple(map(np.asarray, kinematics_at(arm, arm.q0).frame_pose(arm, "hand")))


@pytest.fixture(scope="module")
def tasks(arm, home):
    return lane(arm, home, "nothing", "weighted")[2]


@pytest.fixture(scope="module")
def limits(arm):
    return osik.ConfigurationLimit(arm), osik.VelocityLimit(arm, velocity={"*": 0.8})


def paths(home):
    """Targets of the hand at every step: a curve, and a turn about z."""
    t = DT * np.arange(STEPS)
    c, s, zero, one = np.cos(t), np.sin(t), np.zeros(STEPS), np.ones(STEPS)
    turn = np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    return home[0] + np.stack([0.2 * t, 0.1 * np.sin(8.0 * t), -0.1 * t], 1), turn @ home[1]


step = jax.jit(osik.integrate)


def loop(robot, q, tasks_at, scheme, limits, dt=DT, steps=STEPS, measured=None):
    """The rollout in Python."""
    qs, solutions, warm_start = [np.asarray(q)], [], None
    for k in range(steps):
        q = q if measured is None else measured(k, q)
        solutions.append(osik.solve(robot, q, tasks_at(k), scheme=scheme, limits=limits, dt=dt, warm_start=warm_start))
        warm_start = solutions[-1].warm_start
        q = step(robot, q, solutions[-1].velocity, dt)
        qs.append(np.asarray(q))
    return np.array(qs), jax.tree.map(lambda *leaves: np.stack(leaves), *solutions)


def assert_same(ours, theirs, atol):
    for a, b in zip(jax.tree.leaves(ours), jax.tree.leaves(theirs), strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=atol)


def options_of(limits, name="weighted"):
    return {"scheme": SCHEMES[name], "limits": limits, "dt": DT, "steps": STEPS}


class TestRollout:
    @pytest.fixture(scope="class")
    @staticmethod
    def tasks_at(tasks, home):
        """Return a function of the step: the tasks, with the target that moves."""
        p, R = map(jnp.asarray, paths(home))
        return lambda k: {**tasks, "hand": tasks["hand"].replace(target=(p[k], R[k]))}

    @pytest.mark.variants(release=["hierarchical", "weighted"])
    @all_schemes
    def test_equals_a_python_loop(self, arm, home, tasks, limits, tasks_at, name):
        """Every number of the solution but the warm start, with a target that moves."""
        run = osik.rollout(arm, arm.q0, tasks, **options_of(limits, name), targets={"hand": paths(home)})
        q, solution = loop(arm, arm.q0, tasks_at, SCHEMES[name], limits)
        np.testing.assert_allclose(run.time, DT * np.arange(STEPS), rtol=0, atol=1e-15)
        np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-12)
        assert_same(run.solution, solution, 1e-10)
        np.testing.assert_array_equal(run.solution.status, osik.Status.SOLVED)
        assert np.abs(q[-1] - q[0]).max() > 0.05

    @pytest.mark.variants(slow=["function"])
    @pytest.mark.parametrize("kind", ["function", "array"])
    def test_functions_of_time_for_tasks_and_feedback(self, arm, limits, tasks_at, rng, kind):
        """Feedback: the configuration that the last step led to comes back changed, or another one comes."""
        recorded = np.asarray(arm.q0) + 0.05 * rng.normal(size=(STEPS, arm.nq))
        feedback, measured = {
            "function": (lambda t, q: 0.9 * q + 0.01 * t, lambda k, q: 0.9 * q + 0.01 * DT * k),
            "array": (recorded, lambda k, q: recorded[k]),
        }[kind]
        run = osik.rollout(
            arm, arm.q0, lambda t: tasks_at(jnp.round(t / DT).astype(int)), **options_of(limits), feedback=feedback
        )
        q, solution = loop(arm, arm.q0, tasks_at, SCHEMES["weighted"], limits, measured=measured)
        np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-12)
        assert_same(run.solution, solution, 1e-10)

    def test_a_start_of_integers_and_of_less_precision(self, arm, tasks, limits):
        q0 = np.array([0, -1, 0, -2, 0, 2, 1])
        starts: tuple[Any, ...] = (q0.astype(float), q0, q0.astype(np.float32), q0.tolist())
        runs = [osik.rollout(arm, q, tasks, **options_of(limits), targets={"hand": same(tasks)}) for q in starts]
        for run in runs[1:]:
            np.testing.assert_array_equal(run.q, runs[0].q)

    @pytest.mark.variants(slow=["hierarchical"])
    @all_schemes
    def test_a_joint_far_outside_its_range_comes_back(self, arm, tasks, limits, name):
        """At full speed where the box is hard; the null space has none."""
        q0 = arm.configuration({"joint2": float(arm.position_upper[1]) + 0.05})
        run = osik.rollout(arm, q0, tasks, **options_of(limits, name), targets={"hand": same(tasks)})
        np.testing.assert_array_equal(run.solution.status, osik.Status.SOLVED)
        joint = np.asarray(run.q)[:, 1]
        if name == "null-space":
            assert np.isfinite(run.q).all()
            return
        expected = np.maximum(joint[0] - 0.8 * DT * np.arange(7), float(arm.position_upper[1]))
        np.testing.assert_allclose(joint[:7], expected, rtol=0, atol=1e-12)
        assert (joint[7:] <= float(arm.position_upper[1])).all()
        assert np.max(run.solution.box_violation) == 0.0

    def test_no_steps(self, arm, tasks):
        run = osik.rollout(arm, arm.q0, tasks, scheme=SCHEMES["weighted"], steps=0, limits=osik.no_limits)
        np.testing.assert_array_equal(run.q, [arm.q0])


def same(tasks):
    """The hand's target, at every step."""
    return tuple(np.tile(part, (STEPS,) + (1,) * part.ndim) for part in tasks["hand"].target)


CHANGES = ("nothing", "q", "target", "weight", "gain", "speed", "range", "dt", "robot", "bound", "scheme")


def lane(robot, home, change, name, shift=0.3):
    """Everything that may be batched, with one thing changed."""
    p, R = home
    longer = robot.body_position * (1.0 + 0.2 * shift) if change == "robot" else robot.body_position
    body = eqx.tree_at(lambda r: r.body_position, robot, longer)
    changed = {key: shift if change == key else 0.0 for key in CHANGES}
    target = (p + np.array([0.015, 0.03, -0.015]) + 0.1 * changed["target"], R)
    tasks = {
        "hand": osik.FrameTask(
            robot,
            "hand",
            rows="position",
            target=target,
            weight=1.0 + 10.0 * changed["weight"],
            gain=10.0 + 10.0 * changed["gain"],
        ),
        "elbow": osik.FrameTask(
            robot, "link4", rows="position", upper=[np.inf, -0.002 - 0.01 * changed["bound"], np.inf], priority=2
        ),
        "posture": osik.PostureTask(robot, joints=("joint1", "joint2"), gain=2.0, priority=3, weight=0.1),
    }
    speeds = osik.VelocityLimit(robot, velocity={"*": 0.4 + changed["speed"]})
    ranges = osik.ConfigurationLimit(robot, upper={"joint2": -0.783 - 0.02 * changed["range"], "joint1": 2.5})
    q = robot.q0 + changed["q"] * np.linspace(-0.2, 0.2, robot.nq)
    scheme = SCHEMES[name]
    if name == "null-space":
        scheme = osik.NullSpace(damping=0.01 + 0.1 * changed["scheme"], potential_gain=0.05 * (1 + changed["range"]))
    if name == "weighted":
        scheme = osik.WeightedQP(damping=0.01 + 0.1 * changed["scheme"])
    return body, q, tasks, scheme, (ranges, speeds), jnp.asarray(0.02 * (1.0 + changed["dt"]))


def solve_lane(robot, q, tasks, scheme, limits, dt):
    return osik.solve(robot, q, tasks, scheme=scheme, limits=limits, dt=dt)


batch = jax.jit(jax.vmap(solve_lane))


def stack(lanes):
    return jax.tree.map(lambda *leaves: jnp.stack([jnp.asarray(leaf) for leaf in leaves]), *lanes)


class TestBatches:
    @pytest.mark.variants(slow=["hierarchical", "null-space"])
    @all_schemes
    def test_vmap_over_everything_equals_a_loop(self, arm, home, name):
        """Configurations, targets, weights, gains, bounds, limits, dt, link lengths and the scheme's own numbers."""
        lanes = [lane(arm, home, change, name) for change in CHANGES]
        together = batch(*stack(lanes))
        for k, alone in enumerate(lanes):
            expected = solve_lane(*alone)
            assert int(expected.status) == osik.Status.SOLVED
            np.testing.assert_allclose(together.velocity[k], expected.velocity, rtol=0, atol=1e-9, err_msg=CHANGES[k])
            one = jax.tree.map(lambda leaf, k=k: leaf[k], together)
            assert_same((one.slack, one.error, one.status), (expected.slack, expected.error, expected.status), 1e-9)
        moved = np.abs(np.asarray(together.velocity[1:] - together.velocity[0])).max(1)
        idle = {"null-space": ("speed",), "hierarchical": ("weight", "scheme"), "weighted": ()}[name]
        for change, size in zip(CHANGES[1:], moved, strict=True):
            assert (size < 1e-9) if change in idle else (size > 1e-6), change

    @pytest.mark.variants(release=["hierarchical"])
    @all_schemes
    def test_nan_stays_in_its_lane(self, arm, home, name):
        """Neighbours to the last bit; the lane itself stands still, as far as its box lets it, and says so."""
        lanes = stack([lane(arm, home, change, name) for change in CHANGES])
        robot, q, tasks, scheme, limits, dt = lanes
        infinite = tasks["hand"].gain.at[4].set(jnp.inf)
        spoiled = {
            "q": (robot, q.at[4, 2].set(jnp.nan), tasks, scheme, limits, dt),
            "target": (robot, q, eqx.tree_at(target_of_hand, tasks, replace_fn=nan_in_lane_4), scheme, limits, dt),
            "infinite gain": (robot, q, eqx.tree_at(lambda t: t["hand"].gain, tasks, infinite), scheme, limits, dt),
            "limit": (robot, q, tasks, scheme, jax.tree.map(nan_in_lane_4, limits), dt),
        }
        good = batch(*lanes)
        others = np.arange(len(CHANGES)) != 4
        for what, arguments in spoiled.items():
            bad = batch(*arguments)
            if what == "limit" and name == "null-space":
                continue  # it has no box to spoil
            assert int(bad.status[4]) == osik.Status.NUMERICAL_ERROR, what
            for a, b in zip(jax.tree.leaves(good), jax.tree.leaves(bad), strict=True):
                np.testing.assert_array_equal(np.asarray(a)[others], np.asarray(b)[others], err_msg=what)
                assert np.isfinite(np.asarray(b)[4]).all(), what
            np.testing.assert_array_equal(bad.velocity[4], np.zeros(arm.nv), err_msg=what)
            assert float(bad.box_violation[4]) == 0.0

    @pytest.mark.variants(slow=["hierarchical"])
    @all_schemes
    def test_a_failed_lane_outside_its_range_still_moves_into_its_box(self, arm, home, name):
        """The box wins: a joint above its range comes back at the speed that the limits ask for."""
        robot, q, tasks, scheme, limits, dt = stack([lane(arm, home, change, name) for change in CHANGES])
        tasks = eqx.tree_at(target_of_hand, tasks, replace_fn=nan_in_lane_4)
        out = batch(robot, q.at[4, 0].set(2.8), tasks, scheme, limits, dt)
        expected = np.zeros(arm.nv)
        if name != "null-space":
            expected[0] = -0.4
        np.testing.assert_array_equal(out.velocity[4], expected)


def target_of_hand(tasks):
    return tasks["hand"].target[0]


def nan_in_lane_4(leaf):
    return leaf.at[4].set(jnp.nan)


class TestStatus:
    def test_raise_if_failed_names_the_lanes(self, arm, home):
        robot, q, tasks, scheme, limits, dt = stack([lane(arm, home, change, "weighted") for change in CHANGES])
        raise_if_failed(batch(robot, q, tasks, scheme, limits, dt))
        bad = batch(robot, q.at[4, 2].set(jnp.nan), tasks, scheme, limits, dt)
        refuses(RuntimeError, r"NUMERICAL_ERROR in 1 of 11 lanes \(\(4,\)\): .*NaN", raise_if_failed, bad)

    def test_a_cap_on_iterations_is_said_and_the_box_still_holds(self, arm):
        """Speeds that bind need changes of the active set."""
        tasks = {"posture": osik.PostureTask(arm, target=np.asarray(arm.q0) + 0.3, weight=1.0)}
        limits = (osik.VelocityLimit(arm, velocity={"*": 0.1}),)
        for scheme in (osik.WeightedQP(max_iterations=1), osik.HierarchicalQP(max_iterations=1)):
            solution = osik.solve(arm, arm.q0, tasks, scheme=scheme, limits=limits)
            assert int(solution.status) == osik.Status.MAX_ITERATIONS
            assert np.abs(solution.velocity).max() <= 0.1
            assert float(solution.box_violation) == 0.0
            refuses(RuntimeError, r"MAX_ITERATIONS in 1 of 1 lanes.*raise max_iterations", raise_if_failed, solution)


def test_mistakes_beside_those_of_the_table_of_wrong_inputs(arm, tasks):
    options = dict(scheme=SCHEMES["weighted"], steps=3)
    wrong = {"targets": {"posture": [[0.0] * 7]}}, {"feedback": lambda t, q: q[:2]}, {"feedback": np.zeros((3, 6))}
    refuses(ValueError, "targets go with a dict", osik.rollout, arm, arm.q0, lambda t: tasks, **options, **wrong[0])
    refuses(ValueError, r"q has shape \(2,\)", osik.rollout, arm, arm.q0, tasks, **options, **wrong[1])
    refuses(ValueError, r"feedback has shape \(3, 6\)", osik.rollout, arm, arm.q0, tasks, **options, **wrong[2])
    targets = {"posture": np.zeros((3, 5))}
    message = r"target has shape \(5,\), expected \(7,\)"
    refuses(ValueError, message, osik.rollout, arm, arm.q0, tasks, **options, targets=targets)
    each: list[tuple[str, Any, str]] = [("q0", np.zeros(3), r"shape \(3,\)"), ("tasks", {}, "no task")]
    each += [("dt", 0.0, "dt is"), ("scheme", osik.WeightedQP, "scheme is"), ("limits", 3, "limits")]
    for name, value, message in each:
        given = {"q0": arm.q0, "tasks": tasks, **options, name: value}
        refuses((ValueError, TypeError), message, osik.rollout, arm, **given)
    refuses(ValueError, "potential_gain is nan", osik.NullSpace, potential_gain=np.nan)
    refuses(ValueError, r"margin has shape \(2,\), expected a scalar", osik.NullSpace, margin=np.zeros(2))


def test_a_list_of_targets_is_an_error_that_says_so(arm):
    tasks = {"hand": osik.FrameTask(arm, "hand", rows="position")}
    places = [[0.4, 0.0, 0.5], [0.4, 0.1, 0.5], [0.4, 0.2, 0.5]]
    message = r"targets\['hand'\] is or holds a list of numbers"
    for target in (places, (places,)):
        refuses(TypeError, message, osik.rollout, arm, arm.q0, tasks, steps=3, targets={"hand": target})
    pair = [jnp.array(places), jnp.tile(jnp.eye(3), (3, 1, 1))]
    assert osik.rollout(arm, arm.q0, tasks, steps=3, targets={"hand": pair}).q.shape == (4, arm.nq)

"""One step and many: the loop against itself in Python, batches against loops, derivatives, failures and mistakes."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree
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
def arm():
    return osik.load_robot("arm7")


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


class TestRollout:
    @pytest.mark.variants(release=["hierarchical", "weighted"])
    @all_schemes
    def test_equals_a_python_loop(self, arm, home, tasks, limits, name):
        """Every number of the solution but the warm start, with a target that moves."""
        p, R = paths(home)
        run = osik.rollout(
            arm, arm.q0, tasks, scheme=SCHEMES[name], limits=limits, dt=DT, steps=STEPS, targets={"hand": (p, R)}
        )
        q, solution = loop(
            arm,
            arm.q0,
            lambda k: {**tasks, "hand": tasks["hand"].replace(target=(p[k], R[k]))},
            SCHEMES[name],
            limits,
        )
        np.testing.assert_allclose(run.time, DT * np.arange(STEPS), rtol=0, atol=1e-15)
        np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-12)
        assert_same(run.solution, solution, 1e-10)
        np.testing.assert_array_equal(run.solution.status, osik.Status.SOLVED)
        assert np.abs(q[-1] - q[0]).max() > 0.05

    @pytest.mark.slow
    def test_functions_of_time_for_tasks_and_feedback(self, arm, home, tasks, limits):
        """Feedback: the configuration that the last step led to comes back changed."""
        p, R = paths(home)

        def at(t):
            k = jnp.round(t / DT).astype(int)
            return {**tasks, "hand": tasks["hand"].replace(target=(jnp.asarray(p)[k], jnp.asarray(R)[k]))}

        options = {"scheme": SCHEMES["weighted"], "limits": limits, "dt": DT, "steps": STEPS}
        run = osik.rollout(arm, arm.q0, at, **options, feedback=lambda t, q: 0.9 * q + 0.01 * t)
        q, solution = loop(
            arm,
            arm.q0,
            lambda k: {**tasks, "hand": tasks["hand"].replace(target=(p[k], R[k]))},
            SCHEMES["weighted"],
            limits,
            measured=lambda k, q: 0.9 * q + 0.01 * DT * k,
        )
        np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-12)
        assert_same(run.solution, solution, 1e-10)

    def test_a_module_for_tasks_and_an_array_for_feedback(self, arm, home, tasks, limits, rng):
        p, R = paths(home)
        measured = np.asarray(arm.q0) + 0.05 * rng.normal(size=(STEPS, arm.nq))
        options = {"scheme": SCHEMES["weighted"], "limits": limits, "dt": DT, "steps": STEPS}
        run = osik.rollout(
            arm, arm.q0, Wave(tasks, jnp.asarray(home[0]), jnp.asarray(home[1]), 0.2), **options, feedback=measured
        )
        q, solution = loop(
            arm,
            arm.q0,
            lambda k: {**tasks, "hand": tasks["hand"].replace(target=(p[k], R[k]))},
            SCHEMES["weighted"],
            limits,
            measured=lambda k, q: measured[k],
        )
        np.testing.assert_allclose(run.q, q, rtol=0, atol=1e-12)
        assert_same(run.solution, solution, 1e-10)

    def test_a_start_of_integers_and_of_less_precision(self, arm, tasks, limits):
        q0 = np.array([0, -1, 0, -2, 0, 2, 1])
        options = {"scheme": SCHEMES["weighted"], "limits": limits, "dt": DT, "steps": STEPS}
        options["targets"] = {"hand": same(tasks)}
        starts: tuple[Any, ...] = (q0.astype(float), q0, q0.astype(np.float32), q0.tolist())
        runs = [osik.rollout(arm, q, tasks, **options) for q in starts]
        for run in runs[1:]:
            np.testing.assert_array_equal(run.q, runs[0].q)

    @pytest.mark.variants(slow=["hierarchical"])
    @all_schemes
    def test_a_joint_far_outside_its_range_comes_back(self, arm, tasks, limits, name):
        """At full speed where the box is hard; the null space has none."""
        q0 = arm.configuration({"joint2": float(arm.position_upper[1]) + 0.05})
        run = osik.rollout(
            arm, q0, tasks, scheme=SCHEMES[name], limits=limits, dt=DT, steps=STEPS, targets={"hand": same(tasks)}
        )
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


class Wave(eqx.Module):
    """The path of ``paths`` as a function of time with numbers of its own."""

    tasks: dict[str, osik.Task]
    start: jax.Array
    rotation: jax.Array
    speed: float

    def __call__(self, t):
        p = self.start + jnp.stack([self.speed * t, 0.1 * jnp.sin(8.0 * t), -0.1 * t])
        c, s, zero, one = jnp.cos(t), jnp.sin(t), 0.0 * t, 1.0 + 0.0 * t
        R = jnp.stack([jnp.stack([c, -s, zero]), jnp.stack([s, c, zero]), jnp.stack([zero, zero, one])]) @ self.rotation
        return {**self.tasks, "hand": self.tasks["hand"].replace(target=(p, R))}


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
        spoiled = {
            "q": (robot, q.at[4, 2].set(jnp.nan), tasks, scheme, limits, dt),
            "target": (robot, q, eqx.tree_at(target_of_hand, tasks, replace_fn=nan_in_lane_4), scheme, limits, dt),
            "infinite gain": (robot, q, eqx.tree_at(gain_of_hand, tasks, replace_fn=inf_in_lane_4), scheme, limits, dt),
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

    @pytest.mark.release
    def test_rollouts_in_a_batch(self, arm, tasks, limits, rng):
        """vmap of the whole loop over starts and targets."""
        starts = np.asarray(arm.q0) + 0.2 * rng.normal(size=(3, arm.nq))
        places = np.asarray(tasks["hand"].target[0]) + 0.1 * rng.normal(size=(3, 3))

        def run(q0, p):
            path = (jnp.tile(p, (STEPS, 1)), same(tasks)[1])
            options = {"scheme": SCHEMES["weighted"], "limits": limits, "dt": DT, "steps": STEPS}
            return osik.rollout(arm, q0, tasks, **options, targets={"hand": path})

        together = jax.jit(jax.vmap(run))(starts, places)
        for k in range(3):
            np.testing.assert_allclose(together.q[k], run(starts[k], places[k]).q, rtol=0, atol=1e-9)


def target_of_hand(tasks):
    return tasks["hand"].target[0]


def gain_of_hand(tasks):
    return tasks["hand"].gain


def nan_in_lane_4(leaf):
    return leaf.at[4].set(jnp.nan)


def inf_in_lane_4(leaf):
    return leaf.at[4].set(jnp.inf)


class TestDerivatives:
    """Against central differences, away from where the active set changes."""

    @staticmethod
    def cost(arm, home, limits, name):
        """Of the target, gain, weight and configuration of a step with bounds active, along one direction."""
        p, R = home
        scheme = osik.WeightedQP(damping=1e-2) if name == "weighted" else osik.NullSpace(damping=1e-2)
        hand = osik.FrameTask(arm, "hand", rows="position", target=(p, R))
        elbow = osik.FrameTask(arm, "link4", rows="position", upper=[np.inf, -0.002, np.inf], priority=2)
        posture = osik.PostureTask(arm, priority=3, weight=1.0)

        def f(x):
            tasks = {
                "hand": hand.replace(target=(x["target"], R), gain=x["gain"], weight=x["weight"]),
                "elbow": elbow,
                "posture": posture.replace(weight=0.1 * x["weight"] ** 2, gain=0.5 * x["gain"]),
            }
            v = osik.solve(arm, x["q"], tasks, scheme=scheme, limits=limits, dt=DT).velocity
            return jnp.sum(jnp.sin(v + jnp.arange(arm.nv)))

        x = {
            "target": jnp.asarray(p) + jnp.array([0.1, 0.2, -0.1]),
            "gain": jnp.asarray(8.0),
            "weight": jnp.asarray(2.0),
            "q": arm.q0 + 0.1 * jnp.linspace(-1.0, 1.0, 7),
        }
        return f, x

    @pytest.mark.slow
    @pytest.mark.variants(release=["null-space", "weighted"])
    @pytest.mark.parametrize("name", ["weighted", "null-space"])
    def test_one_step_in_both_modes(self, arm, home, limits, name):
        f, x = self.cost(arm, home, limits, name)
        flat, restore = ravel_pytree(x)
        run = jax.jit(jax.value_and_grad(lambda flat: f(restore(flat))))
        pushed = jax.jit(lambda direction: jax.jvp(f, (x,), (restore(direction),))[1])
        reverse, h = np.asarray(run(flat)[1]), 1e-6
        for k, unit in enumerate(np.eye(len(flat))):
            expected = float(run(flat + h * unit)[0] - run(flat - h * unit)[0]) / (2.0 * h)
            scale = max(1.0, abs(expected))
            assert float(reverse[k]) == pytest.approx(expected, abs=1e-6 * scale), k
            assert float(pushed(unit)) == pytest.approx(float(reverse[k]), abs=1e-9 * scale), k
        assert (np.abs(reverse) > 1e-4).sum() >= 10

    @pytest.mark.release
    def test_through_a_rollout(self, arm, home, limits):
        """Reverse mode through the scan: a cost of the whole path with respect to a gain and a weight."""
        p, R = home
        hand = osik.FrameTask(arm, "hand", rows="position", target=(p + np.array([0.1, 0.2, -0.1]), R))
        posture = osik.PostureTask(arm, target=np.asarray(arm.q0) + 0.5, weight=1.0)

        def f(x):
            tasks = {"hand": hand.replace(gain=x[0]), "posture": posture.replace(weight=x[1])}
            path = osik.rollout(arm, arm.q0, tasks, scheme=osik.WeightedQP(), limits=limits, dt=DT, steps=STEPS)
            return jnp.sum(path.solution.error["hand"] ** 2) + 1e-2 * jnp.sum(path.solution.velocity**2)

        run, x, h = jax.jit(jax.value_and_grad(f)), np.array([9.0, 0.02]), np.array([1e-5, 1e-7])
        gradient = run(x)[1]
        for k in range(2):
            step = h[k] * np.eye(2)[k]
            expected = float(run(x + step)[0] - run(x - step)[0]) / (2.0 * h[k])
            assert float(gradient[k]) == pytest.approx(expected, rel=1e-5)


class TestStatus:
    def test_raise_if_failed_names_the_lanes(self, arm, home):
        robot, q, tasks, scheme, limits, dt = stack([lane(arm, home, change, "weighted") for change in CHANGES])
        raise_if_failed(batch(robot, q, tasks, scheme, limits, dt))
        bad = batch(robot, q.at[4, 2].set(jnp.nan), tasks, scheme, limits, dt)
        with pytest.raises(RuntimeError, match=r"NUMERICAL_ERROR in 1 of 11 lanes \(\(4,\)\): .*NaN"):
            raise_if_failed(bad)

    def test_a_cap_on_iterations_is_said_and_the_box_still_holds(self, arm):
        """Speeds that bind need changes of the active set."""
        tasks = {"posture": osik.PostureTask(arm, target=np.asarray(arm.q0) + 0.3, weight=1.0)}
        limits = (osik.VelocityLimit(arm, velocity={"*": 0.1}),)
        for scheme in (osik.WeightedQP(max_iterations=1), osik.HierarchicalQP(max_iterations=1)):
            solution = osik.solve(arm, arm.q0, tasks, scheme=scheme, limits=limits)
            assert int(solution.status) == osik.Status.MAX_ITERATIONS
            assert np.abs(solution.velocity).max() <= 0.1
            assert float(solution.box_violation) == 0.0
            with pytest.raises(RuntimeError, match=r"MAX_ITERATIONS in 1 of 1 lanes.*raise max_iterations"):
                raise_if_failed(solution)


class TestMistakes:
    """What a user gets wrong is named, with what exists."""

    @staticmethod
    def run(arm, tasks, **changes):
        arguments = {"robot": arm, "q0": arm.q0, "tasks": tasks, "scheme": SCHEMES["weighted"], "steps": 3, **changes}
        return osik.rollout(arguments.pop("robot"), arguments.pop("q0"), arguments.pop("tasks"), **arguments)

    @staticmethod
    def solved(arm, tasks, **changes):
        arguments = {"q": arm.q0, "tasks": tasks, "scheme": SCHEMES["weighted"], **changes}
        return osik.solve(arm, arguments.pop("q"), arguments.pop("tasks"), **arguments)

    def test_configurations(self, arm, tasks):
        nao = osik.load_robot("nao")
        for call, key in ((self.solved, "q"), (self.run, "q0")):
            with pytest.raises(ValueError, match=r"shape \(3,\).*\(7,\): joint1, joint2"):
                call(arm, tasks, **{key: np.zeros(3)})
            with pytest.raises(ValueError, match=r"vmap"):
                call(arm, tasks, **{key: np.zeros((2, 7))})
            with pytest.raises(ValueError, match=r"not finite at indices \[2\]"):
                call(arm, tasks, **{key: np.where(np.arange(7) == 2, np.nan, 0.0)})
        zeros = np.array(nao.q0)
        zeros[3:7] = 0.0
        with pytest.raises(ValueError, match=r"q\[3:7\], the quaternion of joint .*is zero"):
            osik.solve(
                nao,
                jnp.asarray(zeros),
                {"posture": osik.PostureTask(nao, weight=1.0)},
                scheme=SCHEMES["weighted"],
                limits=osik.no_limits,
            )

    def test_tasks(self, arm, tasks):
        for call in (self.solved, self.run):
            with pytest.raises(ValueError, match="no task"):
                call(arm, {})
            with pytest.raises(TypeError, match="tasks is a list; it is a dict"):
                call(arm, list(tasks.values()))
            with pytest.raises(TypeError, match=r"tasks\['hand'\] is a str, not a Task"):
                call(arm, {"hand": "hand"})
        with pytest.raises(ValueError, match="no task"):
            self.run(arm, lambda t: {})

    def test_schemes_limits_and_times(self, arm, tasks, limits):
        for call in (self.solved, self.run):
            with pytest.raises(TypeError, match=r"scheme is <class .*WeightedQP\(\)"):
                call(arm, tasks, scheme=osik.WeightedQP)
            with pytest.raises(TypeError, match=r"limits is ConfigurationLimit.*sequence"):
                call(arm, tasks, limits=limits[0])
            with pytest.raises(TypeError, match=r"limits.* is .*VelocityLimit"):
                call(arm, tasks, limits=(osik.VelocityLimit,))
            for dt in (0.0, -0.01, np.nan, np.inf):
                with pytest.raises(ValueError, match=r"dt is .*positive"):
                    call(arm, tasks, dt=dt)
        for steps in (-1, 2.5, True):
            with pytest.raises(ValueError, match="steps is"):
                self.run(arm, tasks, steps=steps)

    def test_targets_and_feedback(self, arm, tasks):
        with pytest.raises(KeyError, match="targets are for 'foot', which is no task; tasks: hand, elbow, posture"):
            self.run(arm, tasks, targets={"foot": np.zeros((3, 7))})
        with pytest.raises(ValueError, match=r"targets\['posture'\] has shape \(2, 7\).*steps, 3"):
            self.run(arm, tasks, targets={"posture": np.zeros((2, 7))})
        with pytest.raises(ValueError, match=r"target has shape \(5,\), expected \(7,\)"):
            self.run(arm, tasks, targets={"posture": np.zeros((3, 5))})
        with pytest.raises(ValueError, match="targets go with a dict"):
            self.run(arm, lambda t: tasks, targets={"posture": np.zeros((3, 7))})
        with pytest.raises(ValueError, match=r"feedback has shape \(3, 6\).*\(3, 7\)"):
            self.run(arm, tasks, feedback=np.zeros((3, 6)))
        with pytest.raises(ValueError, match=r"q has shape \(2,\)"):
            self.run(arm, tasks, feedback=lambda t, q: q[:2])

    def test_numbers_of_the_schemes(self):
        with pytest.raises(ValueError, match=r"damping is -1.0"):
            osik.NullSpace(damping=-1.0)
        with pytest.raises(ValueError, match=r"damping is 0.0; a WeightedQP needs it positive"):
            osik.WeightedQP(damping=0.0)
        with pytest.raises(ValueError, match="potential_gain is nan"):
            osik.NullSpace(potential_gain=np.nan)
        with pytest.raises(ValueError, match=r"margin has shape \(2,\), expected a scalar"):
            osik.NullSpace(margin=np.zeros(2))

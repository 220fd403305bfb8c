"""Tuning: names and spaces, losses against NumPy and MuJoCo, and the loop around them, on what compiles quickly."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_files import mjcf
from refusals import refuses

import osik_jax as osik
from osik_jax import tuning
from osik_jax.robot._mujoco import mujoco_poses, robot_com
from osik_jax.schemes import SchemeAnswer
from osik_jax.solvers import Status
from osik_jax.tuning._history import History
from osik_jax.tuning._parameters import ParameterSpace

DT, STEPS = 0.05, 6


class LeastSquares(osik.Scheme):
    """All tasks by damped least squares, clipped to the box."""

    damping: jax.Array = eqx.field(default=1e-3, converter=jnp.asarray)

    def solve(self, problem, warm_start=None):
        level = problem.level(list(problem.rows)).scaled()
        fine = jnp.isfinite(level.matrix).all()
        A = jnp.where(fine, level.matrix, 1.0)
        v = jnp.linalg.solve(A.T @ A + self.damping * jnp.eye(A.shape[1]), A.T @ level.lower)
        status = jnp.where(fine, Status.SOLVED, Status.NUMERICAL_ERROR)
        one = jnp.asarray(1)
        return SchemeAnswer(jnp.clip(v, problem.lower, problem.upper), status, one, one, jnp.zeros(()))


TRACES = []


def _traced(trajectory, loop):
    """Nothing, noted while tracing."""
    TRACES.append(loop)
    return jnp.zeros(())


LOSS = tuning.Tracking("hand") + 1e-4 * tuning.Smoothness() + _traced
NAMES = ["hand.gain", "posture.weight", "posture.gain", "elbow.weight"]


@pytest.fixture(scope="module")
def small():
    robot = osik.Robot.from_mjcf(mjcf("two_links"))
    return eqx.tree_at(lambda r: r.q0, robot, jnp.array([0.3, 0.9]))


@pytest.fixture(scope="module")
def loop(small):
    tasks = {
        "hand": osik.FrameTask(small, "hand", rows="position", gain=osik.AdaptiveGain(6.0, 2.0, 3.0)),
        "elbow": osik.FrameTask(small, "lower", rows="position", gain=3.0, weight=0.1, priority=2),
        "posture": osik.PostureTask(small, weight=0.1, gain=1.0, priority=2),
    }
    limits = osik.ConfigurationLimit(small), osik.VelocityLimit(small, velocity={"*": 20.0})
    return tuning.Loop(small, tasks, scheme=LeastSquares(), limits=limits, dt=DT, steps=STEPS)


def make_scenarios(robot, count, seed=0):
    random = np.random.default_rng(seed)
    home = np.asarray(osik.FrameTask(robot, "hand").target[0])
    return tuning.Scenarios(
        q0=np.asarray(robot.q0) + 0.3 * random.normal(size=(count, robot.nq)),
        values={"hand.target[0]": home + 0.1 * random.normal(size=(count, 3))},
    )


@pytest.fixture(scope="module")
def scenarios(small):
    return make_scenarios(small, 4)


def run(loop, scenarios, **options):
    return tuning.tune(LOSS, NAMES, scenarios, loop=loop, **{"iterations": 3, "progress": False, **options})


class TestNames:
    def test_of_all_parts_of_the_loop(self, loop):
        wanted = "hand.gain.maximum", "hand.target[1]", "scheme.damping", "limits[1].velocity", "robot.body_mass", "dt"
        assert set(wanted) <= set(loop.names) and "tasks.hand.weight" not in loop.names

    def test_replace(self, loop):
        other: Any = loop.replace({"*.gain": 7.0, "limits[1].velocity": 2.0, "dt": 0.1})
        assert float(other.tasks["hand"].gain.decay) == float(other.tasks["posture"].gain) == 7.0
        assert (np.asarray(other.limits[1].velocity) == 2.0).all() and float(other.dt) == 0.1
        assert float(loop.dt) == DT
        with pytest.raises(KeyError, match="no number 'hand.wait'; did you mean 'hand.weight'.*scheme.damping"):
            loop.replace({"hand.wait": 1.0})

    def test_a_task_named_like_a_part(self, arm):
        tasks = {"scheme": osik.PostureTask(arm)}
        refuses(ValueError, "a task cannot be called 'scheme'", tuning.Loop, arm, tasks, steps=1)
        refuses(TypeError, "tasks is a PostureTask; it is a dict", tuning.Loop, arm, tasks["scheme"], steps=1)
        refuses(ValueError, "steps is -1", tuning.Loop, arm, {"posture": tasks["scheme"]}, steps=-1)


BOUNDS = [
    tuning.Parameter("posture.weight"),
    tuning.Parameter("hand.gain.maximum", lower=1.0, upper=20.0),
    tuning.Parameter("hand.gain.minimum", upper=10.0),
    tuning.Parameter("hand.gain.decay", lower=0.1),
    tuning.Parameter("hand.target[0]"),
    tuning.Parameter("elbow.target[0]", lower=-2.0, upper=2.0),
    tuning.Parameter("robot.body_com", lower=-10.0),
    tuning.Parameter("posture.target_velocity", upper=5.0),
]


class TestParameterSpace:
    def test_begins_at_the_loops_numbers(self, loop):
        space = ParameterSpace(loop, BOUNDS)
        started = eqx.filter_jit(space.apply)(loop, space.initial)
        for a, b in zip(jax.tree.leaves(started), jax.tree.leaves(loop), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-12)

    @settings(max_examples=20, deadline=None)
    @given(seed=st.integers(0, 2**31), size=st.sampled_from([0.1, 1.0, 10.0]))
    def test_stays_between_the_bounds_and_comes_back(self, loop, seed, size):
        space = ParameterSpace(loop, BOUNDS)
        vector = space.initial + size * np.random.default_rng(seed).normal(size=len(space.names))
        values = np.asarray(space.numbers(vector))
        lower, upper = (np.where(space.log, np.exp(b), b) for b in (space.lower, space.upper))
        assert (values >= lower).all() and (values <= upper).all() and (values[np.asarray(space.log)] > 0.0).all()
        inside = (values > lower * (1 + 1e-6)) & (values < upper * (1 - 1e-6)) | ~np.isfinite(lower - upper)
        back = np.asarray(space.vector(jnp.asarray(values)))
        near = np.abs(vector - np.asarray(space.initial)) < 1.0
        np.testing.assert_allclose(back[inside & near], np.asarray(vector)[inside & near], atol=1e-6)

    def test_gradients_are_finite_far_away(self, loop):
        space = ParameterSpace(loop, BOUNDS)
        slope = jax.jit(jax.jacobian(space.numbers))
        for far in (-300.0, 300.0):
            assert np.isfinite(slope(jnp.full(len(space.names), far))).all()

    def test_a_step_in_log_space_is_a_factor(self, loop):
        space = ParameterSpace(loop, ["posture.weight", tuning.Parameter("elbow.gain", lower=1.0, upper=9.0)])
        step = jax.jit(jax.jacobian(lambda z: jnp.log(space.numbers(z))))(space.initial)
        np.testing.assert_allclose(step, np.eye(2), atol=1e-12)  # 3 is in the middle of 1 and 9

    def test_every_finite_entry_is_a_parameter(self, arm, nao):
        hand = osik.FrameTask(nao, "l_gripper", position_weight=[1.0, 2.0, 3.0])
        limits = (osik.VelocityLimit(nao),)
        loop = tuning.Loop(nao, {"hand": hand}, scheme=osik.NullSpace(), limits=limits, dt=0.01, steps=1)
        space = ParameterSpace(loop, ["hand.position_weight", "limits[0].velocity"])
        assert space.names[:3] == tuple(f"hand.position_weight[{i}]" for i in range(3))
        assert len(space.names) == 3 + nao.nv - 6 and "limits[0].velocity[5]" not in space.names
        moved: Any = eqx.filter_jit(space.apply)(loop, space.initial + 1.0)
        assert np.isinf(moved.limits[0].velocity[:6]).all()
        assert space.by_name(space.initial)["hand.position_weight[1]"] == pytest.approx(2.0)

    @pytest.mark.parametrize(
        "parameters, error, message",
        [
            (["hand.wait"], KeyError, "no number 'hand.wait'; did you mean 'hand.weight'"),
            ("hand.weight", TypeError, "use \\['hand.weight'\\]"),
            ([3], TypeError, "a name or a Parameter, got 3"),
            ([], ValueError, "no finite number to tune"),
            (["*.weight", "hand"], ValueError, "hand.weight is tuned twice"),
            ([tuning.Parameter("hand.weight", lower=2.0, upper=1.0)], ValueError, "2.0 is not below the upper bound 1"),
            (
                [tuning.Parameter("hand.weight", lower=2.0)],
                ValueError,
                "begins at 1.0, which is not between its bounds",
            ),
            ([tuning.Parameter("posture.target_velocity", log=True)], ValueError, "in log space it begins at a"),
        ],
    )
    def test_mistakes(self, loop, parameters, error, message):
        refuses(error, message, ParameterSpace, loop, parameters)


class TestScenarios:
    def test_parts(self, scenarios):
        assert len(scenarios[1:]) == 3 and len(scenarios[np.array([True, False, True, False])]) == 2
        with pytest.raises(TypeError, match="use \\[1 : 2\\]"):
            scenarios[1]

    @pytest.mark.parametrize(
        "given, error, message",
        [
            (dict(), ValueError, "nothing is given"),
            (dict(q0=np.zeros((3, 2)), values={"dt": np.ones(2)}), ValueError, "lengths: 2, 3"),
            (dict(q0=np.zeros((3, 6))), ValueError, "expected \\(n, 2\\)"),
            (dict(values={"hand.traget": np.zeros((3, 3))}), KeyError, "did you mean 'hand.target"),
            (dict(values={"hand.target[0]": np.zeros((3, 2))}), ValueError, "expected \\(3,\\) with an axis in front"),
            (dict(targets={"hnd": np.zeros((3, STEPS, 3))}), KeyError, "'hnd', which is no task"),
            (dict(targets={"posture": np.zeros((3, 5, 2))}), ValueError, "one target a step"),
            (dict(values={"hand.gain": np.ones(3)}), ValueError, "hand.gain.maximum is a parameter"),
        ],
    )
    def test_mistakes(self, loop, given, error, message):
        refuses(error, message, lambda: run(loop, tuning.Scenarios(**given)))


def path(arm, rng, steps=5):
    """A trajectory of random numbers, with errors of three tasks."""
    q = np.asarray(arm.q0) + 0.5 * rng.normal(size=(steps + 1, 7))
    tasks = {"p": osik.PostureTask(arm, weight=1.0)}
    solution = osik.solve(arm, arm.q0, tasks, scheme=osik.NullSpace(), limits=osik.no_limits)
    error = {"hand": rng.normal(size=(steps, 3)), "com": rng.normal(size=(steps, 2)), "posture": np.zeros((steps, 7))}
    solution = eqx.tree_at(lambda s: (s.velocity, s.error), solution, (rng.normal(size=(steps, 7)), error))
    return osik.Trajectory(DT * jnp.arange(steps), jnp.asarray(q), jax.tree.map(jnp.asarray, solution))


@pytest.fixture(scope="module")
def judged(arm):
    tasks = {
        "hand": osik.FrameTask(arm, "hand", rows="position"),
        "com": osik.ComTask(arm, lower=[-0.2, -np.inf], upper=[0.3, 0.1], axes="xy"),
        "posture": osik.PostureTask(arm, weight=1.0),
    }
    loop = tuning.Loop(arm, tasks, scheme=osik.WeightedQP(), dt=DT, steps=5, limits=osik.no_limits)
    return path(arm, np.random.default_rng(3)), loop


class TestLosses:
    def test_tracking(self, judged):
        trajectory, _ = judged
        error = {name: np.asarray(value) for name, value in trajectory.solution.error.items()}
        x = error["com"]
        outside = np.maximum([-0.2, -np.inf] - x, 0.0) + np.maximum(x - [0.3, 0.1], 0.0)
        hand, com = (error["hand"] ** 2).sum(1), (outside**2).sum(1)
        assert float(tuning.Tracking("hand")(*judged)) == pytest.approx(hand.mean())
        assert float(tuning.Tracking("hand", "com")(*judged)) == pytest.approx((hand + com).mean())
        assert float(tuning.Tracking(after=2 * DT)(*judged)) == pytest.approx((hand + com)[2:].mean())
        refuses(KeyError, "no task 'hnd'; did you mean 'hand'", tuning.Tracking("hnd"), *judged)

    def test_tracking_with_tasks_that_are_functions_of_time(self, arm, judged):
        def tasks(t):
            return {"com": osik.ComTask(arm, lower=-0.2, upper=t, axes="xy")}

        trajectory, _ = judged
        trajectory = eqx.tree_at(lambda t: t.solution.error, trajectory, {"com": trajectory.solution.error["com"]})
        loop = tuning.Loop(arm, tasks, scheme=osik.WeightedQP(), dt=DT, steps=5, limits=osik.no_limits)
        x, upper = np.asarray(trajectory.solution.error["com"]), np.asarray(trajectory.time)[:, None]
        outside = np.maximum(-0.2 - x, 0.0) + np.maximum(x - upper, 0.0)
        assert float(tuning.Tracking()(trajectory, loop)) == pytest.approx((outside**2).sum(1).mean())

    def test_smoothness_and_effort(self, judged):
        v = np.asarray(judged[0].solution.velocity)
        from_rest = np.diff(v, axis=0, prepend=np.zeros((1, 7))) / DT
        assert float(tuning.Smoothness()(*judged)) == pytest.approx((from_rest**2).sum(1).mean())
        assert float(tuning.Smoothness(from_rest=False)(*judged)) == pytest.approx((from_rest[1:] ** 2).sum(1).mean())
        assert float(tuning.Effort()(*judged)) == pytest.approx((v**2).sum(1).mean())

    def test_joint_limit_distance(self, arm, judged):
        low, high, q = (np.asarray(x) for x in (arm.position_lower, arm.position_upper, judged[0].q[1:]))
        near = np.minimum(q - low, high - q) / (high - low)
        depth = np.clip(0.4 - near, 0.0, None) / 0.4
        assert depth.any()
        assert float(tuning.JointLimitDistance(margin=0.4)(*judged)) == pytest.approx((depth**2).sum(1).mean())

    def test_com_margin(self, arm, judged):
        corners = {"link0": [[x, y, 0.0] for x in (-0.1, 0.15) for y in (-0.2, 0.2)]}
        polygon = osik.support_polygon(arm, arm.q0, ("link0",), corners=corners)
        points = np.array([robot_com(arm, data)[:2] for data in mujoco_poses(arm, judged[0].q[1:])])
        inside = np.min(np.concatenate([points - [-0.1, -0.2], [0.15, 0.2] - points], 1), 1)
        depth = np.maximum(0.05 - inside, 0.0)
        assert depth.any() and not depth.all()
        assert float(tuning.ComMargin(polygon, margin=0.05)(*judged)) == pytest.approx((depth**2).mean())

    def test_sums_of_ready_ones_and_others(self, judged):
        total = 2.0 * (tuning.Effort() + (lambda trajectory, loop: jnp.sum(trajectory.q[0]))) + tuning.Smoothness()
        expected = 2.0 * (tuning.Effort()(*judged) + jnp.sum(judged[0].q[0])) + tuning.Smoothness()(*judged)
        assert float(total(*judged)) == pytest.approx(float(expected))
        both = tuning.Effort(), tuning.Smoothness()
        assert float(sum(both)(*judged)) == pytest.approx(float((both[0] + both[1])(*judged)))  # pyright: ignore
        refuses(TypeError, "unsupported operand", lambda: both[0] + 1.0)  # pyright: ignore[reportOperatorIssue]

    @pytest.mark.parametrize("loss", [3.0, lambda trajectory: 0.0])
    def test_what_is_no_loss(self, loop, scenarios, loss):
        refuses(TypeError, "the loss .* trajectory", tuning.evaluate, loss, loop, scenarios)


class TestTune:
    @pytest.mark.slow
    def test_reports_what_it_returns(self, loop, scenarios):
        tuned = run(loop, scenarios[:3], held_out=scenarios[3:], iterations=6)
        history = tuned.history
        assert len(history) == 6
        assert tuned.loss == history.loss.min() < history.loss[0]
        assert tuned.held_out == history.held_out[tuned.iteration]
        assert tuned.loss == pytest.approx(float(tuning.evaluate(LOSS, tuned.loop, scenarios[:3]).loss), rel=1e-9)
        assert tuned.held_out == pytest.approx(float(tuning.evaluate(LOSS, tuned.loop, scenarios[3:]).loss), rel=1e-9)
        best: Any = tuned.loop
        assert tuned.parameters["hand.gain.decay"] == pytest.approx(float(best.tasks["hand"].gain.decay))
        assert float(best.tasks["hand"].weight) == 1.0

    @pytest.mark.slow
    def test_the_step_is_the_gradient(self, loop, scenarios):
        """Plain descent with rate 1, against central differences of the loss."""
        tuned = run(loop, scenarios, optimizer=optax.sgd(1.0), iterations=2)
        start, space = tuned.space.initial, tuned.space
        gradient = np.subtract(*tuned.history.vectors)
        assert np.linalg.norm(gradient) == pytest.approx(tuned.history.gradient_norm[0])
        for direction in np.random.default_rng(1).normal(size=(4, len(gradient))):
            ends = [tuning.evaluate(LOSS, space.apply(loop, start + h * direction), scenarios) for h in (1e-5, -1e-5)]
            assert gradient @ direction == pytest.approx(float(ends[0].loss - ends[1].loss) / 2e-5, rel=1e-5)

    @pytest.mark.release
    def test_chunks_change_nothing(self, loop, scenarios):
        whole, parts = run(loop, scenarios), run(loop, scenarios, chunk=3)
        np.testing.assert_allclose(parts.history.loss, whole.history.loss, rtol=1e-12)
        np.testing.assert_allclose(parts.history.gradient_norm, whole.history.gradient_norm, rtol=1e-9)
        refuses(ValueError, "chunk is 0", run, loop, scenarios, chunk=0)

    @pytest.mark.release
    def test_a_nan_scenario_is_dropped(self, loop, scenarios):
        """Starts, targets, and a gradient that is not finite: as if those scenarios were not there."""
        steep = tuning.Tracking("hand") + _steep
        q0, place = np.array(scenarios.q0), np.array(scenarios.values["hand.target[0]"])
        weight = np.array([1.0, 1.0, 1.0, 0.0])
        q0[0, 1], place[1, 0] = np.nan, np.nan
        spoiled = tuning.Scenarios(q0=q0, values={"hand.target[0]": place, "hand.position_weight": weight})
        options: dict[str, Any] = dict(loop=loop, iterations=3, progress=False)
        got = tuning.tune(steep, NAMES, spoiled, held_out=spoiled[:2], **options)
        clean = tuning.tune(steep, NAMES, spoiled[np.full(4, 2)], held_out=spoiled[:2], **options)
        assert got.history.dropped.tolist() == [3, 3, 3] and got.history.held_out_dropped.tolist() == [2, 2, 2]
        np.testing.assert_allclose(got.history.loss, clean.history.loss, rtol=1e-12)
        np.testing.assert_allclose(got.history.vectors, clean.history.vectors, rtol=1e-9)
        with pytest.raises(ValueError, match="no training scenario can be kept in iteration 0"):
            tuning.tune(steep, NAMES, spoiled[np.array([0, 1, 0, 1])], held_out=spoiled[:2], **options)

    def test_fewer_scenarios_are_not_better(self):
        rows = dict(held_out=np.nan, held_out_dropped=0, gradient_norm=1.0, seconds=0.0, vectors=np.zeros(2))
        history = History.empty(2)
        for loss, dropped in ((3.0, 0), (1.0, 2), (2.0, 0), (np.nan, 4), (2.0, 0)):
            history = history.and_then(loss=loss, dropped=dropped, **rows)
        assert history.best == 2

    def test_goes_on_where_it_was(self, loop, scenarios, tmp_path):
        whole = run(loop, scenarios, iterations=6)
        file = tmp_path / "state.npz"
        run(loop, scenarios, iterations=3, save=file)
        rest = run(loop, scenarios, iterations=6, resume=file)
        np.testing.assert_array_equal(rest.history.vectors, whole.history.vectors)
        np.testing.assert_array_equal(rest.history.loss, whole.history.loss)
        assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]

    def test_refuses_another_state(self, loop, scenarios, tmp_path):
        file = tmp_path / "state.npz"
        run(loop, scenarios, iterations=1, save=file)
        refuses(ValueError, "another optimizer", run, loop, scenarios, resume=file, optimizer=optax.sgd(0.1))
        with pytest.raises(ValueError, match="the parameters are not those"):
            tuning.tune(LOSS, ["hand.weight"], scenarios, loop=loop, resume=file, progress=False)
        other = [tuning.Parameter(name, log=False) for name in NAMES]  # of the same names, which mean other numbers
        with pytest.raises(ValueError, match="the parameters are not those saved.*: log "):
            tuning.tune(LOSS, other, scenarios, loop=loop, resume=file, progress=False)
        with pytest.raises(FileNotFoundError):
            run(loop, scenarios, resume=tmp_path / "no.npz")

    @pytest.mark.release
    def test_a_line_search(self, loop, scenarios):
        """An optimiser that asks for values along the way."""
        search = optax.chain(optax.sgd(1.0), optax.scale_by_backtracking_linesearch(max_backtracking_steps=5))
        tuned = run(loop, scenarios, optimizer=search, iterations=4)
        assert (np.diff(tuned.history.loss) < 0.0).all()
        refuses(TypeError, "it is an optax.GradientTransformation", run, loop, scenarios, optimizer="adam")
        refuses(ValueError, "iterations is '3'", run, loop, scenarios, iterations="3")

    def test_other_numbers_compile_nothing(self, loop, scenarios):
        run(loop, scenarios)
        count = len(TRACES)
        other = loop.replace({"posture.target": 0.1, "hand.weight": 3.0})
        run(other, make_scenarios(other.robot, 4, seed=1), iterations=1)
        assert count > 0 and len(TRACES) == count

    @pytest.mark.slow
    def test_robots_and_targets_that_move(self, small, loop):
        """Scenarios with masses, lengths and targets of their own: their loss is that of a loop over them."""
        robots = [small.scaled(length={"lower": s}) for s in (0.9, 1.2)]
        home, rotation = map(np.asarray, loop.tasks["hand"].target)
        places = home + 0.05 * np.random.default_rng(2).normal(size=(2, STEPS, 3))
        moving = {"hand": (places, np.tile(rotation, (2, STEPS, 1, 1)))}
        both = tuning.Scenarios(values={"robot": osik.stack(robots)}, targets=moving)
        got = tuning.evaluate(LOSS, loop, both)
        for i, robot in enumerate(robots):
            own = eqx.tree_at(lambda x: x.robot, loop, robot)
            motion = own.rollout(targets={"hand": tuple(leaf[i] for leaf in moving["hand"])})
            assert float(got.losses[i]) == pytest.approx(float(LOSS(motion, own)), rel=1e-9)
        assert got.losses[0] != got.losses[1] and int(got.dropped) == 0

    def test_tasks_that_are_a_module(self, small, scenarios):
        class Swing(eqx.Module):
            hand: osik.FrameTask
            speed: jax.Array

            def __call__(self, t):
                p, R = self.hand.target
                return {"hand": self.hand.replace(target=(p + 0.1 * jnp.sin(self.speed * t), R))}

        swing = Swing(osik.FrameTask(small, "hand", rows="position"), jnp.asarray(2.0))
        loop = tuning.Loop(small, swing, scheme=LeastSquares(), dt=DT, steps=STEPS, limits=osik.no_limits)
        start = tuning.Scenarios(q0=scenarios.q0)
        space = ParameterSpace(loop, ["hand.gain", "speed"])
        loops = [space.apply(loop, space.initial + i * step) for i in (0.0, 0.5) for step in np.eye(2)]
        losses = [tuning.evaluate(tuning.Tracking("hand"), own, start).loss for own in loops]
        assert losses[0] == losses[1] and losses[2] < losses[0] and losses[3] != losses[0]


def _steep(trajectory, loop):
    """Finite, with a slope that is not, at a weight of 0."""
    gain = loop.tasks["posture"].gain * loop.tasks["hand"].position_weight[0]
    return jnp.sqrt(gain) * 1e-3


@pytest.mark.slow
def test_progress_shows_the_loss(loop, scenarios, capsys):
    tuned = run(loop, scenarios[:3], held_out=scenarios[3:], progress=True)
    shown = capsys.readouterr().err
    assert f"loss {tuned.history.loss[-1]:.3e}" in shown and f"held out {tuned.history.held_out[-1]:.3e}" in shown


@pytest.mark.slow
def test_without_optax_it_says_what_to_install():
    code = "import sys; sys.modules['optax'] = None; import osik_jax; import osik_jax.tuning"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert 'pip install ".[tuning]"' in done.stderr

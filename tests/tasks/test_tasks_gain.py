"""Gains: numbers worked out by hand, and what a task makes of them."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import kinematics_at, rows_of_each

import osik_jax as osik


class TestGain:
    def test_equation_3_by_hand(self):
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        # ||(0.3, 0.4)|| = 0.5; 8 exp(-1.5) + 2 with exp(-1.5) = 0.22313016014842982
        np.testing.assert_allclose(gain(jnp.array([0.3, 0.4])), 3.7850412811874386, rtol=1e-15)
        np.testing.assert_allclose(gain(jnp.zeros(2)), 10.0, rtol=0)
        np.testing.assert_allclose(gain(jnp.full(2, 100.0)), 2.0, rtol=1e-15)
        np.testing.assert_array_equal(jax.grad(lambda e: gain(e))(jnp.zeros(2)), np.zeros(2))

    def test_in_a_task(self, arm):
        frame = "hand"
        p, R = kinematics_at(arm, arm.q0).frame_pose(arm, frame)
        target = (p - jnp.array([0.3, 0.4, 0.0]), R)
        gain = osik.AdaptiveGain(10.0, 2.0, 3.0)
        tasks = {
            "pose": osik.FrameTask(arm, frame, target=target, gain=gain),
            # rows of weight 0 do not count: the error that is left is (0.3, 0, 0), 8 exp(-0.9) + 2
            "x alone": osik.FrameTask(arm, frame, target=target, gain=gain, position_weight=[1, 0, 0]),
            # distance to the interval (0.3 - 0.25, 0.4 - 0.25), norm 0.15811388300841897
            "bounds": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.25),
            "inside": osik.FrameTask(arm, frame, target=target, gain=gain, rows="position", upper=0.5),
        }
        rows = rows_of_each(arm, tasks, arm.q0)
        np.testing.assert_allclose(rows["pose"].lower[:3], [-1.1355123843562316, -1.5140165124749755, 0.0], atol=1e-13)
        np.testing.assert_allclose(rows["x alone"].lower[0], -0.3 * 5.252557277924793, atol=1e-13)
        np.testing.assert_array_equal(rows["bounds"].lower, np.full(3, -np.inf))
        rate = 8.0 * math.exp(-3.0 * 0.15811388300841897) + 2.0
        np.testing.assert_allclose(rows["bounds"].upper, rate * np.array([-0.05, -0.15, 0.25]), atol=1e-13)
        np.testing.assert_allclose(rows["inside"].upper, 10.0 * np.array([0.2, 0.1, 0.5]), atol=1e-13)

    def test_a_gain_of_zero_keeps_infinite_bounds(self, arm):
        task = osik.PostureTask(arm, lower=-0.1, gain=0.0)
        rows = rows_of_each(arm, {"a": task}, arm.q0)["a"]
        np.testing.assert_array_equal(rows.upper, np.full(arm.nv, np.inf))
        np.testing.assert_array_equal(rows.lower, np.zeros(arm.nv))


class TestMistakes:
    def test_gain(self):
        refuses(ValueError, "maximum >= minimum", osik.AdaptiveGain, 1.0, 2.0, 1.0)
        refuses(ValueError, "decay is", osik.AdaptiveGain, 2.0, 1.0, -1.0)
        refuses(ValueError, "scalar", osik.AdaptiveGain, [2.0, 3.0], 1.0, 1.0)


DT = 0.1


@pytest.fixture(scope="module")
def goal(arm):
    position, rotation = osik.FrameTask(arm, "hand").target
    turn = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()
    return position + jnp.array([0.15, 0.1, -0.1]), rotation @ turn


def tasks_with(arm, goal, gain) -> dict[str, osik.Task]:
    near = np.asarray(arm.q0) + 0.3
    return {
        "pose": osik.FrameTask(arm, "hand", target=goal, gain=gain),
        "bounds": osik.FrameTask(arm, "link4", rows="position", lower=-0.1, upper=0.1, gain=gain),
        "balance": osik.ComTask(arm, target=jnp.zeros(3), gain=gain),
        "posture": osik.PostureTask(arm, target=near, gain=gain),
        "look": osik.LookAtTask(arm, "hand", target=jnp.array([1.0, 1.0, 0.0]), gain=gain),
        "couple": osik.JointCouplingTask(arm, {"joint1": 1.0, "joint2": -1.0}, target=0.5, gain=gain),
    }


@jax.jit
def rows_of_problem(arm, tasks):
    return osik.build_problem(arm, arm.q0, tasks, dt=DT).rows


class TestCappedByTheStep:
    """A gain of more than 1 / dt counts as 1 / dt: it overshot, and from 2 / dt on errors grew with status SOLVED."""

    @pytest.mark.variants(release=["10.5"])
    @pytest.mark.parametrize("many", [10.5, 1e6])
    def test_rows_of_every_kind_are_those_of_one_over_dt(self, arm, goal, many):
        expected = rows_of_problem(arm, tasks_with(arm, goal, 10.0))
        for name, own in rows_of_problem(arm, tasks_with(arm, goal, many)).items():
            for field in ("lower", "upper", "pull", "curvature"):
                np.testing.assert_allclose(
                    getattr(own, field), getattr(expected[name], field), rtol=1e-12, err_msg=name
                )

    def test_a_smaller_gain_stays_as_it_is(self, arm, goal):
        rows = rows_of_problem(arm, tasks_with(arm, goal, 9.0))
        np.testing.assert_allclose(rows["posture"].lower, -9.0 * rows["posture"].error)

    def test_an_adaptive_gain_is_capped_where_it_is_larger(self, arm):
        """Far away it is the smaller one and unchanged; near the target 1 / dt."""
        gain = osik.AdaptiveGain(maximum=50.0, minimum=2.0, decay=3.0)
        for offset in (0.01, 0.2, 1.0):
            task = osik.PostureTask(arm, target=np.asarray(arm.q0) + offset, gain=gain)
            rows = rows_of_problem(arm, {"p": task})["p"]
            own = 48.0 * np.exp(-3.0 * offset * np.sqrt(7.0)) + 2.0
            np.testing.assert_allclose(rows.lower, -min(own, 10.0) * np.asarray(rows.error), rtol=1e-12)

    def test_climbing_keeps_its_gain_which_is_no_rate_of_an_error(self, arm):
        rows = rows_of_problem(arm, {"up": osik.ManipulabilityTask(arm, "hand", gain=30.0)})["up"]
        np.testing.assert_allclose(rows.lower, -30.0 * rows.error)

    def test_the_derivative_at_the_cap_is_that_of_the_gain(self, arm):
        def wanted(gain):
            task = osik.PostureTask(arm, target=np.asarray(arm.q0) + 1.0).replace(gain=gain)
            return rows_of_problem(arm, {"p": task})["p"].lower[0]

        assert float(jax.grad(wanted)(10.0)) == pytest.approx(1.0)
        assert float(jax.grad(wanted)(11.0)) == 0.0

    @pytest.mark.variants(release=["jax"])
    @pytest.mark.parametrize("backend", ["auto", "jax"])
    def test_kernels_get_the_capped_gain(self, arm, goal, backend):
        many, one = (
            osik.solve(
                arm,
                arm.q0,
                {name: tasks_with(arm, goal, gain)[name] for name in ("pose", "balance", "posture")},
                scheme=osik.WeightedQP(backend=backend),
                dt=DT,
            ).velocity
            for gain in (80.0, 10.0)
        )
        np.testing.assert_allclose(many, one, atol=1e-9)

    @pytest.mark.slow
    @pytest.mark.variants(release=["scheme0", "scheme2"])
    @pytest.mark.parametrize("scheme", [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace(method="saturated")])
    def test_errors_fall_at_every_step_however_long_the_step_is(self, arm, goal, scheme):
        """A step as an iteration: dt = 1 with the default gain of 10."""
        for name in ("pose", "posture") if isinstance(scheme, osik.WeightedQP) else ("pose",):
            task = tasks_with(arm, goal, 10.0)[name]
            path = osik.rollout(arm, arm.q0, {name: task}, scheme=scheme, dt=1.0, steps=30)
            size = np.linalg.norm(path.solution.error[name], axis=1)
            assert (path.solution.status == osik.Status.SOLVED).all()
            assert (np.diff(size) < 1e-9).all() and size[-1] < 1e-9

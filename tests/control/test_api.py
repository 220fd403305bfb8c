"""The short way in: ``solve`` with targets, the assembled problem, frame poses, what is raised."""

import warnings
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from refusals import refuses
from task_checks import kinematics_at

import osik_jax as osik


@pytest.fixture(scope="module")
def tasks(arm):
    return {"hand": osik.FrameTask(arm, "hand", gain=5.0), "posture": osik.PostureTask(arm)}


@pytest.fixture(scope="module")
def pose(arm):
    position, rotation = kinematics_at(arm, arm.q0).frame_pose(arm, "hand")
    return position + 0.05, rotation @ jaxlie.SO3.from_z_radians(0.3).as_matrix()


class TestTargetsOfSolve:
    def test_that_are_wrong_are_refused(self, arm, tasks, pose):
        with pytest.raises(KeyError, match="'hnad', which is no task; tasks: hand, posture"):
            osik.solve(arm, arm.q0, tasks, targets={"hnad": pose})
        refuses(TypeError, "targets is a tuple", osik.solve, arm, arm.q0, tasks, targets=pose)
        refuses(osik.OsikError, "position", osik.solve, arm, arm.q0, tasks, targets={"hand": np.zeros(5)})


class TestBuildProblem:
    @pytest.mark.slow
    def test_its_answer_is_that_of_solve(self, arm, tasks, pose):
        wanted = osik.solve(arm, arm.q0, tasks, scheme=osik.WeightedQP(), targets={"hand": pose}, dt=0.01)
        problem = osik.build_problem(arm, arm.q0, tasks, targets={"hand": pose}, dt=0.01)
        found = jax.jit(lambda problem: osik.WeightedQP().solve(problem).velocity)(problem)
        np.testing.assert_allclose(found, wanted.velocity, atol=1e-9)

    def test_has_the_rows_and_the_box(self, arm, tasks):
        problem, own = (
            jax.jit(lambda q, limits=limits: osik.build_problem(arm, q, tasks, limits=limits))(arm.q0)
            for limits in (osik.no_limits, None)
        )
        assert np.isinf(problem.lower).all() and np.isinf(problem.upper).all()
        kinematics = kinematics_at(arm, arm.q0)
        jacobian = osik.frame_jacobian(arm, kinematics, "hand")
        np.testing.assert_allclose(problem.rows["hand"].jacobian[:3], jacobian[:3], atol=1e-12)
        np.testing.assert_array_less(own.lower, own.upper)
        assert np.isfinite(own.lower).all()

    def test_refuses_what_solve_refuses(self, arm, tasks):
        refuses(osik.OsikError, "no task", osik.build_problem, arm, arm.q0, {})
        wrong: Any = "arm"
        refuses(TypeError, "build_problem", osik.build_problem, wrong, arm.q0, tasks)


def test_errors_are_of_one_family_and_print_plainly(arm):
    with pytest.raises(osik.OsikError) as caught:
        osik.FrameTask(arm, "hnad")
    assert isinstance(caught.value, KeyError)
    assert str(caught.value).startswith("no frame 'hnad'; did you mean 'hand'?")
    with pytest.raises(osik.OsikError) as caught:
        osik.solve(arm, arm.q0[:3], {"p": osik.PostureTask(arm)})
    assert isinstance(caught.value, ValueError)


def test_a_posture_lets_other_tasks_win(arm, pose):
    background, named = osik.PostureTask(arm), osik.PostureTask(arm, joints=("*",))
    assert (background.weight == 1e-4).all()
    assert (named.weight == 1.0).all() and (osik.PostureTask(arm, upper=1.0).weight == 1.0).all()
    hand = osik.FrameTask(arm, "hand", gain=5.0).replace(target=pose)
    scheme = osik.WeightedQP(curvature_damping=0.0)  # which would keep the hand back too

    def missed(posture):
        tasks = {"hand": hand, "posture": posture}
        return np.abs(osik.solve(arm, arm.q0, tasks, scheme=scheme, limits=osik.no_limits).slack["hand"]).max()

    assert missed(background) < 0.05 * missed(named)


class TestDefaultScheme:
    @pytest.fixture
    def make(self, arm, pose):
        """Return a function that makes a hand that shall move and a posture that outweighs it."""

        def make(hand: int, posture: int, hard: bool = False):
            numbers: Any = dict(target=pose, gain=5.0, priority=hand, hard=hard)
            # with a radian as 1 m: lighter rows get more of the curvature damping, which misses them by 3e-7 rad/s
            return {
                "hand": osik.FrameTask(arm, "hand", orientation_weight=1.0, **numbers),
                "posture": osik.PostureTask(arm, weight=1e3, priority=posture),
            }

        return make

    @pytest.mark.parametrize(
        ("hand", "posture", "hard", "scheme"),
        [
            (1, 2, False, osik.HierarchicalQP()),
            (3, 3, False, osik.WeightedQP()),
            pytest.param(1, 2, True, osik.WeightedQP(), marks=pytest.mark.slow),
        ],
        ids=["priorities differ", "priorities are equal", "hard tasks do not count"],
    )
    def test_is_chosen_by_priorities(self, arm, make, hand, posture, hard, scheme):
        tasks = make(hand, posture, hard)
        found = osik.solve(arm, arm.q0, tasks)
        np.testing.assert_array_equal(found.velocity, osik.solve(arm, arm.q0, tasks, scheme=scheme).velocity)
        missed = float(jnp.abs(found.slack["hand"]).max())
        assert missed > 0.1 if hand == posture else missed < 1e-9

    def test_is_that_of_rollouts_with_a_function_of_time(self, arm, make):
        ranked = make(1, 2)
        path = osik.rollout(arm, arm.q0, lambda t: ranked, dt=0.01, steps=2)
        step = osik.solve(arm, arm.q0, ranked, dt=0.01)
        np.testing.assert_allclose(path.solution.velocity[0], step.velocity, atol=1e-12)

    def test_a_weighted_qp_by_name_warns_once_of_priorities(self, arm, make):
        hand, posture = make(1, 2).values()
        tasks = {"warned_of": hand, "posture": posture}
        with pytest.warns(osik.OsikWarning, match="ignores priorities .warned_of 1, posture 2."):
            osik.solve(arm, arm.q0, tasks, scheme=osik.WeightedQP())
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            osik.solve(arm, arm.q0, tasks, scheme=osik.WeightedQP())
            osik.solve(arm, arm.q0, {**tasks, "other": hand})

    @pytest.mark.variants(release=["LowAccelerationTask"])
    @pytest.mark.parametrize("task", [osik.LowAccelerationTask, osik.DampingTask])
    def test_a_calming_task_beneath_tasks_that_leave_no_freedom_is_named_once(self, arm, task):
        hand = osik.FrameTask(arm, "hand", priority=1)
        fixed = {"hand": hand, "rest": osik.PostureTask(arm, priority=2), "idle": task(arm, priority=3)}
        with pytest.warns(osik.OsikWarning, match=f"the {task.__name__} 'idle' does nothing.* .hand, rest."):
            osik.solve(arm, arm.q0, fixed)
        # nine rows of rank six above seven joints leave freedom: the rank counts
        more = {"hand": hand, "again": osik.FrameTask(arm, "hand", rows="position", priority=2)}
        free = {**more, "calm": task(arm, priority=3)}
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            osik.solve(arm, arm.q0, fixed)
            osik.rollout(arm, arm.q0, free, steps=1)
            osik.solve(arm, arm.q0, {"hand": hand, "calm": task(arm)})
            jax.jit(lambda q: osik.solve(arm, q, {**fixed, "traced": hand}).velocity)(arm.q0)
            jax.jit(lambda gain: gain * osik.solve(arm, arm.q0, {**more, "constant": task(arm, priority=3)}).velocity)(
                2.0
            )

    @pytest.mark.slow
    @pytest.mark.filterwarnings("ignore:the LowAccelerationTask")
    def test_a_task_of_which_it_is_said_that_it_does_nothing_does_nothing(self, arm):
        above = {"hand": osik.FrameTask(arm, "hand", priority=1), "rest": osik.PostureTask(arm, priority=2)}
        smooth = osik.LowAccelerationTask(arm, velocity=1.0, weight=10.0, priority=3)
        q = arm.q0 + 0.1
        alone, both = (osik.solve(arm, q, {**above, **extra}).velocity for extra in ({}, {"smooth": smooth}))
        np.testing.assert_allclose(both, alone, atol=1e-6)
        assert np.abs(alone).max() > 0.1

"""Which tasks inverse kinematics has to meet, what its answers say about turns, bases and reach; by closed forms."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik

LINK = '<geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0"/>'
PLANAR = f"""<mujoco><compiler angle="radian"/><worldbody><body name="hull" pos="0 0 .1">{{free}}<geom size=".05"/>
<body name="one"><joint name="a" axis="0 0 1"/>{LINK}<body pos=".4 0 0"><joint name="b" axis="0 0 1"/>{LINK}
<body pos=".3 0 0"><joint name="c" axis="0 0 1" range="-2 2" limited="true"/>{LINK}<site name="tip" pos=".2 0 0"/>
</body></body></body></body></worldbody></mujoco>"""
TWO = f"""<mujoco><worldbody><body><joint name="a" axis="0 0 1"/>{LINK}<body pos=".4 0 0"><joint name="b" axis="0 0 1"/>
{LINK}<site name="tip" pos=".3 0 0"/></body></body></worldbody></mujoco>"""
GANTRY = f"""<mujoco><compiler angle="radian"/><worldbody><body name="base">
<joint name="sx" type="slide" axis="1 0 0" range="-{{x}} {{x}}"/>
<joint name="sy" type="slide" axis="0 1 0" range="-5 5"/>
<geom size=".2"/><body pos="0 0 .5"><joint name="j1" axis="0 0 1"/>{LINK}<body pos=".4 0 0">
<joint name="j2" axis="0 0 1"/>{LINK}<site name="tip" pos=".3 0 0"/></body></body></body></worldbody></mujoco>"""
REACH = np.array([0.5, 0.3, 0.1])


@pytest.fixture(scope="module")
def planar():
    return osik.Robot.from_mjcf(PLANAR.format(free=""))


def tip(robot, place: Any = REACH, **options):
    return osik.FrameTask(robot, "tip", rows="position", target=place, **options)


def found(robot, tasks, **options) -> Any:
    return osik.inverse_kinematics(robot, tasks, **{"seeds": 8, "restarts": 1, "closest": False, **options})


PREFERENCES = {
    "DampingTask": lambda robot: osik.DampingTask(robot, weight=1.0),
    "JointVelocityTask": lambda robot: osik.JointVelocityTask(robot, np.array([1.0, -2.0, 0.5])),
    "LowAccelerationTask": lambda robot: osik.LowAccelerationTask(robot, weight=1.0),
    "KineticEnergyTask": lambda robot: osik.KineticEnergyTask(robot),
    "AngularMomentumTask": lambda robot: osik.AngularMomentumTask(robot, axes="z"),
    "LimitTask": lambda robot: osik.LimitTask(robot, osik.ConfigurationLimit(robot, upper={"a": 0.1})),
    "speeds": lambda robot: osik.LimitTask(robot, osik.VelocityLimit(robot, velocity={"*": 0.5})),
    "PostureTask": lambda robot: osik.PostureTask(robot, weight=1.0),
}


@pytest.mark.variants(slow=["all"], release=PREFERENCES)
@pytest.mark.parametrize("name", ["all", *PREFERENCES])
def test_tasks_on_velocities_are_preferences_that_give_way(planar, name):
    chosen = {one: make(planar) for one, make in PREFERENCES.items() if name in ("all", one)}
    answer = found(planar, {"tip": tip(planar), **chosen})
    assert answer.converged and set(answer.residual) == {"tip"}


def test_a_heavy_preference_gives_way_inside_jit_too(planar):
    """Tasks that are made outside, of which only a target is traced."""
    tasks = {"tip": tip(planar), "rest": osik.PostureTask(planar, weight=1e3)}
    answer = jax.jit(lambda place: found(planar, tasks, targets={"tip": place}))(REACH - [0.1, 0, 0])
    assert answer.converged
    where = osik.forward_kinematics(planar, answer.q).frame_pose(planar, "tip")[0]
    np.testing.assert_allclose(where, REACH - [0.1, 0, 0], atol=1e-3)


@pytest.mark.slow
def test_frozen_joints_stay_as_in_q0(planar):
    q0 = jnp.array([0.7, 1.0, -0.3])
    held = found(planar, {"tip": tip(planar), "still": osik.FreezeTask(planar, ("b",))}, q0=q0)
    assert held.converged and abs(held.q[1] - 1.0) < 1e-3 and abs(held.q[2] + 0.3) > 0.1


@pytest.mark.slow
def test_frozen_joints_that_leave_no_solution_give_way_by_priority(planar):
    q0 = jnp.array([0.7, 1.0, -0.3])
    both = osik.FreezeTask(planar, ("a", "b"))
    stuck = found(planar, {"tip": tip(planar, priority=2), "still": both}, q0=q0)
    assert not stuck.converged and np.abs(stuck.q[:2] - q0[:2]).max() < 1e-6
    lower = found(planar, {"tip": tip(planar), "still": both.replace(weight=2.0)}, q0=q0)
    assert not lower.converged and np.abs(lower.residual["still"]).max() > 1e-3


@pytest.mark.slow
def test_frozen_joints_have_no_derivative(planar):
    """The others move the tip with its target, inside jit."""
    q0, still = jnp.array([0.7, 1.0, -0.3]), osik.FreezeTask(planar, ("b",))

    @jax.jit
    @jax.jacfwd
    def slope(place):
        tasks = {"tip": tip(planar, jnp.append(place, 0.1)), "still": still}
        q = osik.inverse_kinematics(planar, tasks, q0=q0, seeds=4, steps=24).q
        return q, osik.forward_kinematics(planar, q).frame_pose(planar, "tip")[0][:2]

    joints, place = slope(jnp.asarray(REACH[:2]))
    np.testing.assert_allclose(joints[1], 0.0, atol=1e-6)
    np.testing.assert_allclose(place, np.eye(2), atol=1e-5)


@pytest.mark.variants(slow=["0.1"], release=["1.3"])
@pytest.mark.parametrize("top", [0.1, 1.3])
def test_a_hard_limit_task_has_to_be_met(planar, top):
    limit = osik.LimitTask(planar, osik.ConfigurationLimit(planar, upper={"*": top}, lower={"*": -top}), hard=True)
    answer = found(planar, {"tip": tip(planar), "range": limit})
    worst = max(float(np.abs(answer.q).max()) - top, 0.0)
    assert bool(answer.converged) == (top == 1.3) and worst < 1e-3


@pytest.mark.slow
def test_says_how_far_a_free_base_went():
    robot = osik.Robot.from_mjcf(PLANAR.format(free='<freejoint name="base"/>'))
    far = REACH + np.array([1.0, 0.0, 0.0])
    answer = found(robot, {"tip": far})
    went = np.linalg.norm(answer.q[:3] - robot.q0[:3])
    turned = 2.0 * np.arccos(min(1.0, abs(float(answer.q[3:7] @ robot.q0[3:7]))))
    np.testing.assert_allclose(answer.base_moved, [went, turned], atol=1e-6)
    assert answer.converged and went > 0.4 and f"the base {went:.3g} m" in answer.explain()


@pytest.mark.slow
def test_wheels_stand_on_the_ground_and_may_slip():
    robot = osik.Robot.from_mjcf(PLANAR.format(free='<freejoint name="base"/>'))
    wheel = osik.WheelTask(robot, "hull", radius=0.05)
    aside = REACH + np.array([0.2, 1.0, -0.05])
    answer = found(robot, {"tip": tip(robot, aside), "wheel": wheel}, seeds=16)
    assert answer.converged and abs(answer.q[2] - 0.05) < 1e-3 and abs(answer.q[1]) > 0.1


def test_a_robot_without_a_free_base_has_none_that_moves(planar):
    assert found(planar, {"tip": REACH}).base_moved is None


TURNS = {
    "posture": lambda robot: osik.PostureTask(robot, weight=1e-3),
    "one joint": lambda robot: osik.PostureTask(robot, joints=("a",), weight=1e-3),
}


@pytest.mark.variants(slow=["posture"], release=["one joint"])
@pytest.mark.parametrize("name", TURNS)
def test_branches_are_counted_modulo_whole_turns_beside_a_posture(name):
    robot = osik.Robot.from_mjcf(TWO)
    tasks = {"tip": tip(robot, np.array([0.4, 0.3, 0.0])), "soft": TURNS[name](robot)}
    answer = found(robot, tasks, all=True, seeds=24)
    assert answer.converged and int(answer.branches) == int(answer.count) == 2
    assert answer.isolated.tolist() == [True] * 2 + [False] * 22
    assert np.abs(answer.solutions[:2] - robot.q0).max() <= np.pi + 1e-3


def test_samples_of_a_continuum_are_not_isolated(planar):
    pose = found(planar, {"tip": REACH}, all=True, seeds=16)
    assert pose.branches > 2 and not pose.isolated.any()
    robot = osik.Robot.from_mjcf(TWO)
    straight = found(robot, {"tip": np.array([0.4, 0.3, 0.0])}, all=True, seeds=16)
    assert straight.isolated.tolist() == [True] * 2 + [False] * 14


@pytest.mark.variants(slow=["5.0"], release=["0.5"])
@pytest.mark.parametrize("x", [5.0, 0.5])
def test_reach_with_slides_is_that_of_their_ends(x):
    robot = osik.Robot.from_mjcf(GANTRY.format(x=x))
    for target in ([50.6, 0.3, 0.5], [-9.0, -8.0, 0.5], [0.0, 7.0, 2.5]):
        target = np.array(target)
        shoulder = np.append(np.clip(target[:2], [-x, -5.0], [x, 5.0]), 0.5)
        least = np.linalg.norm(target - shoulder) - 0.7
        for q0 in (None, jnp.array([0.4 * x, 1.0, 0.1, 0.2])):
            answer = osik.inverse_kinematics(robot, {"tip": target}, q0=q0, seeds=8, restarts=0, closest=True)
            np.testing.assert_allclose(answer.beyond_reach, least, rtol=1e-5)
    assert "sy is at its upper limit" in answer.explain() and "out of reach" in answer.explain()


def test_what_slides_reach_is_never_called_out_of_reach():
    robot = osik.Robot.from_mjcf(GANTRY.format(x=3.0))
    for q in ([3.0, -5.0, 0.0, 0.0], [-3.0, 5.0, 2.0, 0.0], [3.0, 1.0, -1.0, 0.5]):
        pose = osik.forward_kinematics(robot, jnp.array(q)).frame_pose(robot, "tip")[0]
        answer = osik.inverse_kinematics(robot, {"tip": pose}, seeds=8, restarts=0, closest=True)
        assert answer.beyond_reach == 0.0


def test_a_search_does_not_depend_on_where_slides_stand():
    robot = osik.Robot.from_mjcf(GANTRY.format(x=100.0))
    moved = []
    for x in (0.0, 50.0):
        q0 = jnp.array([x, 0.0, 0.2, 0.5])
        goal = np.array([[0.5, 0.3, 0.5], [0.3, -0.2, 0.5]]) + np.array([x, 0.0, 0.0])
        moved.append(osik.inverse_kinematics(robot, {"tip": goal}, q0=q0).q - q0)
    np.testing.assert_allclose(moved[1], moved[0], atol=1e-9)


def test_explain_counts_the_ways_a_frame_moves_and_not_its_joints():
    chain = '<site name="tip" pos=".2 0 0"/>'
    for k in reversed(range(7)):
        chain = f'<body pos=".2 0 0"><joint name="j{k}" axis="0 0 1" range="-90 90"/>{LINK}{chain}</body>'
    robot = osik.Robot.from_mjcf(f"<mujoco><worldbody>{chain}</worldbody></mujoco>")
    said = found(robot, {"tip": (np.array([0.5, 0.3, 0.2]), np.eye(3))}, closest=True).explain()
    assert "tip asks for 6 rows and its 7 joints move it 3 ways" in said
    assert "rows=(True, True, False, False, False, True)" in said


@pytest.mark.slow
def test_least_error_of_goals_that_disagree_has_the_derivative_of_differences(planar):
    """A pose out of reach beside another frame's target, with a posture and weights; of q on the same branch."""
    weights: Any = {"position_weight": 2.0, "orientation_weight": 0.3}
    posture = osik.PostureTask(planar)

    @jax.jit
    @jax.vmap
    def find(x):
        def at(x):
            turn = jnp.array([[jnp.cos(x), -jnp.sin(x), 0.0], [jnp.sin(x), jnp.cos(x), 0.0], [0.0, 0.0, 1.0]])
            pose = jnp.array([1.1 + x, 0.5, 0.1]), turn
            tasks = {"tip": osik.FrameTask(planar, "tip", target=pose, **weights), "posture": posture}
            tasks["one"] = osik.FrameTask(planar, "one", target=(jnp.array([0.2, 0.0, 0.1]), jnp.eye(3)))
            answer = osik.inverse_kinematics(planar, tasks, q0=jnp.array([0.3, 0.4, 0.5]), seeds=1, steps=24)
            return answer.q, answer.position_error, answer.orientation_error

        return at(x), jax.jacfwd(at)(x), jax.jacrev(at)(x)

    step = 1e-5
    values, forward, reverse = find(jnp.array([0.2 - step, 0.2, 0.2 + step]))
    assert values[1][1] > 0.05
    for value, *slopes in zip(values, forward, reverse, strict=True):
        for slope in slopes:
            np.testing.assert_allclose(slope[1], (value[2] - value[0]) / (2.0 * step), atol=1e-5)

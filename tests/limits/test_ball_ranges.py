"""Ranges of ball joints: kept by every step, against MuJoCo's angle and the nearest point of a spherical cap."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.robot._ranges import ball_rotation, with_balls_inside

LENGTH, CENTER = 0.3, np.array([0.0, 0.0, 0.5])


def mjcf(degrees: float, more: str = "") -> str:
    """A rod on a ball joint, with a hinged one beside it."""
    return f"""<mujoco><compiler autolimits="true"/><worldbody>
      <body pos="0 0 .5"><joint name="ball" type="ball" range="0 {degrees}"/>
        <geom type="capsule" size=".02" fromto="0 0 0 0 0 {LENGTH}"/><site name="tip" pos="0 0 {LENGTH}"/></body>
      <body pos="1 0 0"><joint name="hinge" axis="0 1 0" range="-90 90"/><geom size=".1"/></body>
    </worldbody>{more}</mujoco>"""


def angles(q: np.ndarray | jax.Array) -> np.ndarray:
    """Angle of the ball joint [rad], of configurations (..., nq)."""
    return Rotation.from_quat(np.asarray(q)[..., :4].reshape(-1, 4), scalar_first=True).magnitude()


def nearest_in_cap(target: np.ndarray, angle: float) -> np.ndarray:
    """The point of the cap, up to an angle from straight up, that is nearest to a target."""
    way = np.asarray(target) - CENTER
    across = way[:2] / np.linalg.norm(way[:2])
    tilt = min(np.arctan2(way[:2] @ across, way[2]), angle)
    return CENTER + LENGTH * np.array([*(np.sin(tilt) * across), np.cos(tilt)])


@pytest.mark.variants(slow=["HierarchicalQP-75.0"], release=["HierarchicalQP-12.0", "WeightedQP-12.0"])
@pytest.mark.parametrize("degrees", [12.0, 75.0])
@pytest.mark.parametrize("scheme", [osik.WeightedQP, osik.HierarchicalQP])
def test_no_step_leaves_the_range_and_the_nearest_point_is_reached(degrees: float, scheme: type):
    """Out to one side, then across to the other along the end of the range: 400 steps each."""
    robot, most = osik.Robot.from_mjcf(mjcf(degrees)), np.radians(degrees)
    tasks = {"tip": osik.FrameTask(robot, "tip", rows="position")}
    q = robot.q0
    for target in (np.array([0.3, 0.0, 0.5]), np.array([-0.2, 0.25, 0.45])):
        goals = {"tip": np.tile(target, (400, 1))}
        path = osik.rollout(robot, q, tasks, targets=goals, steps=400, dt=0.01, scheme=scheme())
        assert angles(path.q).max() <= most
        assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()
        q = path.q[-1]
        tip = osik.forward_kinematics(robot, q).frame_pose(robot, "tip")[0]
        assert np.linalg.norm(tip - nearest_in_cap(target, most)) < 0.003 * most * LENGTH + 1e-5


@pytest.mark.release
def test_random_steps_at_the_end_of_the_range_stay_inside():
    """Any velocity that box and row allow, of joints anywhere in the range, ends inside: corners of the box too."""
    robot = osik.Robot.from_mjcf(mjcf(40.0))
    limit, rng = osik.ConfigurationLimit(robot), np.random.default_rng(0)

    def moved(q, corner, dt):
        lower, upper = limit.box(robot, q, dt)
        rows = limit.rows(robot, osik.forward_kinematics(robot, q), q, dt)
        assert rows is not None
        v = jnp.where(corner > 0.0, upper, lower)
        v = jnp.where(jnp.isfinite(v), v, 0.0)
        axis, outward = rows.jacobian[0], rows.upper[0]
        excess = jnp.where(jnp.isfinite(outward), jnp.maximum(axis @ v - outward, 0.0), 0.0)
        return osik.integrate(robot, q, v - excess * axis, dt)

    axes = rng.normal(size=(500, 3))
    share = 1.0 - 10.0 ** rng.uniform(-6, 0, 500)
    turned = Rotation.from_rotvec(np.radians(40.0) * share[:, None] * axes / np.linalg.norm(axes, axis=1)[:, None])
    q = np.column_stack([turned.as_quat(scalar_first=True), np.zeros(500)])
    after = jax.vmap(moved, in_axes=(0, 0, None))(q, rng.choice([-1.0, 1.0], (500, robot.nv)), 0.02)
    assert angles(after).max() <= np.radians(40.0) * (1.0 + 1e-12)


def test_a_joint_outside_its_range_comes_back():
    robot = osik.Robot.from_mjcf(mjcf(30.0), velocity_limits={"ball": 2.0})
    q = np.array([*Rotation.from_rotvec([0.5, 0.6, 0.0]).as_quat(scalar_first=True), 0.0])
    path = osik.rollout(robot, q, {"posture": osik.PostureTask(robot, target=q)}, steps=100, dt=0.02)
    assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()
    assert np.diff(angles(path.q)).max() < 1e-4
    assert np.radians(29.8) < angles(path.q)[-1] <= np.radians(30.0)


@pytest.mark.release
def test_inverse_kinematics_keeps_the_range_to_its_end():
    robot = osik.Robot.from_mjcf(mjcf(30.0))
    beyond = osik.inverse_kinematics(robot, {"tip": [0.3, 0.0, 0.5]}, seeds=2, restarts=0)
    assert not beyond.converged and angles(beyond.q)[0] == pytest.approx(np.radians(30.0), abs=1e-9)
    assert "ball is at its upper limit" in beyond.explain()
    at_the_end = nearest_in_cap(np.array([0.3, 0.1, 0.5]), np.radians(30.0))
    found = osik.inverse_kinematics(robot, {"tip": at_the_end}, seeds=2, restarts=0)
    assert found.converged and angles(found.q)[0] <= np.radians(30.0) + 1e-12


def test_the_angle_is_that_of_mujoco():
    """MuJoCo's limit row of a ball joint is the range less the angle."""
    robot = osik.Robot.from_mjcf(mjcf(20.0))
    model, data = robot.mj_model, mujoco.MjData(robot.mj_model)
    for vector in ([0.4, 0.0, 0.1], [-0.2, 0.5, 0.3], [1.0, -2.0, 0.5]):
        data.qpos[:] = [*Rotation.from_rotvec(vector).as_quat(scalar_first=True), 0.0]
        data.qpos[:4] *= -1.0  # the same rotation
        mujoco.mj_forward(model, data)
        angle, axis = ball_rotation(jnp.asarray(data.qpos[:4]))
        assert robot.position_upper[0] - angle == pytest.approx(data.efc_pos[0], abs=1e-12)
        np.testing.assert_allclose(-axis, data.efc_J.reshape(data.nefc, -1)[0, :3], atol=1e-12)


def test_home_keyframe_and_options():
    """q0 is inside, a home outside is refused, and ``position_limits`` replaces the range."""
    wide = " ".join(map(str, Rotation.from_rotvec([0.0, 1.0, 0.0]).as_quat(scalar_first=True)))
    text = mjcf(30.0, f'<keyframe><key name="wide" qpos="{wide} 0"/></keyframe>')
    with pytest.warns(osik.OsikWarning, match="keyframe 'wide': ball is turned by .*: in q0 it is at the end"):
        robot = osik.Robot.from_mjcf(text)
    assert angles(robot.q0)[0] == pytest.approx(np.radians(30.0))
    with pytest.warns(osik.OsikWarning, match="ball is turned by 1, its range is"):
        assert angles(robot.with_home([*map(float, wide.split()), 0.0]).q0)[0] == pytest.approx(1.0)
    with pytest.warns(osik.OsikWarning, match="keyframe 'wide': ball is"):
        assert angles(robot.with_home("wide").q0)[0] == pytest.approx(np.radians(30.0))
    np.testing.assert_allclose(robot.position_upper, [*[np.radians(30.0)] * 3, np.pi / 2])
    np.testing.assert_allclose(robot.position_lower[:3], -robot.position_upper[:3])
    free = osik.Robot.from_mjcf(text, position_limits={"ball": (-np.inf, np.inf)})
    assert np.isinf(free.position_upper[:3]).all() and angles(free.q0)[0] == pytest.approx(1.0)
    narrow = osik.Robot.from_mjcf(mjcf(30.0), position_limits={"ball": (0.0, 0.1)})
    np.testing.assert_allclose(narrow.position_upper[:3], 0.1)
    with pytest.raises(ValueError, match="range of the ball joint 'ball'"):
        osik.Robot.from_mjcf(text, position_limits={"ball": (-0.1, 0.2)})


def test_ranges_are_written():
    robot = osik.Robot.from_mjcf(mjcf(25.0))
    again = osik.Robot.from_mjcf(robot.to_mjcf())
    np.testing.assert_array_equal(again.position_upper, robot.position_upper)
    np.testing.assert_array_equal(again.position_lower, robot.position_lower)


@pytest.mark.release
def test_derivatives_are_finite_where_the_axis_is_not_known():
    robot = osik.Robot.from_mjcf(mjcf(25.0))
    limit = osik.ConfigurationLimit(robot)
    for vector in (np.zeros(3), [1e-12, 0.0, 0.0], [0.2, 0.1, 0.0], [0.43, 0.0, 0.0]):
        q = jnp.array([*Rotation.from_rotvec(vector).as_quat(scalar_first=True), 0.0])

        def numbers(q, dt):
            rows = limit.rows(robot, osik.forward_kinematics(robot, q), q, dt)
            assert rows is not None
            kept = [limit.box(robot, q, dt)[1], rows.jacobian.ravel(), rows.upper]
            inside = with_balls_inside(robot.tree, q, robot.position_upper)
            return jnp.concatenate([*(jnp.where(jnp.isfinite(a), a, 0.0) for a in kept), inside])

        for derivative in jax.jacrev(numbers, argnums=(0, 1))(q, 0.01):
            assert np.isfinite(derivative).all()


@pytest.mark.slow
def test_searches_turn_ball_joints_and_find_different_solutions():
    """Two links on ball joints have a line of solutions for a pose; each is inside the ranges, and MuJoCo agrees."""
    most, rng = 2.5, np.random.default_rng(3)
    link = '<geom type="capsule" size=".02" fromto="0 0 0 .3 0 0"/>'
    joint = f'<joint type="ball" range="0 {most}"/>{link}'
    robot = osik.Robot.from_mjcf(f"""<mujoco><compiler angle="radian" autolimits="true"/><worldbody><body>{joint}
      <body pos=".4 0 0">{joint}<site name="tip" pos=".3 0 0"/></body></body></worldbody></mujoco>""")
    data = mujoco.MjData(robot.mj_model)

    def tip(turns: Rotation) -> tuple[np.ndarray, np.ndarray]:
        data.qpos[:] = turns.as_quat(scalar_first=True).ravel()
        mujoco.mj_kinematics(robot.mj_model, data)
        return data.site("tip").xpos.copy(), data.site("tip").xmat.reshape(3, 3).copy()

    axes = rng.normal(size=(4, 2, 3))
    angles = np.broadcast_to([[2.4], [0.5]], (4, 2, 1))
    turned = [Rotation.from_rotvec(own) for own in angles * axes / np.linalg.norm(axes, axis=-1, keepdims=True)]
    position, rotation = (np.array(part) for part in zip(*map(tip, turned), strict=True))
    found = osik.inverse_kinematics(robot, {"tip": (position, rotation)}, all=True, seeds=16, restarts=0, closest=False)
    assert found.converged.all() and found.count is not None and found.solutions is not None
    for at, (place, frame) in enumerate(zip(position, rotation, strict=True)):
        count = int(found.count[at])
        turns = Rotation.from_quat(np.asarray(found.solutions[at, :count]).reshape(-1, 4), scalar_first=True)
        assert count >= 4 and turns.magnitude().max() <= most
        first = turns[::2]
        apart = [(first[i].inv() * first[j]).magnitude() for i in range(count) for j in range(i)]
        assert min(apart) > 0.05
        for own in range(count):
            here, tilt = tip(turns[2 * own : 2 * own + 2])
            assert np.linalg.norm(here - place) < 1e-3
            assert (Rotation.from_matrix(tilt) * Rotation.from_matrix(frame).inv()).magnitude() < 1e-2

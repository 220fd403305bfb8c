"""A robot of another file with the same tree through one jitted function: what is read from its model is its own."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import osik_jax as osik

TEXT = """<mujoco><worldbody><body name="a"><joint name="j1" axis="0 1 0"/>
  <geom name="ga" type="box" size=".02 .02 {size}" pos="0 0 .1" mass="{mass}"/>
  <body name="f" pos="0 0 {place}"><joint name="j2" axis="0 1 0"/>
    <geom name="gf" type="box" size=".02 .02 .1" pos="0 0 .2"/>
    <body name="h" pos="0 0 .4"><joint name="j3" axis="0 1 0"/><geom name="gh" size=".05" pos="0 0 .2"/>
      <site name="tip" pos="0 0 .3"/></body></body></body></worldbody>{exclude}
  <equality><connect name="c" body1="h" anchor="{anchor}"/></equality>
  <keyframe><key name="{key}" qpos="{qpos}"/></keyframe></mujoco>"""  # fmt: skip
Q = jnp.array([0.3, 0.6, 0.4])


def first():
    return osik.Robot.from_mjcf(
        TEXT.format(size=0.1, mass=1, place=0.4, exclude="", anchor="0 0 .3", key="ka", qpos=".3 .6 .4")
    )


def second():
    exclude = '<contact><exclude body1="a" body2="h"/></contact>'
    return osik.Robot.from_mjcf(
        TEXT.format(size=0.1, mass=9, place=0.6, exclude=exclude, anchor="0 .1 .1", key="kb", qpos=".1 .2 .3")
    )


def counted():
    """A jitted function that makes its tasks itself, and how often it is traced."""
    count = [0]

    @jax.jit
    def velocity(robot, q):
        count[0] += 1
        tasks = {"c": osik.ComTask(robot), "e": osik.EqualityConstraintTask(robot), "f": osik.FrameTask(robot, "tip")}
        return osik.solve(robot, q, tasks, limits=osik.no_limits).velocity

    return velocity, count


@pytest.mark.slow
def test_tasks_made_inside_are_of_the_robot_that_is_given():
    velocity, count = counted()
    robots = first(), second()
    assert robots[0].tree == robots[1].tree
    got = [np.asarray(velocity(robot, Q)) for robot in robots]
    for robot, inside in zip(robots, got, strict=True):
        tasks = {"c": osik.ComTask(robot), "e": osik.EqualityConstraintTask(robot), "f": osik.FrameTask(robot, "tip")}
        np.testing.assert_allclose(inside, osik.solve(robot, Q, tasks, limits=osik.no_limits).velocity, atol=1e-10)
    assert np.abs(got[0] - got[1]).max() > 0.1 and count == [2]


def test_the_same_file_read_twice_and_longer_links_compile_nothing():
    velocity, count = counted()
    robot = first()
    for other in (robot, first(), robot.scaled(length=1.2), robot.with_home(np.zeros(3))):
        velocity(other, Q)
    assert count == [1]
    assert hash(first().holder) == hash(robot.holder) and first().holder == robot.holder != second().holder


def test_a_robot_that_a_jitted_function_returns_keeps_its_model():
    through = jax.jit(lambda robot: robot)
    one, other = first(), second()
    returned = through(one), through(other)
    assert returned[1].mj_model is other.mj_model and returned[1].mj_model.body_mass[1] == 9.0
    assert osik.Robot.from_mjcf(returned[1].to_mjcf()).mj_model.body_mass[1] == pytest.approx(9.0)
    np.testing.assert_allclose(returned[1].with_home("kb").q0, [0.1, 0.2, 0.3])
    with pytest.raises(KeyError, match="keyframe 'ka'"):
        returned[1].with_home("ka")
    assert set(osik.CollisionAvoidanceLimit(returned[0]).pairs[0]) == {"ga", "gh"}
    with pytest.raises(ValueError, match="no pair of shapes is left"):  # the model excludes the only pair
        osik.CollisionAvoidanceLimit(returned[1])


def test_collision_pairs_made_inside_are_of_the_robot_that_is_given():
    distances = jax.jit(
        lambda robot, q: osik.CollisionAvoidanceLimit(robot, q0_distance=-np.inf).distances(
            robot, osik.forward_kinematics(robot, q)
        )
    )
    assert distances(first(), Q).shape == (1,)
    with pytest.raises(ValueError, match="no pair of shapes is left"):
        distances(second(), Q)


@pytest.mark.release
def test_a_stack_of_robots_of_different_files_has_no_model():
    one, other = first(), second()
    both = osik.stack([one, other])
    tasks = [{"f": osik.FrameTask(robot, "tip"), "e": osik.EqualityConstraintTask(robot)} for robot in (one, other)]
    solve = jax.vmap(lambda robot, tasks: osik.solve(robot, Q, tasks, limits=osik.no_limits).velocity)
    for row, robot, own in zip(solve(both, osik.stack(tasks)), (one, other), tasks, strict=True):
        np.testing.assert_allclose(row, osik.solve(robot, Q, own, limits=osik.no_limits).velocity, atol=1e-10)
    with pytest.raises(ValueError, match="robots of different files"):
        _ = both.mj_model
    with pytest.raises(ValueError, match="robots of different files"):
        jax.vmap(lambda robot: osik.solve(robot, Q, {"e": osik.EqualityConstraintTask(robot)}).velocity)(both)
    assert "a stack of 2" in repr(both)
    assert osik.stack([one, first()]).mj_model is one.mj_model
    assert osik.stack([{"robot": one, "n": 1.0}, {"robot": other, "n": 2.0}])["n"].tolist() == [1.0, 2.0]

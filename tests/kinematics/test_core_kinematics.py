"""The core's kinematics on a CPU: beside the plain methods and MuJoCo C, and the derivatives of both."""

from dataclasses import replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from frames_beside_mujoco import random_configurations
from model_files import mjcf
from test_kinematics import quick_jit, toy_robot

import osik_jax as osik
from osik_jax.kinematics import forward_kinematics
from osik_jax.kinematics._forward import kinematics_by, moving_center, moving_frames
from osik_jax.tasks import AdaptiveGain
from osik_jax.tasks._rows import rows_of

pytestmark = needs_core
ROUNDING = 1e-13
"""Of numbers near 1, which some dozen products and sums have made."""


def make(name: str) -> osik.Robot:
    if name == "toy":
        return toy_robot()
    if name == "coupled":
        return osik.Robot.from_mjcf(mjcf("coupled"), locked_joints={"stiff": 0.4})
    return osik.load_robot(name)


NAMES = ("toy", "coupled", "nao", "arm7")
SUBTREES = {"toy": "cross", "coupled": "end", "nao": "LThigh", "arm7": "link4"}


@pytest.fixture(scope="module")
def robots() -> dict[str, osik.Robot]:
    return {name: make(name) for name in NAMES}


def everything(backend, subtree, robot, q):
    """Bodies, dofs, all frames with their Jacobians, centres of mass with theirs."""
    kin = forward_kinematics(robot, q) if backend == "jax" else kinematics_by(backend, robot, q)
    assert kin.backend == backend
    return (
        jax.tree.leaves(kin),
        moving_frames(robot, kin, robot.frame_names[-6:] if subtree else robot.frame_names),
        moving_center(robot, kin),
        moving_center(robot, kin, subtree),
    )


def both(name: str):
    return tuple(partial(everything, backend, SUBTREES[name]) for backend in ("core", "jax"))


def assert_near(ours, theirs, atol=ROUNDING):
    jax.tree.map(partial(np.testing.assert_allclose, rtol=0.0, atol=atol), ours, theirs)


@pytest.mark.variants(slow=["coupled"], release=["toy", "nao"])
@pytest.mark.parametrize("name", NAMES)
def test_beside_the_plain_method(robots, name):
    """Alone, in a batch that shares the robot, and in one of robots with other links, masses and axes."""
    robot, (ours, theirs) = robots[name], both(name)
    q = jnp.asarray(random_configurations(robot, 1, 3))
    assert_near(quick_jit(ours)(robot, q[0]), quick_jit(theirs)(robot, q[0]))
    assert_near(*(quick_jit(jax.vmap(f, (None, 0)))(robot, q) for f in (ours, theirs)))

    def scaled(length, q, f):
        other = robot.scaled(length=length, mass=2.0 - length)
        longer = 1.0 + 0.01 * length  # quaternions and axes of no unit length, a place for the world, which has none
        place, quaternions = other.body_position.at[0].add(length), longer * other.body_quaternion
        return f(
            replace(other, body_position=place, body_quaternion=quaternions, joint_axis=longer * other.joint_axis), q
        )

    lengths = jnp.array([0.8, 1.0, 1.3])
    assert_near(*(quick_jit(jax.vmap(partial(scaled, f=f)))(lengths, q) for f in (ours, theirs)))
    if name == "coupled":
        each = [jax.vmap(jax.vmap(partial(scaled, f=f), (None, 0)), (0, None)) for f in (ours, theirs)]
        assert_near(*(quick_jit(f)(lengths, q) for f in each))


@pytest.mark.variants(release=["toy"])
@pytest.mark.variants(slow=["coupled"])
@pytest.mark.parametrize("name", (pytest.param("toy", marks=pytest.mark.slow), "coupled"))
def test_derivatives(robots, name):
    """Both modes, with respect to the configuration and to the robot's own numbers, and the second along a line."""
    robot, (ours, theirs) = robots[name], both(name)
    q = jnp.asarray(random_configurations(robot, 3, 1)[0])
    rate = jnp.linspace(-1.0, 1.0, len(q))

    def total(robot, q, f):
        return sum(map(_total, jax.tree.leaves(f(robot, q))))

    def along(s, f):
        return f(robot, q + s * rate)

    assert_near(*(quick_jit(jax.jacfwd(f, argnums=1))(robot, q) for f in (ours, theirs)), atol=1e-12)
    slopes = (quick_jit(jax.grad(partial(total, f=f), argnums=(0, 1)))(robot, q) for f in (ours, theirs))
    assert_near(*map(jax.tree.leaves, slopes), atol=1e-11)
    assert_near(*(quick_jit(jax.jacfwd(jax.jacfwd(partial(along, f=f))))(0.0) for f in (ours, theirs)), atol=1e-11)


def _total(a):
    """A number that every entry counts for, each in another way."""
    return jnp.sum(jnp.sin(a.ravel() + jnp.arange(a.size)))


def test_single_precision():
    """Data and results are single, the arithmetic is not."""
    configuration = random_configurations(make("toy"), 4, 1)[0]
    with jax.enable_x64(False):
        robot, q = make("toy"), jnp.asarray(configuration, jnp.float32)
        ours, theirs = (jax.jit(f)(robot, q) for f in both("toy"))
        assert {a.dtype for a in jax.tree.leaves(ours)} == {jnp.dtype("float32")}
        assert_near(ours, theirs, atol=3e-6)


OPTIONS = {
    "pose": dict(),
    "frame's axes": dict(axes="frame"),
    "position": dict(rows="position"),
    "some": dict(rows=(True, False, True, False, True, True), axes="frame"),
    "geometric": dict(orientation_jacobian="geometric"),
    "geometric, frame's": dict(orientation_jacobian="geometric", axes="frame", rows="orientation"),
    "twist": dict(error="se3"),
    "adaptive": dict(gain=AdaptiveGain(10.0, 2.0, 3.0)),
    "bounds": dict(rows="position", lower=-0.1, upper=0.2),
}


def pose_tasks(robot: osik.Robot, **options) -> dict[str, osik.Task]:
    """Two frames in the world and one in the other, with targets that are off and move."""
    rng, one, other = np.random.default_rng(5), "tool", "imu"
    given: dict[str, Any] = dict(position_weight=[1.0, 2.0, 3.0], target_velocity=rng.normal(size=6)) | options
    tasks: dict[str, osik.Task] = {
        name: osik.FrameTask(robot, name, weight=1.0 + i, **given) for i, name in enumerate((one, other))
    }
    if options.get("axes") == "frame":
        return tasks
    return tasks | {"relative": osik.RelativeFrameTask(robot, one, other, **given)}


def rows_by(backend, robot, q, tasks) -> Any:
    """Rows of all tasks at once and of each alone, with the squared lengths that a kernel returns with them."""
    kin = forward_kinematics(robot, q) if backend == "jax" else kinematics_by(backend, robot, q)
    alone = {name: task.rows(robot, kin, q) for name, task in tasks.items()}
    both = rows_of(robot, kin, q, tasks), alone
    return [{name: replace(one, squares=one.squared_lengths()) for name, one in rows.items()} for rows in both]


@pytest.mark.variants(ordinary=[], slow=["bounds"])
@pytest.mark.parametrize("case", OPTIONS)
def test_rows_of_poses(robots, case):
    """All that the rows hold, beside the plain method; some errors are 0, one is nearly half a turn."""
    robot = robots["toy"]
    tasks = pose_tasks(robot, **OPTIONS[case])

    def rows(q, backend):
        found, alone = rows_by(backend, robot, q, tasks)
        assert all(task.is_equality == (case != "bounds") for task in found.values())
        return found, alone

    half = robot.q0.at[3:7].set(jnp.array([1e-9, 0.6, 0.0, 0.8]))
    q = jnp.concatenate([jnp.asarray(random_configurations(robot, 6, 4)), robot.q0[None], half[None]])
    ours, theirs = (quick_jit(jax.vmap(partial(rows, backend=backend)))(q) for backend in ("core", "jax"))
    assert_near(ours, theirs, atol=1e-11)


@pytest.mark.release
def test_derivatives_of_rows(robots):
    robot = robots["toy"]
    tasks = pose_tasks(robot)
    q = jnp.asarray(random_configurations(robot, 7, 1)[0])

    def total(q, tasks, backend):
        return sum(map(_total, jax.tree.leaves(rows_by(backend, robot, q, tasks))))

    ours, theirs = (
        quick_jit(jax.grad(partial(total, backend=backend), argnums=(0, 1)))(q, tasks) for backend in ("core", "jax")
    )
    assert_near(*map(jax.tree.leaves, (ours, theirs)), atol=1e-9)


@pytest.mark.release
def test_a_step_that_says_jax_has_no_kernel(robots):
    """``jax.export`` takes no calls of kernels: a step of ``backend="jax"`` is exported, and gives the same."""
    robot = robots["arm7"]
    tasks = {"hand": osik.FrameTask(robot, robot.body_names[-1]), "posture": osik.PostureTask(robot)}
    others = tasks | {"hand": osik.FrameTask(robot, robot.body_names[-1], hard=True)}  # no step in one call

    def step(q, backend, tasks=tasks):
        return osik.solve(robot, q, tasks, scheme=osik.WeightedQP(backend=backend)).velocity

    def text(backend, tasks):
        return jax.jit(partial(step, backend=backend, tasks=tasks)).lower(q).as_text()

    q = robot.q0 + 0.1
    assert "osik_" not in text("jax", tasks) + text("jax", others)
    assert "osik_step" in text("core", tasks)
    for kernel in ("osik_kinematics", "osik_moving_frames", "osik_pose_rows"):
        assert kernel in text("core", others)
    exported = jax.export.export(jax.jit(partial(step, backend="jax")))(q)
    np.testing.assert_allclose(exported.call(q), step(q, "core"), atol=1e-9)

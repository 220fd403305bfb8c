"""Inverse kinematics: what is found is checked by MuJoCo, counted in closed form, differentiated by differences."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compilations import Compilations
from model_files import mjcf
from mujoco_states import mujoco_at
from refusals import refuses

import osik_jax as osik
from osik_jax.inverse._poses import read_poses
from osik_jax.inverse._problem import read_problem
from osik_jax.limits import LimitRows

POSITION, ORIENTATION = 1e-3, 1e-2


@pytest.fixture(scope="module")
def planar():
    return osik.Robot.from_mjcf(mjcf("two_links_with_a_tip"))


def mujoco_pose(robot, q, frame):
    """The pose of a body or site, by MuJoCo's own kinematics in double precision."""
    data = mujoco_at(robot, np.asarray(q, float))
    site = mujoco.mj_name2id(robot.mj_model, mujoco.mjtObj.mjOBJ_SITE, frame)
    of = data.site(frame) if site >= 0 else data.body(frame)
    return of.xpos.copy(), of.xmat.reshape(3, 3).copy()


def mujoco_jacobian(robot, q, site):
    """Rows [linear; angular] in world axes, by MuJoCo."""
    data, jacobian = mujoco_at(robot, q), np.zeros((6, robot.mj_model.nv))
    mujoco.mj_jacSite(robot.mj_model, data, jacobian[:3], jacobian[3:], data.site(site).id)
    return jacobian


def angle(a, b):
    return np.arccos(np.clip((np.trace(a @ b.T) - 1.0) / 2.0, -1.0, 1.0))


def errors_by_mujoco(robot, q, frame, position, rotation):
    poses = [mujoco_pose(robot, own, frame) for own in np.asarray(q)]
    away = [np.linalg.norm(p - wanted) for (p, _), wanted in zip(poses, position, strict=True)]
    turned = [angle(r, wanted) for (_, r), wanted in zip(poses, rotation, strict=True)]
    return np.array(away), np.array(turned)


def random_poses(robot, frame, count, rng):
    """Poses of configurations within the limits, by MuJoCo."""
    low, high = (np.where(np.isfinite(x), x, y) for x, y in ((robot.position_lower, -3.0), (robot.position_upper, 3.0)))
    poses = [mujoco_pose(robot, low + (high - low) * rng.random(robot.nq), frame) for _ in range(count)]
    return np.array([p for p, _ in poses]), np.array([r for _, r in poses])


def assert_within_limits(robot, q):
    q = np.asarray(q)
    assert (q >= np.asarray(robot.position_lower)).all() and (q <= np.asarray(robot.position_upper)).all()


@pytest.mark.variants(release=["float32"])
@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_finds_what_is_reachable(arm, rng, precision):
    robot = arm.astype(precision)
    position, rotation = random_poses(arm, "hand", 300, rng)
    found = osik.inverse_kinematics(robot, {"hand": (position, rotation)})
    away, turned = errors_by_mujoco(arm, found.q, "hand", position, rotation)
    assert found.q.shape == (300, 7) and found.q.dtype == precision
    assert np.asarray(found.converged).all()
    assert away.max() <= POSITION and turned.max() <= ORIENTATION
    np.testing.assert_allclose(found.position_error, away, atol=1e-9 if precision == "float64" else 2e-6)
    assert_within_limits(robot, found.q)


def test_slides_followers_and_two_joints_on_a_body(rng):
    robot = osik.Robot.from_mjcf(mjcf("joints_of_all_kinds_on_a_rail"))
    position, rotation = random_poses(robot, "tool", 100, rng)
    found = osik.inverse_kinematics(robot, {"tool": (position, rotation)})
    away, turned = errors_by_mujoco(robot, found.q, "tool", position, rotation)
    assert np.asarray(found.converged).all()
    assert away.max() <= POSITION and turned.max() <= ORIENTATION
    assert_within_limits(robot, found.q)
    aside = robot.joint_qpos_index("aside")
    assert (np.asarray(found.q)[:, aside] == np.asarray(robot.q0)[aside]).all()  # carries no frame, stays


def test_what_cannot_be_reached_is_never_found(arm, rng):
    position, rotation = random_poses(arm, "hand", 16, rng)
    away = position / np.linalg.norm(position, axis=1, keepdims=True) * rng.uniform(1.3, 3.0, (16, 1))
    found = osik.inverse_kinematics(arm, {"hand": (away, rotation)}, seeds=4, restarts=1)
    assert not np.asarray(found.converged).any()
    assert (np.asarray(found.beyond_reach) > 0.0).all()
    missed, _ = errors_by_mujoco(arm, found.q, "hand", away, rotation)
    np.testing.assert_allclose(found.position_error, missed, atol=1e-9)
    assert (missed >= np.asarray(found.beyond_reach)).all()
    assert_within_limits(arm, found.q)
    assert "out of reach" in found.explain(3)
    refuses(ValueError, "there are 16 targets", found.explain)


def test_says_which_limit_stops_it(planar):
    """The target is at 0.9 m, behind: both joints turned as far as they go leave it."""
    far = 0.9 * np.array([np.cos(3.1), np.sin(3.1), 0.0])
    found = osik.inverse_kinematics(planar, {"tip": far})
    assert not found.converged
    assert np.asarray(found.at_limit).tolist()[0] == 1
    assert "j1 is at its upper limit" in found.explain()
    assert found.beyond_reach == 0.0


def two_solutions(x, y):
    """Of the planar arm, in closed form."""
    bend = np.arccos((x * x + y * y - 0.5**2 - 0.4**2) / (2 * 0.5 * 0.4))
    return [np.array([np.arctan2(y, x) - np.arctan2(0.4 * np.sin(b), 0.5 + 0.4 * np.cos(b)), b]) for b in (bend, -bend)]


def test_all_solutions_are_those_of_the_closed_form(planar):
    found = osik.inverse_kinematics(
        planar, {"tip": (0.5, 0.3, 0.0)}, all=True, seeds=16, position_tolerance=1e-9, steps=60
    )
    assert found.count == 2
    solutions = np.asarray(found.solutions)
    for expected in two_solutions(0.5, 0.3):
        assert np.abs(solutions[:2] - expected).max(1).min() < 1e-7
    np.testing.assert_array_equal(solutions[0], found.q)
    assert np.isnan(solutions[2:]).all()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
def test_nearest_finds_what_the_plain_call_finds(rng):
    """From a configuration outside of its limits, where searches near home stay; by numbers and while tracing."""
    robot = osik.load_robot("arm7", position_limits={f"joint{i}": (-2.8, 2.8) for i in range(1, 8)})
    position, rotation = random_poses(robot, "hand", 64, rng)

    def find(position, rotation, nearest=False):
        start = jnp.full(7, 4.0)
        return osik.inverse_kinematics(robot, {"hand": (position, rotation)}, q0=start, seeds=8, nearest=nearest)

    near, plain = find(position, rotation, nearest=True), find(position, rotation)
    assert np.asarray(plain.converged).all() and np.asarray(near.converged).all()
    away, turned = errors_by_mujoco(robot, near.q, "hand", position, rotation)
    assert away.max() <= POSITION and turned.max() <= ORIENTATION
    assert_within_limits(robot, near.q)
    ways = [np.linalg.norm(np.asarray(found.q) - 2.8, axis=1) for found in (near, plain)]
    assert np.median(ways[0]) < np.median(ways[1]) and (ways[0] < ways[1] + 1e-3).mean() > 0.9
    traced, fixed = (jax.jit(partial(find, nearest=own))(position, rotation).converged for own in (True, False))
    assert np.asarray(fixed).any() and (np.asarray(traced) >= np.asarray(fixed)).all()


@pytest.mark.variants(slow=["options1"])
@pytest.mark.parametrize("options", [{}, {"nearest": True}])
def test_numbers_inside_jit_are_searched_as_outside(planar, options):
    """Of a target out of reach, where the search goes on to the least error."""
    target = np.array([1.2, 0.3, 0.0])
    outside = osik.inverse_kinematics(planar, {"tip": target}, seeds=4, restarts=0, **options)

    def inside(angle):
        found = osik.inverse_kinematics(planar, {"tip": target}, seeds=4, restarts=0, **options)
        return found.q + angle, found.position_error

    q, error = jax.jit(inside)(0.5)
    np.testing.assert_allclose(q - 0.5, outside.q, atol=1e-12)
    assert error == outside.position_error == pytest.approx(np.hypot(1.2, 0.3) - 0.9, abs=1e-9)


def test_one_and_many_and_each_way_to_write_a_pose(arm):
    position, rotation = mujoco_pose(arm, np.asarray(arm.q0) + 0.1, "hand")
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, rotation.ravel())
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, position
    first = osik.inverse_kinematics(arm, {"hand": (position, rotation)})
    assert first.q.shape == (7,) and first.converged.shape == ()
    for pose in ((position, quaternion), matrix):
        np.testing.assert_allclose(osik.inverse_kinematics(arm, {"hand": pose}).q, first.q, atol=1e-6)
    many = osik.inverse_kinematics(arm, {"hand": (position[None], quaternion[None])})
    np.testing.assert_allclose(many.q, first.q[None], atol=1e-6)
    assert first.explain().startswith("found, ")


def test_same_key_same_answer(arm, rng):
    poses = {"hand": random_poses(arm, "hand", 16, rng)}
    a, b, other = (osik.inverse_kinematics(arm, poses, key=key) for key in (0, 0, 1))
    np.testing.assert_array_equal(a.q, b.q)
    assert (np.abs(np.asarray(a.q) - np.asarray(other.q)).max(1) > 1e-3).any()


def test_a_start_that_is_right_is_kept(arm, rng):
    starts = np.asarray(arm.q0) + 0.3 * rng.standard_normal(7)
    pose = mujoco_pose(arm, starts, "hand")
    found = osik.inverse_kinematics(arm, {"hand": pose}, q0=starts)
    np.testing.assert_allclose(found.q, starts, atol=1e-6)
    assert found.seed == 0


@pytest.mark.slow
def test_pure_form_is_differentiable_and_batched(arm, rng):
    """Against central differences of the same search from its own solution, and MuJoCo's Jacobian."""
    _, rotation = mujoco_pose(arm, np.asarray(arm.q0), "hand")

    def find(position, start):
        options: dict[str, Any] = dict(seeds=2, steps=24, closest=False)  # half the time to compile
        options |= dict(position_tolerance=1e-8, orientation_tolerance=1e-8)
        return osik.inverse_kinematics(arm, {"hand": (position, rotation)}, q0=start, **options).q

    @jax.jit
    @jax.vmap
    def both(position, start):
        q, backward = jax.vjp(lambda position: find(position, start), position)
        return q, jax.jacfwd(find)(position, start), jax.vmap(backward)(jnp.eye(arm.nq))[0]

    positions = jnp.asarray(mujoco_pose(arm, np.asarray(arm.q0), "hand")[0] + rng.uniform(-0.1, 0.1, (2, 3)))
    q, forward, reverse = both(positions, jnp.stack([arm.q0 + 0.1, arm.q0 - 0.1]))
    np.testing.assert_allclose(forward, reverse, atol=1e-10)
    step = 1e-4
    for axis in np.eye(3):
        ahead, behind = (both(positions + sign * step * axis, q)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(forward @ axis, (ahead - behind) / (2 * step), atol=1e-6)
    shortest = np.linalg.pinv(mujoco_jacobian(arm, q[0], "hand"))
    np.testing.assert_allclose(forward[0], shortest[:, :3], atol=1e-7)


def test_changing_numbers_compiles_nothing(arm, rng):
    position, rotation = random_poses(arm, "hand", 16, rng)
    osik.inverse_kinematics(arm, {"hand": (position, rotation)})
    with Compilations() as compiled:
        for key, tolerance, seeds in ((1, 1e-4, 8), (2, 1e-2, 32)):
            poses = {"hand": (position[::-1], rotation[::-1])}
            options: dict[str, Any] = dict(position_tolerance=tolerance, seeds=seeds, restarts=0, steps=30)
            osik.inverse_kinematics(arm, poses, key=key, **options)
    assert compiled.names == []


@pytest.mark.release
def test_tasks_on_an_arm_with_a_wall_and_preferences(arm):
    """Steps of the scheme: a barrier that a frame does not pass, a posture that fades out."""
    start = np.asarray(arm.q0)
    position, rotation = mujoco_pose(arm, start, "hand")
    position += np.array([0.05, 0.1, -0.1])
    tasks = {
        "hand": osik.FrameTask(arm, "hand", target=(position, rotation), gain=3.0),
        "posture": osik.PostureTask(arm, weight=1e-2, priority=2),
    }
    wall = osik.PositionBarrier(arm, "link4", upper=(np.inf, 0.02, np.inf))
    limits = (osik.ConfigurationLimit(arm), osik.VelocityLimit(arm), wall)
    found = osik.inverse_kinematics(arm, tasks, limits=limits, seeds=8, restarts=1)
    away, turned = errors_by_mujoco(arm, found.q[None], "hand", [position], [rotation])
    assert found.converged and away.max() <= POSITION and turned.max() <= ORIENTATION
    assert mujoco_pose(arm, found.q, "link4")[0][1] <= 0.02 + 1e-4
    assert_within_limits(arm, found.q)


class Ceiling(osik.Limit):
    """A class of one's own: the elbow stays below a height [m]."""

    sees_places = True
    height: jax.Array

    def has_rows(self, robot):
        return True

    def rows(self, robot, kinematics, q, dt):
        position, _ = kinematics.frame_pose(robot, "link4")
        jacobian = osik.frame_jacobian(robot, kinematics, "link4")
        return LimitRows(jacobian[2:3], jnp.array([-jnp.inf]), self.height - position[2:3])

    def sought(self, robot):
        return self


@pytest.mark.release
def test_poses_below_a_limit_of_ones_own_on_places(arm):
    position, _ = mujoco_pose(arm, arm.q0, "hand")
    free = osik.inverse_kinematics(arm, {"hand": position}, seeds=8)
    height = mujoco_pose(arm, free.q, "link4")[0][2] - 0.02
    found = osik.inverse_kinematics(arm, {"hand": position}, limits=[Ceiling(jnp.asarray(height))], seeds=8)
    assert free.converged and found.converged
    assert mujoco_pose(arm, found.q, "link4")[0][2] <= height + 1e-4
    np.testing.assert_allclose(mujoco_pose(arm, found.q, "hand")[0], position, atol=POSITION)


@pytest.mark.release
@pytest.mark.parametrize("hard", [False, True])
def test_floating_base_with_feet_held_and_balance(rng, hard):
    nao = osik.load_robot("nao")
    standing = osik.support_polygon(nao, nao.q0, ("l_sole", "r_sole"), margin=0.01)
    feet = {name: osik.FrameTask(nao, name, hard=hard, weight=10.0) for name in ("l_sole", "r_sole")}
    tasks = {
        **feet,
        "balance": osik.ComTask(nao, polygon=standing, weight=10.0),
        "hand": osik.FrameTask(nao, "l_gripper", rows="position"),
        "posture": osik.PostureTask(nao, weight=1e-3),
    }
    home = np.array(mujoco_pose(nao, nao.q0, "l_gripper")[0])
    goals = home + rng.uniform([0.0, -0.02, -0.05], [0.08, 0.05, 0.08], (8, 3))
    rotations = np.broadcast_to(np.eye(3), (8, 3, 3))
    found = osik.inverse_kinematics(nao, tasks, targets={"hand": (goals, rotations)}, seeds=8, restarts=1)
    assert np.asarray(found.converged).all()
    for q, goal in zip(np.asarray(found.q), goals, strict=True):
        assert np.linalg.norm(mujoco_pose(nao, q, "l_gripper")[0] - goal) <= POSITION
        for foot in feet:
            (p, r), (wanted, turn) = mujoco_pose(nao, q, foot), mujoco_pose(nao, nao.q0, foot)
            assert np.linalg.norm(p - wanted) <= POSITION and angle(r, turn) <= ORIENTATION
        com = osik.center_of_mass(nao, osik.forward_kinematics(nao, q))
        assert standing.distance(com[:2]) >= -POSITION
    joints = np.asarray(found.q)[:, 7:]
    assert (joints >= np.asarray(nao.position_lower)[6:]).all() and (joints <= np.asarray(nao.position_upper)[6:]).all()


@pytest.mark.release
def test_configurations_keep_clear_of_an_obstacle(arm):
    """A ball in the arm's way: the hand gets to its target around it, or the ball is named as what stops it."""
    start = np.asarray(arm.q0)
    position, rotation = mujoco_pose(arm, start, "hand")
    elbow = mujoco_pose(arm, start, "link4")[0]
    limits = (
        osik.ConfigurationLimit(arm),
        osik.CollisionAvoidanceLimit(
            arm,
            pairs=[("ball", "forearm"), ("ball", "tool")],
            shapes={
                "ball": osik.CollisionShape.sphere(0.05, elbow),
                "forearm": osik.CollisionShape.sphere(0.06, frame="link4"),
                "tool": osik.CollisionShape.sphere(0.04, frame="hand"),
            },
            q0_distance=-np.inf,
        ),
    )
    targets = np.stack([position, elbow + np.array([0.0, 0.0, 0.05])])
    rotations = np.stack([rotation, rotation])
    found = osik.inverse_kinematics(arm, {"hand": (targets, rotations)}, limits=limits, seeds=16, restarts=1)
    assert np.asarray(found.converged).tolist() == [True, False]
    away, _ = errors_by_mujoco(arm, found.q, "hand", targets, rotations)
    assert away[0] <= POSITION
    apart = np.linalg.norm(mujoco_pose(arm, np.asarray(found.q)[0], "link4")[0] - elbow) - 0.11
    assert apart >= 0.01 - 1e-4  # minimum_distance
    assert found.clearance is not None and np.asarray(found.clearance)[0] >= -1e-4
    assert "ball" in found.explain(1)


GIMBAL = (
    '<mujoco><compiler angle="radian"/><worldbody><body pos="{place}"><geom size=".02"/><body>'
    '<joint name="z" axis="0 0 1" range="-3 3"/><geom size=".02"/><body><joint name="y" axis="0 1 0" range="-3 3"/>'
    '<geom size=".02"/><body name="end"><joint name="x" axis="1 0 0" range="-3 3"/><geom size=".02"/></body></body>'
    "</body></body></worldbody></mujoco>"
)


@pytest.mark.variants(slow=["place0-float64"], release=["place1-float32"])
@pytest.mark.filterwarnings("ignore::osik_jax.OsikWarning")
@pytest.mark.parametrize("place, kind", [((0, 0, 0), "float64"), ((0.3, -2.0, 1.0), "float32")])
def test_joints_whose_axes_meet_in_the_frame(place, kind):
    """A chain without length: any position but its own is out of reach, and any orientation is found."""
    robot = osik.Robot.from_mjcf(GIMBAL.format(place=" ".join(map(str, place)))).astype(kind)
    turns = [np.array([0.5, 0.5, 0.5, 0.5]), np.array([np.cos(0.4), 0.0, np.sin(0.4), 0.0])]
    poses = np.tile(np.array(place, float), (2, 1)), np.stack(turns)

    def find(*poses):
        return osik.inverse_kinematics(robot, {"end": poses}, seeds=8)

    for found in (find(*poses), jax.jit(find)(*poses), osik.inverse_kinematics(robot, {"end": poses}, nearest=True)):
        assert np.asarray(found.converged).all() and not np.asarray(found.beyond_reach).any()
        for q, wanted in zip(np.asarray(found.q), turns, strict=True):
            own = mujoco_at(robot, q.astype(float)).body("end").xquat
            assert 2.0 * np.arccos(min(abs(own @ wanted), 1.0)) < ORIENTATION
    far = find(poses[0] + [0.0, 0.5, 0.0], poses[1])
    assert np.isfinite(far.q).all() and not np.asarray(far.converged).any()
    np.testing.assert_allclose(far.beyond_reach, 0.5, atol=200 * np.finfo(kind).eps)
    np.testing.assert_allclose(far.orientation_error, 0.0, atol=1e-3)


def test_one_target_of_tasks_is_one_answer(arm):
    """As the task's own target, and beside many of another task."""
    pose = np.array([0.4, 0.1, 0.4]), np.diag([1.0, -1.0, -1.0])
    tasks = {"tool": osik.FrameTask(arm, "hand", rows=(True,) * 5 + (False,)), "elbow": osik.ComTask(arm)}
    one = read_problem(arm, tasks, {"tool": pose, "elbow": np.array([0.1, 0.0, 0.3])}, None, None, arm.q0)
    assert not one.many and one.goals.targets["elbow"].shape == (1, 3)
    np.testing.assert_allclose(one.goals.targets["tool"][1][0], pose[1])
    both = read_problem(arm, tasks, {"elbow": np.full((4, 3), 0.1), "tool": pose}, None, None, arm.q0)
    assert both.many and both.goals.targets["tool"][1].shape == (4, 3, 3)
    message = r"targets\['tool'\]: got an array of shape \(2, 2\).*many have one more axis in front"
    refuses(ValueError, message, read_problem, arm, tasks, {"tool": np.zeros((2, 2))}, None, None, arm.q0)


def test_a_list_of_two_is_a_batch_of_two(arm):
    """Two matrices, or two positions, in a list are two targets; in a tuple they are a position and a rotation."""
    for one in (np.eye(4), np.array([0.4, 0.1, 0.4])):
        (found, rows, count), wanted = (
            read_poses(arm, {"hand": given}) for given in ([one, one], np.stack([one, one]))
        )
        assert (rows, count) == wanted[1:] and count == 2
        np.testing.assert_array_equal(found.position, wanted[0].position)
    refuses(ValueError, "a pair of shapes", read_poses, arm, {"hand": (np.zeros(3), np.zeros(3))})


class TestMistakes:
    @pytest.fixture
    def find(self, arm):
        return partial(osik.inverse_kinematics, arm)

    def test_names_and_kinds(self, arm, find):
        pose = np.eye(4)
        refuses(KeyError, "no frame 'hnad'; did you mean 'hand'", find, {"hnad": pose})
        refuses(TypeError, "dict from names of frames", find, [pose])
        refuses(ValueError, "nothing to reach", find, {})
        refuses(TypeError, "which is no pose", find, {"hand": "there"})
        refuses(ValueError, "no task says where", find, {"posture": osik.PostureTask(arm, weight=1.0)})
        hand = osik.FrameTask(arm, "hand")
        refuses(KeyError, "no task 'foot'", find, {"hand": hand}, targets={"foot": pose[None]})
        refuses(ValueError, "targets go with tasks", find, {"hand": pose}, targets={"hand": pose[None]})

    def test_numbers(self, find):
        position, rotation = np.zeros((3, 3)), np.tile(np.eye(3), (3, 1, 1))
        rotation[1] *= 1.1
        message = r"targets\['hand'\]: rotations that are none.*\[1\]"
        refuses(ValueError, message, find, {"hand": (position, rotation)})
        message = "numbers of targets differ: hand: 3, link4: 2"
        refuses(ValueError, message, find, {"hand": position, "link4": position[:2]})
        for wrong in (0.0, -1.0, np.nan, 1e-15):
            refuses(ValueError, "a tolerance is", find, {"hand": np.eye(4)}, position_tolerance=wrong)
        refuses(ValueError, "seeds is 0", find, {"hand": np.eye(4)}, seeds=0)
        refuses(ValueError, "have to be finite", find, {"hand": np.full((2, 3), np.nan)})
        refuses(TypeError, "all=True counts", jax.jit(lambda p: find({"hand": p}, all=True).q), jnp.zeros(3))


@pytest.mark.slow
def test_a_program_with_searches_can_be_exported(planar):
    def solve(position):
        return osik.inverse_kinematics(planar, {"tip": position}, seeds=8, steps=12).q

    position = jnp.array([0.5, 0.4, 0.0])
    exported = jax.export.export(jax.jit(solve))(position)
    found = jax.export.deserialize(exported.serialize()).call(position)
    np.testing.assert_allclose(mujoco_pose(planar, found, "tip")[0], position, atol=POSITION)

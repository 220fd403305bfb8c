"""Tasks on two frames and on axes, against central differences, mink and numbers worked out by hand."""

import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import mink
import numpy as np
import pytest
from model_files import mjcf
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import assert_every_number_counts, assert_finite_gradients, assert_jacobians, at_each, rows_of_each

import osik_jax as osik
from osik_jax.tasks._bases import Frames

SEED = 11
MASK = (True, False, True, True, True, False)
HEAD = mjcf("head")


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(mjcf("head_and_arm"))


@pytest.fixture(scope="module")
def head():
    return osik.Robot.from_mjcf(HEAD)


@pytest.fixture(scope="module")
def tasks(robot):
    """Every kind and option, with numbers that some tests replace: one compiled program serves them all."""
    rng = np.random.default_rng(SEED)
    pose = _random_pose(rng)
    axis, point, direction = rng.normal(size=(3, 3))
    gain = osik.AdaptiveGain(10.0, 1.0, 2.0)
    return {
        "root": osik.RelativeFrameTask(robot, "hand", "camera", target=pose),
        "own": osik.RelativeFrameTask(robot, "hand", "camera", target=pose, axes="frame"),
        "mask": osik.RelativeFrameTask(robot, "hand", "camera", target=pose, rows=MASK),
        "position": osik.RelativeFrameTask(robot, "hand", "trunk", target=pose, rows="position"),
        "orientation": osik.RelativeFrameTask(robot, "forearm", "hand", rows="orientation", axes="frame"),
        "bounds": osik.RelativeFrameTask(robot, "hand", "camera", target=pose, lower=-0.1, upper=0.2, axes="frame"),
        "look": osik.LookAtTask(robot, "camera", axis=axis, target=point, gain=gain),
        "look at hand": osik.LookAtTask(robot, "camera", target_frame="hand", target=0.1 * point),
        "look cone": osik.LookAtTask(robot, "camera", axis=axis, target=point, half_angle=0.1, gain=gain),
        "hand in view": osik.LookAtTask(robot, "camera", target_frame="hand", half_angle=0.4),
        "align": osik.AxisAlignTask(robot, "hand", axis=axis, target=direction),
        "align with head": osik.AxisAlignTask(robot, "hand", axis=-axis, target=direction, target_frame="head"),
        "align cone": osik.AxisAlignTask(robot, "hand", axis=axis, target=direction, half_angle=0.4),
    }


@pytest.fixture(scope="module")
def configurations(robot):
    rng = np.random.default_rng(SEED)
    speeds = jnp.asarray(rng.uniform(-1.5, 1.5, (8, robot.nv)))
    return jax.jit(jax.vmap(lambda v: osik.integrate(robot, robot.q0, v)))(speeds)


@pytest.fixture(scope="module")
def found(robot, tasks, configurations):
    return at_each(robot, tasks, configurations)


@pytest.fixture(scope="module")
def q(configurations):
    return configurations[0]


def _random_pose(rng):
    return 0.3 * rng.normal(size=3), Rotation.from_quat(rng.normal(size=4)).as_matrix()


@jax.jit
def _alone(task, position, rotation):
    """The rows where the frame's twist is the velocity."""
    return task.rows_at(Frames(position[None], rotation[None], jnp.eye(6)[None]))


class TestJacobians:
    def test_against_central_differences(self, found):
        assert_jacobians(*found)

    def test_relative_masks_pick_rows_of_the_whole(self, found):
        rows, _ = found
        for field in ("error", "jacobian", "lower", "upper", "weight"):
            expected = np.asarray(getattr(rows["root"], field))[:, np.array(MASK)]
            np.testing.assert_array_equal(getattr(rows["mask"], field), expected)

    def test_moving_both_frames_as_one_changes_nothing(self, found, tasks):
        for name, row in found[0].items():
            if isinstance(tasks[name], osik.RelativeFrameTask) or len(tasks[name].frames) == 2:
                np.testing.assert_allclose(row.jacobian[..., :6], 0.0, atol=1e-13, err_msg=name)
                assert np.abs(row.jacobian[..., 6:]).max() > 0.1


class TestRelativeErrors:
    def test_against_scipy(self, robot, tasks, q):
        kinematics = jax.jit(osik.forward_kinematics)(robot, q)
        (p, R), (pr, Rr) = (map(np.asarray, kinematics.frame_pose(robot, name)) for name in ("hand", "camera"))
        p, R = Rr.T @ (p - pr), Rr.T @ R
        goal, turn = map(np.asarray, tasks["root"].target)
        rows = rows_of_each(robot, tasks, q)
        outside = np.concatenate([p - goal, Rotation.from_matrix(R @ turn.T).as_rotvec()])
        own = np.concatenate([R.T @ (p - goal), Rotation.from_matrix(turn.T @ R).as_rotvec()])
        np.testing.assert_allclose(rows["root"].error, outside, atol=1e-13)
        np.testing.assert_allclose(rows["root"].lower, -10.0 * outside, atol=1e-12)
        np.testing.assert_allclose(rows["own"].error, own, atol=1e-13)
        np.testing.assert_allclose(rows["bounds"].error, own, atol=1e-13)
        np.testing.assert_allclose(rows["bounds"].upper, 10.0 * (0.2 - own), atol=1e-12)

    def test_against_mink(self, robot, tasks, q):
        """Orientation in own axes is mink's angular part; position its linear part where the orientation is right."""
        p, R = tasks["own"].target
        configuration = mink.Configuration(robot.mj_model, q=np.asarray(q))
        theirs = mink.RelativeFrameTask("hand", "body", "camera", "site", position_cost=1.0, orientation_cost=1.0)
        theirs.set_target(mink.SE3.from_rotation_and_translation(mink.SO3.from_matrix(np.asarray(R)), np.asarray(p)))
        rows = rows_of_each(robot, tasks, q)["own"]
        np.testing.assert_allclose(rows.error[3:], theirs.compute_error(configuration)[3:], atol=1e-10)
        np.testing.assert_allclose(rows.jacobian[3:], theirs.compute_jacobian(configuration)[3:], atol=1e-9)
        now = configuration.get_transform("hand", "body", "camera", "site").rotation()
        theirs.set_target(mink.SE3.from_rotation_and_translation(now, np.asarray(p)))
        turned = tasks | {"own": tasks["own"].replace(target=(p, now.as_matrix()))}
        moved = rows_of_each(robot, turned, q)["own"]
        np.testing.assert_allclose(moved.error, theirs.compute_error(configuration), atol=1e-10)


class TestPointingErrors:
    def test_against_mink(self, robot, tasks, q):
        """mink's error is the chord from axis to direction, of length ``2 sin(angle / 2)``; so are its rates."""
        configuration = mink.Configuration(robot.mj_model, q=np.asarray(q))
        look = mink.LookAtTask("camera", "site", axis=tasks["look"].axis)
        look.set_target(tasks["look"].target)
        align = mink.AxisAlignTask("hand", "body", axis=tasks["align"].axis)
        align.set_target(tasks["align"].target)
        rows = rows_of_each(robot, tasks, q)
        for name, theirs in (("look", look), ("align", align)):
            chord, jacobian = theirs.compute_error(configuration), theirs.compute_jacobian(configuration)
            angle = 2.0 * math.asin(np.linalg.norm(chord) / 2.0)
            rate = chord @ jacobian / math.sin(angle)
            ours, cone = rows[name], rows[f"{name} cone"]
            np.testing.assert_allclose(np.linalg.norm(ours.error), angle, rtol=1e-12)
            np.testing.assert_allclose(ours.error @ ours.jacobian / angle, rate, atol=1e-12)
            np.testing.assert_allclose(cone.error, [angle], rtol=1e-12)
            np.testing.assert_allclose(cone.jacobian, rate[None], atol=1e-12)

    def test_by_hand(self, robot):
        """Looking along x, at a point 2 m away, 0.3 rad to the left: the turn about z [rad], the way along y [m]."""
        point = 2.0 * np.array([math.cos(0.3), math.sin(0.3), 0.0])
        options: dict[str, Any] = dict(axis=(1.0, 0.0, 0.0), target=point, gain=2.0)
        look = _alone(osik.LookAtTask(robot, "hand", **options), jnp.zeros(3), jnp.eye(3))
        cone = _alone(osik.LookAtTask(robot, "hand", half_angle=0.1, **options), jnp.zeros(3), jnp.eye(3))
        about_z = look.jacobian[:, 5]
        np.testing.assert_allclose(np.linalg.norm(about_z), 1.0, rtol=1e-15)
        np.testing.assert_allclose(look.error, -0.3 * about_z, atol=1e-15)
        np.testing.assert_allclose(look.lower, 0.6 * about_z, atol=1e-15)
        np.testing.assert_allclose(cone.error, [0.3], rtol=1e-15)
        along = [0.5 * math.sin(0.3), -0.5 * math.cos(0.3), 0.0]  # across the line of sight, over its length
        np.testing.assert_allclose(cone.jacobian, [[*along, 0.0, 0.0, -1.0]], atol=1e-15)
        np.testing.assert_allclose(cone.upper, [2.0 * (0.1 - 0.3)], rtol=1e-14)
        np.testing.assert_array_equal(cone.lower, [-np.inf])

    def test_lengths_do_not_matter(self, robot):
        task = osik.AxisAlignTask(robot, "hand", axis=(1.0, 2.0, 3.0), target=(3.0, -1.0, 2.0))
        longer = task.replace(axis=[5.0, 10.0, 15.0], target=[0.3, -0.1, 0.2])
        a, b = (_alone(given, jnp.zeros(3), jnp.eye(3)) for given in (task, longer))
        for ours, theirs in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
            np.testing.assert_allclose(ours, theirs, atol=1e-14)

    def test_a_small_cone_is_rounded_off(self, robot):
        """The angle 0.004 rad counts as 0.004^2 / 0.02 + 0.005, so does the bound of 0.005 rad."""
        target = Rotation.from_rotvec([0.0, 0.0, 0.004]).apply([1.0, 0.0, 0.0])
        task = osik.AxisAlignTask(robot, "hand", axis=(1.0, 0.0, 0.0), target=target, half_angle=0.005, gain=1.0)
        rows = _alone(task, jnp.zeros(3), jnp.eye(3))
        np.testing.assert_allclose(rows.error, [0.0058], rtol=1e-12)
        np.testing.assert_allclose(rows.jacobian, [[0.0, 0.0, 0.0, 0.0, 0.0, -0.4]], atol=1e-12)
        np.testing.assert_allclose(rows.upper, [0.00625 - 0.0058], rtol=1e-10)

    def test_too_near_to_look_at(self, robot):
        """From 1 mm on there is nothing to do, right up to the point itself."""
        for distance, nothing in ((0.0, True), (9e-4, True), (1.1e-3, False)):
            task = osik.LookAtTask(robot, "hand", target=np.array([distance, 0.0, 0.0]), gain=2.0)
            rows = _alone(task, jnp.zeros(3), jnp.eye(3))
            assert nothing == (not np.any(rows.jacobian) and not np.any(rows.lower))
            np.testing.assert_allclose(np.linalg.norm(rows.error), 0.0 if nothing else math.pi / 2, rtol=1e-12)


def test_feed_forward_is_the_rate_of_the_target(robot, tasks, q, rng):
    """Robot and target both move: the error's rate is ``jacobian @ v - feed-forward``, by central differences."""
    h, v, twist = 1e-5, rng.normal(size=robot.nv), rng.normal(size=6)
    step = jax.jit(osik.integrate)

    def velocity(task):
        return twist if isinstance(task, osik.RelativeFrameTask) else twist[3:]

    def target(task, t):
        turn = Rotation.from_rotvec(t * twist[3:]).as_matrix()
        if isinstance(task, osik.RelativeFrameTask):
            return task.target[0] + t * twist[:3], turn @ task.target[1]
        return task.target + t * twist[3:] if isinstance(task, osik.LookAtTask) else turn @ task.target

    def moved(t):
        new = {name: task.replace(target=target(task, t)) for name, task in tasks.items()}
        return rows_of_each(robot, new, step(robot, q, jnp.asarray(t * v)))

    ahead, behind = moved(h), moved(-h)
    still = rows_of_each(robot, tasks, q)
    moving = {name: task.replace(target_velocity=velocity(task)) for name, task in tasks.items()}
    for name, row in rows_of_each(robot, moving, q).items():
        feedforward = row.upper - still[name].upper
        assert np.abs(feedforward).max() > 0.1
        expected = (ahead[name].error - behind[name].error) / (2 * h)
        np.testing.assert_allclose(row.jacobian @ v - feedforward, expected, atol=3e-8, err_msg=name)


class TestGradients:
    @pytest.mark.slow
    @pytest.mark.variants(release=["True"])
    @pytest.mark.parametrize("x64", [True, False])
    def test_finite_wherever_an_angle_has_none(self, x64):
        """On the axis, opposite to it, next to both, too near, and where the basis across the axis jumps."""
        turns = [0.0, 1e-20, 1e-12, 1e-7, 1e-3, 2.0, *(math.pi - e for e in (1e-3, 1e-7, 1e-12, 0.0))]
        points = np.array([*((math.cos(t), 0.0, math.sin(t)) for t in turns), (-1, 0, 0), (-1e-9, 0, 0), (0, 0, 0)])
        with jax.enable_x64(x64):
            head = osik.Robot.from_mjcf(HEAD)
            points = jnp.asarray(points, head.q0.dtype)
            options: dict[str, Any] = dict(axis=(1.0, 0.0, 0.0), gain=osik.AdaptiveGain(10.0, 1.0, 2.0))
            tasks = {
                "look": osik.LookAtTask(head, "head", **options),
                "field": osik.LookAtTask(head, "head", half_angle=0.3, **options),
                "align": osik.AxisAlignTask(head, "head", **options),
            }

            def aimed(point):
                direction = jnp.where((point == 0.0).all(), 1.0, point)
                targets = {"look": point, "field": point, "align": direction}
                return {name: task.replace(target=targets[name]) for name, task in tasks.items()}

            def rows(tasks, position, rotation):
                jacobian = jnp.eye(6, dtype=position.dtype)[None]
                frames = Frames(position[None], rotation[None], jacobian)
                return {name: task.rows_at(frames) for name, task in tasks.items()}

            batch = jax.jit(jax.vmap(aimed))(points)
            assert_finite_gradients(rows, batch, jnp.zeros_like(points), jnp.tile(jnp.eye(3), (len(points), 1, 1)))


@jax.jit
def _turned(task, direction):
    """Angles over 100 steps of 0.02 s of a body that turns as the task asks, from no turn at all."""

    def one_step(rotation, _):
        rows = task.replace(target=direction).rows_at(
            Frames(jnp.zeros((1, 3)), rotation[None], jnp.eye(6)[None, :, 3:])
        )
        spin = 0.02 * jnp.linalg.pinv(rows.jacobian) @ rows.lower
        return jaxlie.SO3.exp(spin).as_matrix() @ rotation, jnp.linalg.norm(rows.error)

    return jax.lax.scan(one_step, jnp.eye(3), length=100)[1]


class TestClosedLoop:
    @pytest.mark.parametrize(
        ("direction", "angle"),
        [
            ((-1.0, 0.0, 0.0), math.pi),
            ((-1.0, 1e-12, 0.0), math.pi),
            ((-1.0, 1e-3, 1e-2), math.pi - math.atan(math.hypot(1e-3, 1e-2))),
            ((0.0, 0.0, 1.0), math.pi / 2),
            ((1.0, 1.0, 0.0), math.pi / 4),
            ((1.0, 0.0, 0.0), 0.0),
        ],
    )
    def test_the_angle_decays_from_anywhere(self, robot, direction, angle):
        """Right behind and nearly so too: it falls by ``1 - gain dt`` a step, along the shortest way."""
        task = osik.AxisAlignTask(robot, "hand", axis=(1.0, 0.0, 0.0), gain=5.0)
        np.testing.assert_allclose(_turned(task, jnp.array(direction)), angle * 0.9 ** np.arange(100), atol=1e-9)

    @pytest.mark.variants(slow=["scheme0"], release=["scheme1"])
    @pytest.mark.parametrize("scheme", [osik.WeightedQP(), osik.HierarchicalQP()])
    def test_the_visual_field_is_kept(self, head, scheme):
        """The posture turns the head away by 1.5 and 0.7 rad; the point stays within 0.4 rad of its axis."""
        ahead, behind = [1.0, 0.0, 0.1], [-1.0, 0.01, 0.1]
        field = osik.LookAtTask(head, "head", axis=(1, 0, 0), target=ahead, half_angle=0.4, weight=1e6)
        posture = osik.PostureTask(head, target=[1.5, 0.7], gain=5.0, priority=2, weight=1.0)

        def run(field, posture):
            tasks = {"field": field, "posture": posture}
            out = osik.rollout(head, head.q0, tasks, scheme=scheme, dt=0.01, steps=200, limits=osik.no_limits)
            return out.solution.error["field"][:, 0], out.q[-1]

        angle, end = run(field, posture)
        assert angle.max() <= 0.4 + 1e-4
        assert angle[-1] > 0.4 - 1e-4
        np.testing.assert_allclose(np.cos(end[0]) * np.cos(end[1]), math.cos(0.4), atol=1e-4)
        angle, _ = run(field.replace(target=behind, gain=5.0), posture.replace(target=head.q0, weight=1e-9))
        assert angle[0] > 3.1
        assert (np.diff(angle) < 1e-12).all()
        np.testing.assert_allclose(angle[-1], 0.4, atol=2e-4)

    def test_hand_and_head_move_as_one(self, robot):
        """The hand comes to a place in the camera's axes and stays there while the head turns."""
        together = osik.RelativeFrameTask(robot, "hand", "camera", rows="position")
        home = jax.jit(osik.forward_kinematics)(robot, robot.q0.at[-2].set(1.0))
        (p, _), (pr, Rr) = (home.frame_pose(robot, name) for name in ("hand", "camera"))
        tasks = {
            "together": together.replace(target=(Rr.T @ (p - pr), np.eye(3))),
            "turn": osik.PostureTask(robot, joints=("pan", "tilt"), target=robot.q0 + 0.3, gain=2.0, priority=2),
        }
        run = osik.rollout(
            robot, robot.q0.at[-2].set(0.6), tasks, scheme=osik.NullSpace(), dt=0.01, steps=150, limits=osik.no_limits
        )
        apart = np.linalg.norm(run.solution.error["together"], axis=1)
        assert apart[0] > 0.05
        assert apart[-1] < 1e-4
        assert np.abs(run.q[-1, 7:9] - run.q[0, 7:9]).min() > 0.25


class TestBatchesAndCompilation:
    def test_every_number_counts_and_compiles_nothing(self, robot, tasks, q):
        moving = {k: task.replace(target_velocity=0.1) for k, task in tasks.items()}
        assert_every_number_counts(robot, moving, q, idle=("['mask']", "['position']", "['orientation']"))

    @pytest.mark.slow
    def test_what_is_no_number_is_said(self, head):
        """A lane spoiled through any leaf stands still and has the status; its neighbours do not notice."""
        task = osik.LookAtTask(head, "head", axis=(1.0, 0.0, 0.0), target=(0.5, 1.0, 0.1), half_angle=0.2)
        spoiled = [task.replace(target=jnp.array(1.0))]
        for name, value in (("axis", np.inf), ("axis", np.nan), ("target", np.inf), ("half_angle", np.nan)):
            leaf = jnp.full_like(getattr(task, name), value)
            spoiled.append(eqx.tree_at(lambda t, name=name: getattr(t, name), task, leaf))

        def solve(task):
            return osik.solve(head, head.q0, {"look": task}, scheme=osik.WeightedQP(), limits=osik.no_limits)

        solutions = jax.jit(jax.vmap(solve))(osik.stack(spoiled))
        np.testing.assert_array_equal(solutions.status == osik.Status.NUMERICAL_ERROR, [False, True, True, True, True])
        assert np.abs(solutions.velocity[0]).max() > 0.1
        np.testing.assert_array_equal(solutions.velocity[1:], np.zeros((4, 2)))

    def test_replace(self, tasks):
        look = tasks["look cone"]
        assert set(look.replaceable) == {"weight", "gain", "axis", "target", "target_velocity", "half_angle"}
        assert look.replace(half_angle=0.5).half_angle == 0.5
        np.testing.assert_array_equal(tasks["root"].replace(target=np.eye(4)).target[1], np.eye(3))
        refuses(TypeError, "no 'root' to replace", tasks["root"].replace, root="trunk")


class TestMistakes:
    @pytest.mark.parametrize(
        ("frames", "options", "error", "message"),
        [
            (("hands", "camera"), {}, KeyError, "did you mean 'hand'"),
            (("hand", "camra"), {}, KeyError, "did you mean 'camera'"),
            (("hand", "hand"), {}, ValueError, "both 'hand'"),
            (("hand", "camera"), dict(axes="world"), ValueError, "'root', 'frame'"),
        ],
    )
    def test_relative(self, robot, frames, options, error, message):
        refuses(error, message, osik.RelativeFrameTask, robot, *frames, **options)

    @pytest.mark.parametrize("kind", [osik.LookAtTask, osik.AxisAlignTask])
    @pytest.mark.parametrize(
        ("options", "error", "message"),
        [
            (dict(axis=(0.0, 0.0, 0.0)), ValueError, "axis is .* not 0"),
            (dict(axis=(1.0, 0.0)), ValueError, r"axis has shape \(2,\)"),
            (dict(half_angle=0.0), ValueError, "half_angle is 0.0"),
            (dict(half_angle=4.0), ValueError, "up to pi"),
            (dict(target_frame="hands"), KeyError, "did you mean 'hand'"),
            (dict(target_frame="camera"), ValueError, "both 'camera'"),
        ],
    )
    def test_pointing(self, robot, kind, options, error, message):
        refuses(error, message, kind, robot, "camera", **options)

    def test_a_direction_of_length_zero(self, robot):
        refuses(ValueError, "target is .* not 0", osik.AxisAlignTask, robot, "hand", target=(0.0, 0.0, 0.0))
        refuses(ValueError, "axis is .* not 0", osik.LookAtTask(robot, "camera").replace, axis=(0.0, 0.0, 0.0))

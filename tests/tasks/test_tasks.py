"""What holds for any task: Jacobians, feed-forward, gradients, batches, tasks of one's own, rows of all together."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from every_class import all_limits, all_tasks
from jaxtyping import Array, Float
from refusals import refuses
from scipy.spatial.transform import Rotation
from task_checks import anywhere, kinematics_at, moved_by, random_pose, rows_and_differences, rows_of_each, square

import osik_jax as osik
from osik_jax.tasks._rows import rows_of

MASK = (True, True, False, True, False, True)
SEED = 7


def _all_tasks(robot, frame, subtree, rng):
    pose = random_pose(rng, np.asarray(kinematics_at(robot, robot.q0).frame_pose(robot, frame)[0]))
    some = robot.joint_names[1:4]
    tasks = {
        "world": osik.FrameTask(robot, frame, target=pose),
        "own": osik.FrameTask(robot, frame, target=pose, axes="frame"),
        "world mask": osik.FrameTask(robot, frame, target=pose, rows=MASK),
        "own mask": osik.FrameTask(robot, frame, target=pose, rows=MASK, axes="frame"),
        "position": osik.FrameTask(robot, frame, target=pose, rows="position"),
        "orientation": osik.FrameTask(robot, frame, target=pose, rows="orientation", axes="frame"),
        "frame bounds": osik.FrameTask(robot, frame, target=pose, axes="frame", lower=-0.1, upper=[0.1] * 6),
        "com": osik.ComTask(robot),
        "com zy, subtree": osik.ComTask(robot, axes="zy", subtree=subtree, target=[0.1, 0.2, 0.3]),
        "com bounds": osik.ComTask(robot, axes="xy", lower=[-0.1, 0.0]),
        "com polygon": osik.ComTask(robot, polygon=square()),
        "posture": osik.PostureTask(robot, weight=1.0),
        "some joints": osik.PostureTask(robot, joints=some),
        "joint bounds": osik.PostureTask(robot, joints=some, lower=-0.1, upper=0.1),
    }
    if robot.floating_base:
        base = next(n for n, t in zip(robot.tree.joint_names, robot.tree.joint_types, strict=True) if t == 0)
        q = anywhere(robot, rng)
        tasks["base"] = osik.PostureTask(robot, joints=(base, some[0]), target=q)
    return tasks


def _cases(nao, arm):
    """A robot on a floating base with every task, and one on a fixed base with one of each kind."""
    rng = np.random.default_rng(SEED)
    of_arm = _all_tasks(arm, "hand", None, rng)
    some = {name: of_arm[name] for name in ("own", "frame bounds", "com", "com polygon", "posture", "joint bounds")}
    return (nao, _all_tasks(nao, "r_wrist", "r_wrist", rng), rng), (arm, some, rng)


class TestJacobians:
    def test_every_task_against_central_differences(self, nao, arm):
        for robot, tasks, rng in _cases(nao, arm):
            for _ in range(3):
                q = jnp.asarray(anywhere(robot, rng))
                rows, expected = rows_and_differences(robot, tasks, q)
                for name, row in rows.items():
                    scale = max(1.0, np.abs(expected[name]).max())
                    np.testing.assert_allclose(row.jacobian, expected[name], atol=1e-7 * scale, rtol=0, err_msg=name)


class TestFeedForward:
    def test_the_rate_of_every_error(self, nao, rng):
        """Robot and target both move: the error's rate is ``jacobian @ v - feed-forward``, by central differences."""
        robot, h = nao, 1e-5
        q, v = jnp.asarray(anywhere(robot, rng)), jnp.asarray(rng.normal(size=robot.nv))
        p, R = random_pose(rng, np.zeros(3))
        twist, drift = rng.normal(size=6), rng.normal(size=3)
        base = robot.tree.joint_names[0]
        target, rate = jnp.asarray(anywhere(robot, rng)), jnp.asarray(rng.normal(size=robot.nv))
        tasks = {
            "world": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist),
            "own": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist, axes="frame"),
            "se3": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist, error="se3"),
            "bounds": osik.FrameTask(robot, "r_wrist", target=(p, R), target_velocity=twist, lower=-0.1, upper=0.1),
            "com": osik.ComTask(robot, target=p, target_velocity=drift),
            "posture": osik.PostureTask(robot, joints=(base, "*"), target=target, target_velocity=rate),
        }

        def moved(t):
            pose = (p + t * twist[:3], Rotation.from_rotvec(t * twist[3:]).as_matrix() @ R)
            new = {k: tasks[k].replace(target=pose) for k in ("world", "own", "se3", "bounds")}
            new["com"] = tasks["com"].replace(target=p + t * drift)
            new["posture"] = tasks["posture"].replace(target=moved_by(robot, target, t * rate))
            return rows_of_each(robot, new, moved_by(robot, q, t * v))

        ahead, behind = moved(h), moved(-h)
        still = rows_of_each(robot, {name: task.replace(target_velocity=0.0) for name, task in tasks.items()}, q)
        for name, row in rows_of_each(robot, tasks, q).items():
            feedforward = row.upper - still[name].upper
            np.testing.assert_allclose(row.lower - still[name].lower, feedforward, atol=1e-13, err_msg=name)
            expected = (ahead[name].error - behind[name].error) / (2 * h)
            np.testing.assert_allclose(row.jacobian @ v - feedforward, expected, atol=2e-8, err_msg=name)


def test_tasks_and_limits_of_a_float32_robot_are_float32(arm):
    single = arm.astype("float32")
    for path, leaf in jax.tree_util.tree_leaves_with_path((all_tasks(single), all_limits(single))):
        assert leaf.dtype == jnp.float32, jax.tree_util.keystr(path)


class TestBatchesAndCompilation:
    def test_a_batch_of_robots(self, arm):
        """Tasks and limits made and used inside vmap, for arms of three sizes: the rows of the arms one by one."""

        def at(scale):
            position = arm.body_position * scale
            return dataclasses.replace(arm, body_position=position)

        def rows(scale):
            robot = at(scale)
            tasks = {
                "home": osik.FrameTask(robot, "hand"),
                "frame": osik.FrameTask(robot, "hand", target=(jnp.full(3, 0.1), jnp.eye(3)), axes="frame"),
                "com": osik.ComTask(robot, axes="xy", lower=0.1),
                "posture": osik.PostureTask(robot, target=robot.q0 + 0.1, weight=1.0),
            }
            limits = (osik.ConfigurationLimit(robot), osik.VelocityLimit(robot))
            return rows_of_each(robot, tasks, robot.q0), osik.limit_box(robot, robot.q0, limits, 0.01)

        scales = jnp.array([0.5, 1.0, 1.5])
        batch, _ = jax.jit(jax.vmap(rows))(scales)
        np.testing.assert_allclose(batch["home"].error, 0.0, atol=1e-14)
        positions = [kinematics_at(at(scale), arm.q0).frame_pose(arm, "hand") for scale in scales]
        expected = [R.T @ (p - 0.1) for p, R in positions]
        np.testing.assert_allclose(batch["frame"].error[:, :3], expected, atol=1e-13)
        assert np.linalg.norm(positions[0][0] - positions[2][0]) > 0.1

    def test_a_replaced_task_is_another_one(self, arm):
        task = osik.PostureTask(arm, gain=2.0, weight=1.0)
        assert task.replace(gain=3.0).gain == 3.0
        assert task.gain == 2.0
        assert task.replace() is task


class HeightTask(osik.Task):
    """A user's own task: a body's height."""

    body: str = eqx.field(static=True)
    height: Float[Array, ""]

    def rows(self, robot, kinematics, q):
        p, _ = kinematics.frame_pose(robot, self.body)
        jacobian = osik.frame_jacobian(robot, kinematics, self.body)[2:3]
        return osik.TaskRows.of(p[2:] - self.height, jacobian, gain=self.gain, weight=self.weight[None])


def test_an_own_task(arm):
    task = HeightTask("hand", jnp.asarray(1.0))
    assert (task.priority, float(task.weight), task.gain) == (1, 1.0, 10.0)
    assert HeightTask("hand", jnp.asarray(1.0), priority=2).priority == 2
    new = task.replace(height=2, gain=3)
    assert set(task.replaceable) == {"height", "weight", "gain"}
    theirs = osik.FrameTask(arm, "hand", target=([0, 0, 2.0], np.eye(3)), rows=[i == 2 for i in range(6)], gain=3)
    rows = rows_of_each(arm, {"own": new, "frame": theirs}, arm.q0)
    for name in ("error", "jacobian", "lower", "upper", "weight", "pull"):
        ours, expected = (getattr(rows[task], name) for task in ("own", "frame"))
        np.testing.assert_allclose(ours, expected, atol=1e-15)
    pull, jacobian = (np.linalg.norm(getattr(rows["own"], name)) for name in ("pull", "jacobian"))
    assert float(rows["own"].curvature) == pytest.approx(pull * jacobian, rel=1e-12)
    refuses(TypeError, r"HeightTask has no 'body' to replace; it has: .*height", task.replace, body="link1")


class Height(osik.Task):
    """The same rows, made in the ways that ``form`` names."""

    form: str = eqx.field(static=True, default="one array")

    def rows(self, robot, kinematics, q):
        rows = osik.FrameTask(robot, "hand", target=([0, 0, 1.0], np.eye(3)), rows="position").rows(
            robot, kinematics, q
        )
        upper = rows.lower if self.form in ("one array", "said to be an interval") else rows.lower + 0.0
        make = partial(osik.TaskRows, rows.error, rows.jacobian, rows.lower, upper, rows.weight)
        return make(is_equality=FORMS[self.form]) if self.form.startswith("said") else make()


FORMS = {"one array": True, "two arrays": False, "said to be an equality": True, "said to be an interval": False}


@pytest.mark.variants(slow=["NullSpace"], release=["WeightedQP", "HierarchicalQP"])
@pytest.mark.parametrize(
    "scheme", [osik.WeightedQP(), osik.HierarchicalQP(), osik.NullSpace()], ids=lambda s: type(s).__name__
)
def test_rows_are_equalities_where_they_say_so_or_have_one_array_as_both_bounds(arm, scheme):
    limits = (osik.VelocityLimit(arm, velocity=np.ones(7)),)
    velocities = []
    for form, is_equality in FORMS.items():
        task = Height(form=form)
        rows = rows_of_each(arm, {"hand": task}, arm.q0)["hand"]
        assert rows.is_equality == jax.jit(lambda a: a)(rows).is_equality == is_equality, form
        answer = osik.solve(arm, arm.q0, {"hand": task}, scheme=scheme, limits=limits)
        assert answer.status == osik.Status.SOLVED, form
        velocities.append(answer.velocity)
    assert np.max(np.abs(velocities[0])) > 0.5
    for velocity in velocities[1:]:
        np.testing.assert_allclose(velocity, velocities[0], atol=1e-8)


class TestMistakes:
    def test_unknown_names(self, nao):
        refuses(KeyError, "no frame 'nothing'", osik.ComTask, nao, subtree="nothing")
        refuses(KeyError, r"no joint 'Knee\*'.*HeadYaw", osik.PostureTask, nao, joints=("Knee*",))

    def test_replace(self, arm):
        task = osik.PostureTask(arm, lower=-1.0)
        refuses(TypeError, r"no 'target' to replace; it has: .*lower, upper", task.replace, target=arm.q0)
        with pytest.raises(ValueError, match=r"target has shape \(3,\), expected \(7,\)"):
            osik.PostureTask(arm, weight=1.0).replace(target=np.zeros(3))


@pytest.mark.slow
def test_rows_of_all_tasks_together_are_those_of_each(nao):
    """Frames of several manners, one alone in its own, a subclass that goes its own way, and pairs of other kinds."""
    robot = nao

    class Doubled(osik.FrameTask):
        __init__ = osik.FrameTask.__init__

        def rows(self, robot, kinematics, q):
            own = super().rows(robot, kinematics, q)
            return eqx.tree_at(lambda r: r.jacobian, own, 2.0 * own.jacobian)

    tasks = {
        "left": osik.FrameTask(robot, "l_sole", weight=2.0, gain=3.0),
        "right": osik.FrameTask(robot, "r_sole", priority=2, target_velocity=0.1 * np.arange(6.0)),
        "hand": osik.FrameTask(robot, "l_gripper", rows="position"),
        "other hand": osik.FrameTask(robot, "r_gripper", rows="position", gain=osik.AdaptiveGain(5.0, 1.0, 2.0)),
        "head": osik.FrameTask(robot, "Head", axes="frame", rows=(True, False, True, False, True, True)),
        "box": osik.FrameTask(robot, "l_gripper", lower=-0.1, upper=[0.1, np.inf, 0.2, 1.0, 1.0, 1.0]),
        "doubled": Doubled(robot, "torso"),
        "com": osik.ComTask(robot),
        "posture": osik.PostureTask(robot, weight=1.0),
    }
    for k, point in enumerate(np.eye(3)[:2]):
        tasks |= {
            f"relative {k}": osik.RelativeFrameTask(robot, "l_gripper", "Head", gain=1.0 + k),
            f"look {k}": osik.LookAtTask(robot, "Head", target=point),
            f"cone {k}": osik.LookAtTask(robot, "Head", target=point, half_angle=0.1 + k),
            f"axis {k}": osik.AxisAlignTask(robot, "r_gripper", target=point, target_velocity=0.1 * k),
            f"beside {k}": osik.AxisAlignTask(robot, "r_gripper", target=point, target_frame="torso"),
        }
    q = moved_by(robot, robot.q0, 0.1 * np.cos(np.arange(robot.nv)))
    kinds = []

    @jax.jit
    def both(q):
        kinematics = osik.forward_kinematics(robot, q)
        together = rows_of(robot, kinematics, q, tasks)
        each = {name: task.rows(robot, kinematics, q) for name, task in tasks.items()}
        kinds.extend({name: own.is_equality for name, own in rows.items()} for rows in (together, each))
        return together, each

    together, each = both(q)
    assert [list(kind) for kind in kinds] == 2 * [list(tasks)]
    assert kinds[0] == kinds[1] == {name: name != "box" and "cone" not in name for name in tasks}
    for name, alone in each.items():
        for ours, expected in zip(jax.tree.leaves(together[name]), jax.tree.leaves(alone), strict=True):
            np.testing.assert_allclose(ours, expected, rtol=0, atol=1e-13)

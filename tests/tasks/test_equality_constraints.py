"""EqualityConstraintTask against MuJoCo's residuals and Jacobians, and in closed loop on a four-bar linkage."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_files import mjcf
from mujoco_states import full_velocities, mujoco_at
from refusals import refuses
from task_checks import alone, assert_every_number_counts, assert_finite_gradients, rows_of_each

import osik_jax as osik

MODEL = mjcf("equalities")
NAMES = ("loop", "cam", "glue", "tie", "equality5", "hang")
LANES = 6


@pytest.fixture(scope="module")
def robot():
    return osik.Robot.from_mjcf(MODEL)


@pytest.fixture(scope="module")
def configurations(robot):
    steps = np.random.default_rng(2).uniform(-0.7, 0.7, (LANES, robot.nv))
    return jax.jit(jax.vmap(osik.integrate, in_axes=(None, None, 0)))(robot, robot.q0, jnp.asarray(steps))


def _constraint(model, data, kept):
    """MuJoCo's residual and Jacobian of some constraints, in its own order of them."""
    jacobian = np.zeros((data.nefc, model.nv))
    if mujoco.mj_isSparse(model):
        mujoco.mju_sparse2dense(jacobian, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    else:
        jacobian = data.efc_J.reshape(data.nefc, model.nv)
    equality = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
    rows = np.concatenate([np.flatnonzero(equality & (data.efc_id == e)) for e in kept])
    return data.efc_pos[rows], jacobian[rows]


def _oracle(robot, q, kept):
    model = robot.mj_model
    data = mujoco.MjData(model)
    data.qpos[:] = robot.mujoco_qpos(q)
    data.eq_active[:] = 1
    mujoco.mj_forward(model, data)
    residual, jacobian = _constraint(model, data, kept)
    return residual, jacobian @ full_velocities(robot)


class TestAgainstMuJoCo:
    def test_all_active_ones_but_the_mimic_joint(self, robot, configurations):
        task = osik.EqualityConstraintTask(robot, gain=3.0, weight=2.0)
        assert tuple(c.name for c in task.constraints) == NAMES
        assert robot.mimic_joints == {"b4": ("a1", -1.5)}
        rows = jax.jit(jax.vmap(rows_of_each, in_axes=(None, None, 0)))(robot, {"task": task}, configurations)["task"]
        for k, q in enumerate(configurations):
            residual, jacobian = _oracle(robot, q, (0, 1, 2, 4, 5, 6))
            assert residual.shape == (3 + 1 + 6 + 3 + 6 + 6,)
            np.testing.assert_allclose(rows.error[k], residual, atol=1e-12)
            np.testing.assert_allclose(rows.jacobian[k], jacobian, atol=1e-12)
            np.testing.assert_allclose(rows.lower[k], -3.0 * residual, atol=1e-11)
        np.testing.assert_array_equal(rows.weight, np.full((LANES, 25), 2.0))

    def test_chosen_ones_in_the_models_order(self, robot, configurations):
        """One that the file has switched off too, if it is asked for."""
        task = osik.EqualityConstraintTask(robot, constraints=("off", "cam"))
        rows = rows_of_each(robot, {"task": task}, configurations[0])["task"]
        residual, jacobian = _oracle(robot, configurations[0], (1, 7))
        np.testing.assert_allclose(rows.error, residual, atol=1e-12)
        np.testing.assert_allclose(rows.jacobian, jacobian, atol=1e-12)

    def test_welds_go_the_short_way_round(self, robot):
        """MuJoCo's residual changes its sign with that of the quaternions; ours does not."""
        task = {"task": osik.EqualityConstraintTask(robot, constraints=("equality5",))}
        at = robot.joint_qpos_index("a1")
        q = robot.q0.at[at].set(robot.q0[at] + 3.5)
        flipped = q.at[3:7].multiply(-1.0)
        rows, other = (rows_of_each(robot, task, x)["task"] for x in (q, flipped))
        np.testing.assert_allclose(rows.error, other.error, atol=1e-14)
        assert np.linalg.norm(rows.error[3:]) == pytest.approx(np.sin((2 * np.pi - 3.5) / 2.0), abs=1e-12)


@pytest.mark.variants(slow=["locked0"], release=["locked1"])
@pytest.mark.parametrize("locked", [{}, {"b1": 0.4, "b3": -0.7}])
def test_written_and_read_again_they_are_the_same(locked):
    """Ends on fused bodies, on the world and on sites; rows of welds may be in other axes, which have the same norm."""
    robot = osik.Robot.from_mjcf(MODEL, locked_joints=locked)
    again = osik.Robot.from_mjcf(robot.to_mjcf())
    model = again.mj_model
    kept = [e for e in range(model.neq) if model.equality(e).name in (*NAMES, "off")]
    assert len(kept) == 7 - bool(locked)  # the cam of a locked joint is gone
    names = tuple(model.equality(e).name for e in kept)
    assert set(again.frame_names) == set(robot.frame_names) and model.neq == len(kept) + (robot.mimic_joints != {})
    tasks = [{"task": osik.EqualityConstraintTask(one, constraints=names)} for one in (robot, again)]
    for step in np.random.default_rng(3).uniform(-0.7, 0.7, (LANES, robot.nv)):
        q = osik.integrate(robot, robot.q0, step, 1.0)
        before, after = (rows_of_each(one, task, q)["task"] for one, task in zip((robot, again), tasks, strict=True))
        residual, jacobian = _oracle(again, q, kept)
        np.testing.assert_allclose(after.error, residual, atol=1e-12)
        np.testing.assert_allclose(after.jacobian, jacobian, atol=1e-12)
        np.testing.assert_allclose(before.error @ before.jacobian, residual @ jacobian, atol=1e-12)
        np.testing.assert_allclose(before.jacobian.T @ before.jacobian, jacobian.T @ jacobian, atol=1e-12)


@pytest.mark.slow
def test_sites_of_a_user_are_frames_whatever_their_names():
    """Also where a written end of a constraint would have the name; a second file is the same as the first."""
    own = "".join(f'<site name="equality_end/{name}" pos="0.01 0.02 0.{k}"/>' for k, name in enumerate(("loop/1", "x")))
    model = MODEL.replace('<site name="eye"', f'{own}<site name="eye"').replace('"pin"', '"equality_end/pin"')
    robot = osik.Robot.from_mjcf(model)
    assert {"equality_end/loop/1", "equality_end/x", "equality_end/pin", "eye"} <= set(robot.frame_names)
    text = robot.to_mjcf()
    again = osik.Robot.from_mjcf(text)
    assert set(again.frame_names) == set(robot.frame_names)
    assert set(osik.Robot.from_mjcf(again.to_mjcf()).frame_names) == set(robot.frame_names)
    assert again.to_mjcf().count("<site") == text.count("<site") == 6 + 2 * 6
    q = osik.integrate(robot, robot.q0, np.random.default_rng(3).uniform(-0.7, 0.7, robot.nv), 1.0)
    data = mujoco_at(again, q)
    kinematics = osik.forward_kinematics(robot, q)
    for name in ("equality_end/loop/1", "equality_end/x", "equality_end/pin"):
        np.testing.assert_allclose(kinematics.frame_pose(robot, name)[0], data.site(name).xpos, atol=1e-12)
    tasks = [{"task": osik.EqualityConstraintTask(one, constraints=NAMES)} for one in (robot, again)]
    before, after = (rows_of_each(one, task, q)["task"] for one, task in zip((robot, again), tasks, strict=True))
    np.testing.assert_allclose(np.linalg.norm(after.error), np.linalg.norm(before.error), rtol=1e-12)


class TestMistakes:
    def test_names(self, robot):
        refuses(KeyError, "did you mean 'glue'", osik.EqualityConstraintTask, robot, constraints=("gleu",))
        refuses(ValueError, "'mimic' holds already", osik.EqualityConstraintTask, robot, constraints=("mimic",))
        refuses(ValueError, "no constraint to keep", osik.EqualityConstraintTask, robot, constraints=())

    def test_kinds(self):
        refuses(ValueError, "no active connect, weld or joint", osik.EqualityConstraintTask, osik.load_robot("arm7"))
        tied = osik.Robot.from_mjcf(
            """<mujoco><worldbody><body><joint name="a"/><geom size="0.1"/><body><joint name="b"/><geom size="0.1"/>
            </body></body></worldbody><tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/>
            </fixed></tendon><equality><tendon name="rope" tendon1="t"/></equality></mujoco>"""
        )
        refuses(ValueError, "'rope' is of kind mjEQ_TENDON", osik.EqualityConstraintTask, tied, constraints=("rope",))


@pytest.mark.release
def test_every_number_counts_and_gradients_are_finite(robot, configurations):
    task = {"task": osik.EqualityConstraintTask(robot, constraints=("loop", "cam", "glue"))}
    assert_every_number_counts(robot, task, configurations[0])
    assert_finite_gradients(rows_of_each, *alone(robot, task, configurations[0]))


def _assembled(turn):
    """The joints of the four-bar linkage at an angle of the crank, by the law of cosines."""
    end = 0.2 * np.array([np.cos(turn), np.sin(turn)])
    across = np.array([0.6, 0.0]) - end
    length = np.linalg.norm(across)
    rise = np.arccos((0.6**2 + length**2 - 0.5**2) / (2.0 * 0.6 * length))
    rod = np.arctan2(across[1], across[0]) + rise
    tip = end + 0.6 * np.array([np.cos(rod), np.sin(rod)]) - [0.6, 0.0]
    return np.array([turn, rod - turn, np.arctan2(tip[1], tip[0])])


@pytest.fixture(scope="module")
def linkage():
    return osik.Robot.from_mjcf(mjcf("four_bar"))


class TestFourBar:
    @pytest.mark.variants(
        slow=["hard-point-scheme3"],
        release=[
            *("hard-angle-scheme0", "first-point-scheme2", "first-point-scheme4"),
            *("hard-point-scheme5", "hard-angle-scheme6"),
        ],
    )
    @pytest.mark.parametrize(
        ("form", "pull", "scheme"),
        [
            ("hard", "angle", osik.WeightedQP()),
            ("first", "angle", osik.HierarchicalQP()),
            ("first", "point", osik.HierarchicalQP()),
            ("hard", "point", osik.HierarchicalQP()),
            ("first", "point", osik.NullSpace(method="saturated")),
            ("hard", "point", osik.WeightedQP()),
            ("hard", "angle", osik.NullSpace(method="saturated")),
        ],
    )
    def test_a_loop_pulled_past_its_toggle_rests_there(self, linkage, form, pull, scheme):
        """Crank and rod stretch to a line of 0.8 m, from where the rocker cannot go on; its angle by the cosine law."""
        start, dead_point = _assembled(2.0), np.pi - np.arccos((0.6**2 + 0.5**2 - 0.8**2) / (2.0 * 0.6 * 0.5))
        beyond = dead_point - 0.5
        tasks: dict[str, osik.Task] = {}
        tasks["loop"] = osik.EqualityConstraintTask(linkage, hard=form == "hard", priority=1)
        if pull == "angle":
            tasks["rocker"] = osik.PostureTask(
                linkage, joints=("rocker",), target=np.r_[0.0, 0.0, beyond], weight=1.0, gain=5.0, priority=2
            )
        else:
            place = np.array([0.6 + 0.5 * np.cos(beyond), 0.5 * np.sin(beyond), 0.0])
            tasks["rocker"] = osik.FrameTask(linkage, "top", target=place, rows="position", gain=5.0, priority=2)
        limits = osik.VelocityLimit(linkage, velocity={"*": 2.0})
        path = osik.rollout(linkage, jnp.asarray(start), tasks, scheme=scheme, limits=(limits,), dt=0.01, steps=400)
        assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()
        assert np.abs(path.solution.velocity[-50:]).max() < 1e-2
        assert np.linalg.norm(path.solution.error["loop"], axis=1).max() < 5e-4
        assert np.linalg.norm(path.solution.error["loop"][-1]) < 1e-6
        np.testing.assert_allclose(path.q[-1][2], dead_point, atol=2e-3)

    @pytest.mark.slow
    @pytest.mark.parametrize("form", ["hard", "first"])
    def test_the_loop_stays_closed_while_the_crank_turns(self, linkage, form):
        """Once round; the end and the top together in MuJoCo, the angles those of the law of cosines."""
        steps, dt = 6000, 0.002
        hard, speed = form == "hard", 2.0 * np.pi / (steps * dt)
        tasks = {
            "loop": osik.EqualityConstraintTask(linkage, hard=hard, gain=1.0 / dt, priority=1),
            "crank": osik.PostureTask(linkage, joints=("crank",), target_velocity=speed, gain=0.0, priority=2 - hard),
        }
        scheme = osik.WeightedQP(damping=1e-9) if hard else osik.HierarchicalQP()
        start = jnp.asarray(_assembled(0.5))
        path = osik.rollout(linkage, start, tasks, scheme=scheme, dt=dt, steps=steps, limits=osik.no_limits)
        assert (np.asarray(path.solution.status) == osik.Status.SOLVED).all()
        gaps, angles = [], []
        for q in np.asarray(path.q[::20]):
            data = mujoco_at(linkage, q)
            gaps.append(np.linalg.norm(data.site("end").xpos - data.site("top").xpos))
            angles.append(np.angle(np.exp(1j * (q - _assembled(q[0])))))
        np.testing.assert_allclose(path.q[-1][0], 0.5 + 2.0 * np.pi, atol=1e-6)
        assert max(gaps) < 1e-6
        assert np.abs(angles).max() < 1e-5

"""EqualityConstraintTask against MuJoCo's residuals and Jacobians, and in closed loop on a four-bar linkage."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from task_checks import alone, assert_every_number_counts, assert_finite_gradients, rows_of_each

import osik_jax as osik

MODEL = """
<mujoco>
  <option><flag contact="disable"/></option>
  <default><geom size="0.03" mass="0.5"/></default>
  <worldbody>
    <site name="hook" pos="0.4 0.3 0.7" euler="10 20 30"/>
    <body name="base" pos="0 0 0.5"><freejoint/><geom/>
      <body name="a1" pos="0.2 0 0" euler="0 10 0"><joint name="a1" axis="0 1 0" ref="0.2"/><geom/>
        <body name="a2" pos="0.2 0 0"><joint name="a2" type="ball"/><geom/>
          <body name="plate" pos="0.1 0 0" euler="15 0 20">
            <geom/><site name="pin" pos="0 0.05 0" euler="0 40 0"/>
          </body>
        </body>
      </body>
      <body name="b1" pos="-0.2 0 0"><joint name="b1" axis="0 1 1"/><geom/>
        <body name="b2" pos="0 0 -0.2"><joint name="b2" axis="1 0 0" ref="-0.3"/><joint name="b3" axis="0 0 1"/><geom/>
          <body name="b4" pos="0.1 0 0"><joint name="b4" axis="0 1 0"/><geom/><site name="eye" pos="0.02 0 0.1"/></body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality>
    <connect name="loop" body1="plate" body2="b2" anchor="0.1 0.02 -0.03"/>
    <joint name="cam" joint1="b1" joint2="b2" polycoef="0.1 0.5 -0.3 0.2 0.05"/>
    <weld name="glue" body1="b4" body2="plate" relpose="0.1 0.2 0.3 0.9 0.1 -0.2 0.3" anchor="0.01 0.02 0.03"
          torquescale="0.7"/>
    <joint name="mimic" joint1="b4" joint2="a1" polycoef="0.05 -1.5 0 0 0"/>
    <connect name="tie" site1="pin" site2="eye"/>
    <weld body1="a1" body2="world"/>
    <weld name="hang" site1="pin" site2="hook" torquescale="1.3"/>
    <weld name="off" body1="a1" body2="b1" active="false"/>
  </equality>
</mujoco>
"""
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
    full = np.zeros((model.nv, robot.nv))
    for j in range(model.njnt):
        name = model.joint(j).name
        leader, ratio = robot.mimic_joints.get(name, (name, 1.0))
        width = {0: 6, 1: 3}.get(int(model.jnt_type[j]), 1)
        own = 0 if width == 6 else robot.joint_dof_index(leader)
        full[model.jnt_dofadr[j] :][:width, own : own + width] = ratio * np.eye(width)
    residual, jacobian = _constraint(model, data, kept)
    return residual, jacobian @ full


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


@pytest.mark.variants(release=["locked1"])
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
    data = mujoco.MjData(again.mj_model)
    data.qpos[:] = np.asarray(again.mujoco_qpos(q))
    mujoco.mj_kinematics(again.mj_model, data)
    kinematics = osik.forward_kinematics(robot, q)
    for name in ("equality_end/loop/1", "equality_end/x", "equality_end/pin"):
        np.testing.assert_allclose(kinematics.frame_pose(robot, name)[0], data.site(name).xpos, atol=1e-12)
    tasks = [{"task": osik.EqualityConstraintTask(one, constraints=NAMES)} for one in (robot, again)]
    before, after = (rows_of_each(one, task, q)["task"] for one, task in zip((robot, again), tasks, strict=True))
    np.testing.assert_allclose(np.linalg.norm(after.error), np.linalg.norm(before.error), rtol=1e-12)


class TestMistakes:
    def test_names(self, robot):
        with pytest.raises(KeyError, match="did you mean 'glue'"):
            osik.EqualityConstraintTask(robot, constraints=("gleu",))
        with pytest.raises(TypeError, match="not one string"):
            osik.EqualityConstraintTask(robot, constraints="glue")
        with pytest.raises(ValueError, match="'mimic' holds already"):
            osik.EqualityConstraintTask(robot, constraints=("mimic",))
        with pytest.raises(ValueError, match="no constraint to keep"):
            osik.EqualityConstraintTask(robot, constraints=())

    def test_kinds(self):
        with pytest.raises(ValueError, match="no active connect, weld or joint"):
            osik.EqualityConstraintTask(osik.load_robot("arm7"))
        tied = osik.Robot.from_mjcf(
            """<mujoco><worldbody><body><joint name="a"/><geom size="0.1"/><body><joint name="b"/><geom size="0.1"/>
            </body></body></worldbody><tendon><fixed name="t"><joint joint="a" coef="1"/><joint joint="b" coef="1"/>
            </fixed></tendon><equality><tendon name="rope" tendon1="t"/></equality></mujoco>"""
        )
        with pytest.raises(ValueError, match="'rope' is of kind mjEQ_TENDON"):
            osik.EqualityConstraintTask(tied, constraints=("rope",))


@pytest.mark.release
def test_every_number_counts_and_gradients_are_finite(robot, configurations):
    task = {"task": osik.EqualityConstraintTask(robot, constraints=("loop", "cam", "glue"))}
    assert_every_number_counts(robot, task, configurations[0])
    assert_finite_gradients(rows_of_each, *alone(robot, task, configurations[0]))


FOUR_BAR = """
<mujoco>
  <default><geom type="capsule" size="0.02" fromto="0 0 0 0.1 0 0"/></default>
  <worldbody>
    <body name="crank"><joint name="crank" axis="0 0 1"/><geom/>
      <body name="rod" pos="0.2 0 0"><joint name="knee" axis="0 0 1"/><geom/><site name="end" pos="0.6 0 0"/></body>
    </body>
    <body name="rocker" pos="0.6 0 0"><joint name="rocker" axis="0 0 1"/><geom/><site name="top" pos="0.5 0 0"/></body>
  </worldbody>
  <equality><connect name="loop" site1="end" site2="top"/></equality>
</mujoco>
"""


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
    return osik.Robot.from_mjcf(FOUR_BAR)


class TestFourBar:
    @pytest.mark.variants(
        slow=["first-angle-scheme1"],
        release=[
            "hard-angle-scheme0",
            "hard-point-scheme2",
            "hard-angle-scheme6",
            "first-point-scheme4",
            "hard-point-scheme5",
        ],
    )
    @pytest.mark.parametrize(
        ("form", "pull", "scheme"),
        [
            ("hard", "angle", osik.WeightedQP()),
            ("first", "angle", osik.HierarchicalQP()),
            ("first", "point", osik.HierarchicalQP()),
            pytest.param("hard", "point", osik.HierarchicalQP(), marks=pytest.mark.slow),
            pytest.param("first", "point", osik.NullSpace(method="saturated"), marks=pytest.mark.slow),
            pytest.param("hard", "point", osik.WeightedQP(), marks=pytest.mark.slow),
            pytest.param("hard", "angle", osik.NullSpace(method="saturated"), marks=pytest.mark.slow),
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
        model = linkage.mj_model
        data = mujoco.MjData(model)
        gaps, angles = [], []
        for q in np.asarray(path.q[::20]):
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            gaps.append(np.linalg.norm(data.site("end").xpos - data.site("top").xpos))
            angles.append(np.angle(np.exp(1j * (q - _assembled(q[0])))))
        np.testing.assert_allclose(path.q[-1][0], 0.5 + 2.0 * np.pi, atol=1e-6)
        assert max(gaps) < 1e-6
        assert np.abs(angles).max() < 1e-5

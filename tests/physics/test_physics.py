"""The dynamics: the world against the robot's own model, servos, the loop, and falls; forces from statics."""

from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compilations import Compilations
from refusals import refuses

import osik_jax as osik
from osik_jax import physics

DT = 0.005
GRAVITY = 9.81
LEGS = {pattern: physics.Servo(150.0, 5.0) for pattern in ("*Hip*", "*Knee*", "*Ankle*")}


@pytest.fixture(scope="module")
def nao_world(nao):
    return physics.build_world(nao, servos=LEGS)


@pytest.fixture(scope="module")
def arm_world(arm):
    return physics.build_world(arm, servos={"*": physics.Servo(600.0, 50.0)})


@pytest.fixture
def standing(nao_world):
    """NAO after a second on its feet."""
    simulation = physics.Simulation(nao_world)
    simulation.step(nao_world.robot.q0, 1.0)
    return simulation


def mass_matrix(model, data):
    """Columns from MuJoCo's product with unit vectors."""
    columns = np.zeros((model.nv, model.nv))
    for column, unit in zip(columns, np.eye(model.nv), strict=True):
        mujoco.mj_mulM(model, data, column, unit)
    return columns


@pytest.mark.parametrize("name", ["nao", "arm7"])
def test_world_has_the_dynamics_of_the_robots_model(name, rng):
    robot = osik.load_robot(name)
    world = physics.build_world(robot)
    own, there = robot.mj_model, world.model
    qpos, qvel = np.array(robot.mujoco_qpos(robot.q0)), rng.standard_normal(own.nv)
    qpos[2] += 1.0 * robot.floating_base  # no contact
    seen = []
    for model in (own, there):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        mujoco.mj_forward(model, data)
        seen.append((mass_matrix(model, data), data.qfrc_bias, data.qfrc_passive, data.subtree_com[0]))
    for a, b in zip(*seen, strict=True):
        np.testing.assert_allclose(b, a, rtol=1e-12, atol=1e-14)
    np.testing.assert_array_equal(there.jnt_range, own.jnt_range)
    np.testing.assert_array_equal(there.jnt_limited, own.jnt_limited)
    np.testing.assert_array_equal(there.qpos0, own.qpos0)
    for actuator, (joint, servo) in enumerate(world.servos.items()):
        assert there.actuator(actuator).name == joint
        assert servo.effort == own.actuator(joint).forcerange[1] == there.actuator(actuator).forcerange[1]
        assert servo.stiffness == own.actuator(joint).gainprm[0]


def test_soles_are_those_of_the_models_boxes(nao, nao_world):
    """The box of the left sole, measured from the ankle's sole frame, in the maker's figures (README of the robots)."""
    left = nao_world.feet["l_sole"]
    np.testing.assert_allclose(sorted(set(left[:, 0].round(9))), [-0.047, 0.080], atol=1e-9)
    np.testing.assert_allclose(sorted(set(left[:, 1].round(9))), [-0.038, 0.050], atol=1e-9)
    np.testing.assert_allclose(left[:, 2], 0.0, atol=1e-8)
    edges = np.roll(left, -1, 0) - left
    assert (np.cross(edges, np.roll(edges, -1, 0))[:, 2] > 0.0).all()
    assert nao_world.floor == pytest.approx(0.0, abs=1e-8)
    corners = physics.build_world(nao, feet={"l_sole": np.zeros((1, 3)), "r_ankle": [(0.0, 0.0, -0.04511)]})
    assert len(corners.contact_geoms("r_ankle")) == 1


def test_floor_carries_the_weight(nao, standing):
    forces, points = standing.contact_forces(), standing.contact_points()
    weight = GRAVITY * float(nao.body_mass.sum())
    assert forces[:, 2].sum() == pytest.approx(weight, rel=1e-3)
    np.testing.assert_allclose(forces[:, :2].sum(0), 0.0, atol=0.05)
    pressure = forces[:, 2] @ points[:, :2] / forces[:, 2].sum()
    np.testing.assert_allclose(pressure, standing.com()[:2], atol=1e-3)
    np.testing.assert_allclose(standing.com(), standing.data.subtree_com[0], atol=1e-12)
    data = standing.data
    for foot in ("l_sole", "r_sole"):
        at, turn = standing.frame_pose(foot)
        seen = data.geom_xpos[standing.world.contact_geoms(foot)]
        place = list(standing.world.feet).index(foot) * 4
        np.testing.assert_allclose(at + standing.world.feet[foot] @ turn.T, points[place : place + 4], atol=2e-5)
        np.testing.assert_allclose(points[place : place + 4, :2], seen[:, :2], atol=1e-12)
    assert not standing.fallen()


def test_servos_obey_their_law_and_their_limit(standing):
    model, data = standing.model, standing.data
    target = standing.world.robot.configuration({"HeadPitch": 0.3, "LShoulderPitch": 2.0})
    standing.step(target, 0.02)
    for effort, (joint, servo) in zip(standing.effort(), standing.world.servos.items(), strict=True):
        j = model.joint(joint)
        wish = servo.stiffness * (float(target[standing.world.robot.joint_qpos_index(joint)]) - data.qpos[j.qposadr[0]])
        wish -= servo.damping * data.qvel[j.dofadr[0]]
        assert effort == pytest.approx(np.clip(wish, -servo.effort, servo.effort), abs=1e-9)
    assert abs(standing.effort()[list(standing.world.servos).index("LShoulderPitch")]) == 1.329


def test_gears_and_senses(nao, standing):
    """One motor turns both hip yaw-pitch joints; what is sensed is MuJoCo's qpos without the follower."""
    standing.step(nao.configuration({"LHipYawPitch": -0.1}), 0.3)
    left, right = (standing.data.joint(name).qpos[0] for name in ("LHipYawPitch", "RHipYawPitch"))
    assert left < -0.05
    assert right == pytest.approx(left, abs=5e-4)
    full = np.asarray(nao.mujoco_qpos(standing.sense()))
    follower = standing.model.joint("RHipYawPitch").qposadr[0]
    np.testing.assert_array_equal(np.delete(full, follower), np.delete(standing.data.qpos, follower))


def _all_contacts(simulation):
    return [g for foot in simulation.world.feet for g in simulation.world.contact_geoms(foot)]


def test_feet_slip_as_far_as_coulomb_lets_them(nao):
    """A push above friction times weight slides the robot; one below does not; points move as the frames do."""
    moved = {}
    for friction in (0.1, 0.9):
        simulation = physics.Simulation(physics.build_world(nao, servos=LEGS, friction=friction))
        simulation.step(nao.q0, 0.2)
        before, spheres = simulation.contact_points(), simulation.data.geom_xpos[_all_contacts(simulation)]
        simulation.push("torso", (0.0, 8.0, 0.0))
        simulation.step(nao.q0, 0.3)
        shift = simulation.contact_points() - before
        there = simulation.data.geom_xpos[_all_contacts(simulation)] - spheres
        np.testing.assert_allclose(shift[:, :2], there[:, :2], atol=1e-12)
        moved[friction] = np.linalg.norm(shift[:, :2], axis=-1).max()
        forces = simulation.contact_forces()
        assert (np.linalg.norm(forces[:, :2], axis=-1) <= friction * forces[:, 2] * (1.0 + 1e-6) + 1e-9).all()
    assert moved[0.1] > 0.02
    assert moved[0.9] < 0.002


def test_falls_are_seen(nao, nao_world):
    limp = physics.Simulation(physics.build_world(nao, servos={"*": physics.Servo(1.0, 0.1, 1e-6)}))
    pushed = physics.Simulation(nao_world)
    pushed.push("torso", (-40.0, 0.0, 0.0))
    for simulation in (limp, pushed):
        assert not simulation.fallen()
        for _ in range(300):
            simulation.step(nao.q0, DT)
            if simulation.fallen():
                break
        up, height = simulation.data.body("torso").xmat[8], simulation.data.body("torso").xpos[2]
        assert simulation.fallen()
        assert up < np.cos(np.radians(45.0)) or height < 0.6 * float(nao.q0[2])
    pushed.reset(nao.q0)
    assert not pushed.fallen() and not pushed.data.xfrc_applied.any() and pushed.time == 0.0


def test_a_fall_ends_the_run(nao, nao_world):
    simulation = physics.Simulation(nao_world)
    posture = {"posture": osik.PostureTask(nao, gain=1.0, weight=1.0)}

    def push(t, simulation):
        simulation.push("torso", (0.0, 60.0, 0.0) if t > 0.1 else (0.0, 0.0, 0.0))

    options: dict[str, Any] = dict(limits=osik.no_limits, before_step=push)
    recording = physics.simulate(simulation, posture, scheme=osik.WeightedQP(), dt=DT, steps=400, **options)
    assert recording.fell and simulation.fallen()
    assert 20 < len(recording.command) < 300
    assert len(recording.time) == len(recording.q) == len(recording.command) + 1 == len(recording.solution.status) + 1
    assert recording.time[-1] == pytest.approx(simulation.time)
    np.testing.assert_array_equal(recording.q[-1], simulation.sense())


@pytest.mark.parametrize(("command", "left"), [(None, 0.0), (0.4, 1.0)])
def test_steady_errors_are_those_of_theory(arm, arm_world, command, left):
    """Posture alone: the integrated command takes all droop away; looking ahead multiplies stiffness by gain x time."""
    simulation = physics.Simulation(arm_world)
    goal = arm.q0 + jnp.linspace(-0.1, 0.1, arm.nq)
    posture = {"posture": osik.PostureTask(arm, target=goal, gain=5.0, weight=1.0)}
    recording = physics.simulate(
        simulation, posture, scheme=osik.WeightedQP(), dt=DT, steps=800, command=command, limits=osik.no_limits
    )
    droop = np.asarray(goal) - recording.q[-1]
    load = simulation.data.qfrc_bias  # at rest: gravity
    expected = load / (600.0 * 5.0 * 0.4)
    np.testing.assert_allclose(droop, left * expected, atol=2e-5)
    assert np.abs(expected).max() > 5e-3
    assert not recording.fell
    np.testing.assert_array_equal(recording.effort[-1], simulation.effort())
    np.testing.assert_allclose(recording.effort[-1], load, atol=0.02)


def test_other_gains_compile_nothing(arm, arm_world):
    def run(gain, time):
        task = {"posture": osik.PostureTask(arm, gain=gain, weight=1.0)}
        simulation = physics.Simulation(arm_world)
        return physics.simulate(
            simulation, task, scheme=osik.WeightedQP(), dt=DT, steps=3, command=time, limits=osik.no_limits
        )

    run(2.0, 0.1)
    with Compilations() as seen:
        run(3.0, 0.2)
    assert not any("control_step" in name for name in seen.names)


def test_mistakes_are_told(nao, arm, arm_world):
    refuses(KeyError, "did you mean 'l_sole'", physics.build_world, nao, feet=("l_sol",))
    refuses(ValueError, "'torso' has no contact points", physics.build_world, nao, feet=("torso",))
    refuses(TypeError, "not one string", physics.build_world, nao, feet="l_sole")
    refuses(ValueError, "needs feet", physics.build_world, nao, feet=())
    refuses(KeyError, "LKneePitch", physics.build_world, nao, servos={"Knee": physics.Servo(1.0, 0.0)})
    refuses(ValueError, "stiffness has to be positive", physics.Servo, 0.0, 1.0)
    refuses(ValueError, "effort has to be positive", physics.Servo, 1.0, 1.0, 0.0)
    refuses(ValueError, "timestep", physics.build_world, arm, timestep=0.0)
    refuses(ValueError, "floor nan", physics.build_world, arm, floor=np.nan)
    refuses(TypeError, r"a servo is \(600, 5\)", physics.build_world, arm, servos={"*": (600, 5)})
    refuses(ValueError, "body_mass of the robot is not", physics.build_world, arm.scaled(mass=2.0))
    refuses(ValueError, "joint_axis .*to_mjcf", physics.build_world, arm.replace(joint_axis={"joint2": (1, 0, 0)}))
    simulation = physics.Simulation(arm_world)
    refuses(ValueError, "no whole number of timesteps", simulation.step, arm.q0, 0.0015)
    refuses(ValueError, "joint2 is not finite", simulation.step, arm.q0.at[1].set(np.nan), DT)
    refuses(KeyError, "bodies: link0", simulation.push, "torso", (1.0, 0.0, 0.0))
    posture = {"posture": osik.PostureTask(arm, weight=1.0)}
    refuses(ValueError, "one step", physics.simulate, simulation, posture, scheme=osik.WeightedQP(), dt=DT, steps=0)


def test_geared_actuators_are_those_of_the_model():
    """A weight on a geared servo, beside MuJoCo's own simulation, which takes its target behind the gear."""
    text = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".05" pos=".3 0 0" mass="1"/></body>
    </worldbody><actuator><position joint="j" kp="10" kv="1" gear="-5" forcerange="-2 2"/></actuator></mujoco>"""
    robot = osik.Robot.from_mjcf(text)
    simulation = physics.Simulation(physics.build_world(robot, timestep=0.002))
    model = mujoco.MjModel.from_xml_string(
        text.replace("<worldbody>", '<option integrator="implicitfast"/><worldbody>')
    )
    data = mujoco.MjData(model)
    for target in (0.0, 1.5):  # the second one needs more than the greatest effort at first
        data.ctrl[:] = -5.0 * target
        mujoco.mj_step(model, data, 50)
        simulation.step(np.array([target]), 0.1)
        np.testing.assert_allclose(simulation.data.qpos, data.qpos, rtol=1e-9)
    assert simulation.world.servos["j"] == physics.Servo(250.0, 25.0, 10.0)


LOOPS = """<mujoco><worldbody>
<body name="a"><joint name="j1" axis="0 1 0" ref="0.1"/><geom size=".1"/><site name="s" pos=".1 0 .2"/>
<body name="b" pos=".2 0 0"><joint name="j2" axis="0 1 0"/><geom size=".1"/><site name="e" pos=".2 0 0"/></body></body>
<body name="c" pos=".2 0 .2"><joint name="j3" axis="0 1 0"/><geom size=".1"/><site name="f" pos=".2 0 -.2"/></body>
<body name="d" pos=".4 0 0"><joint name="j4" axis="0 1 0"/><geom size=".1"/></body>
<body name="loose" pos="2 0 1"><freejoint/><geom size=".1"/></body>
</worldbody><equality>{}</equality><actuator><position joint="j1" kp="100" kv="5"/></actuator></mujoco>"""


def test_loops_are_closed(rng):
    """Violations and their Jacobian at any configuration are those of the model, and the loop does not come apart."""
    kinds = """<connect name="ends" site1="e" site2="f" solref="0.01 1"/><connect body1="b" body2="d" anchor=".1 0 0"/>
    <weld body1="a" body2="c" relpose=".1 .2 .3 .8 .6 0 0" torquescale="2"/><weld site1="s" site2="f" active="false"/>
    <joint joint1="j3" joint2="j4" polycoef=".1 1 .5 0 0"/>"""
    with pytest.warns(osik.OsikWarning, match="does not keep all"):
        robot = osik.Robot.from_mjcf(LOOPS.format(kinds))
    world = physics.build_world(robot, servos={"j*": physics.Servo(10.0, 1.0)})
    np.testing.assert_array_equal(world.model.eq_solref, robot.mj_model.eq_solref)
    qpos, seen = rng.standard_normal(world.model.nq), []
    for model in (robot.mj_model, world.model):
        data = mujoco.MjData(model)
        data.qpos[:], data.eq_active[:] = qpos, 1
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        mujoco.mj_forward(model, data)
        assert data.ne == 3 + 3 + 6 + 6 + 1
        seen.append((data.efc_pos[: data.ne], data.efc_J.ravel()[: data.ne * model.nv]))
    for own, there in zip(*seen, strict=True):
        np.testing.assert_allclose(there, own, atol=1e-13)
    with pytest.warns(osik.OsikWarning, match="does not keep all"):
        alone = osik.Robot.from_mjcf(LOOPS.format('<connect site1="e" site2="f"/>'))
    weak = {"j2": physics.Servo(100.0, 5.0), "j[34]": physics.Servo(1e-3, 0.1)}
    simulation = physics.Simulation(physics.build_world(alone, servos=weak))
    simulation.step(alone.q0, 1.0)
    np.testing.assert_allclose(simulation.frame_pose("e")[0], simulation.frame_pose("f")[0], atol=1e-3)


def test_a_loose_object_falls_and_not_the_robot():
    robot = osik.Robot.from_mjcf(LOOPS.format(""))
    simulation = physics.Simulation(physics.build_world(robot, servos={"j*": physics.Servo(100.0, 5.0)}))
    simulation.step(robot.q0, 1.0)
    assert simulation.data.body("loose").xpos[2] < -1.0 and not robot.floating_base and not simulation.fallen()


def test_joints_without_a_servo_are_named():
    text = """<mujoco><worldbody><body name="a"><joint name="hinge" axis="0 0 1"/><geom size=".1"/>
    <body name="b"><joint name="ball" type="ball"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    robot = osik.Robot.from_mjcf(text)
    refuses(ValueError, "joint 'hinge' has no position actuator", physics.build_world, robot)
    refuses(ValueError, "'ball' is a ball joint", physics.build_world, robot, servos={"hinge": physics.Servo(1.0, 0.0)})
    locked = osik.Robot.from_mjcf(text, locked_joints=("ball",))
    refuses(ValueError, "nothing can hold it", physics.build_world, locked, servos={"hinge": physics.Servo(1.0, 0.0)})


def test_locked_joints_are_held(nao):
    """Locked away from zero, an arm stays there without a servo of its own."""
    robot = osik.Robot.from_mjmodel(nao.mj_model, locked_joints={"LShoulderRoll": 0.5})
    world = physics.build_world(robot, servos=LEGS)
    assert "LShoulderRoll" not in world.servos and len(world.servos) == 24
    simulation = physics.Simulation(world)
    simulation.step(robot.q0, 0.5)
    assert simulation.data.joint("LShoulderRoll").qpos[0] == pytest.approx(0.5, abs=2e-3)


@pytest.mark.slow
def test_targets_by_step_are_those_of_a_function_of_time(arm, arm_world):
    hand = osik.FrameTask(arm, "hand", rows="position", gain=5.0)
    home, rotation = hand.target
    others = {"posture": osik.PostureTask(arm, weight=1e-3)}
    settings: Any = dict(scheme=osik.WeightedQP(), dt=0.005, steps=40)
    path = np.asarray(home) + 0.2 * 0.005 * np.arange(40)[:, None]
    rotations = np.tile(rotation, (40, 1, 1))
    given = physics.simulate(
        physics.Simulation(arm_world), others | {"hand": hand}, targets={"hand": (path, rotations)}, **settings
    )
    computed = physics.simulate(
        physics.Simulation(arm_world),
        lambda t: others | {"hand": hand.replace(target=(home + 0.2 * t, rotation))},
        **settings,
    )
    np.testing.assert_allclose(given.q, computed.q, rtol=0, atol=1e-12)
    assert np.abs(given.q[-1] - given.q[0]).max() > 0.02
    simulation = physics.Simulation(arm_world)
    with pytest.raises(KeyError, match="no task; tasks: posture"):
        physics.simulate(simulation, others, targets={"hand": (path, rotations)}, **settings)
    with pytest.raises(ValueError, match="first axis is the steps, 40"):
        physics.simulate(simulation, others | {"hand": hand}, targets={"hand": (path[:-1], rotations)}, **settings)
    with pytest.raises(ValueError, match="a function of time sets them itself"):
        physics.simulate(simulation, lambda t: others, targets={"hand": (path, rotations)}, **settings)

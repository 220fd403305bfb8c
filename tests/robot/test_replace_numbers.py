"""Numbers of a robot set by name, beside MuJoCo with the same numbers set in its model."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compilations import Compilations
from model_files import mjcf
from refusals import refuses

import osik_jax as osik
from osik_jax import Robot


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_mjcf(mjcf("odd"))


def test_every_array_of_kinematics_is_mujocos(robot: Robot):
    """The same edits of the MuJoCo model, at the same configuration."""
    model = robot.mj_model.__copy__()
    turn = np.array([0.9, 0.1, -0.3, 0.2])
    changed = robot.replace(
        body_position={"b": (0.1, 0.2, 0.3)},
        body_quaternion={"c": turn / np.linalg.norm(turn)},
        joint_axis={"z": (0.0, 2.0, 1.0)},
        joint_position={"w": (0.0, 0.3, 1.0)},
        joint_reference={"y": 0.7, "s": 0.05},
        frame_position={"pin": (0.5, 0.0, 0.0)},
        body_mass={"c": 3.0},
    )
    model.body("b").pos[:], model.body("c").quat[:] = (0.1, 0.2, 0.3), turn / np.linalg.norm(turn)
    model.joint("z").axis[:], model.joint("w").pos[:] = np.array([0.0, 2.0, 1.0]) / 5**0.5, (0.0, 0.3, 1.0)
    for name, value in (("y", 0.7), ("s", 0.05)):
        model.qpos0[model.joint(name).qposadr] = value
    data = mujoco.MjData(model)
    data.qpos[:] = changed.mujoco_qpos(robot.q0 + 0.1)
    mujoco.mj_kinematics(model, data)
    found = osik.forward_kinematics(changed, robot.q0 + 0.1)
    for name in ("a/1", "b", "c", "größe"):
        body = changed.tree.body_names.index(name)
        np.testing.assert_allclose(found.body_position[body], data.body(name).xpos, atol=1e-12, err_msg=name)
    place, carrier = found.frame_pose(changed, "pin")[0], changed.tree.frame_bodies[changed.tree.frame("pin")]
    out = np.asarray(found.body_rotation[carrier])[:, 0]
    np.testing.assert_allclose(place, found.body_position[carrier] + 0.5 * out, atol=1e-12)
    assert float(changed.body_mass[changed.tree.body_names.index("c")]) == 3.0
    np.testing.assert_array_equal(changed.body_position[1], robot.body_position[1])


def test_names_globs_and_whole_arrays(arm: Robot):
    some = arm.replace(velocity_limit={"joint[12]": 0.5, "joint3": 0.25}, position_upper={"joint1": np.inf})
    np.testing.assert_array_equal(some.velocity_limit[:3], [0.5, 0.5, 0.25])
    np.testing.assert_array_equal(some.velocity_limit[3:], arm.velocity_limit[3:])
    assert np.isinf(some.position_upper[0])
    mass = np.asarray(arm.body_mass) * 2.0
    np.testing.assert_array_equal(arm.replace(body_mass=mass).body_mass, mass)
    assert float(arm.replace(q0={"joint2": 0.4}).q0[1]) == 0.4


def test_a_number_for_many_joints_is_not_for_a_base_or_a_ball(robot: Robot):
    slow = robot.replace(velocity_limit={"*": 0.5}).velocity_limit
    starts = [start for j, start in robot.tree.dof_address.items() if robot.tree.joint_types[j] > 1]
    rest = np.setdiff1d(np.arange(robot.nv), starts)
    assert (np.asarray(slow)[starts] == 0.5).all() and len(rest) >= 9
    np.testing.assert_array_equal(slow[rest], robot.velocity_limit[rest])
    both = robot.replace(velocity_limit={"*": 0.5, "fly": np.ones(6)}).velocity_limit
    assert np.sum(np.asarray(both) == 1.0) == 6 and (np.asarray(both)[starts] == 0.5).all()
    with pytest.raises(ValueError, match=r"velocity_limit\['fl\*'\] has shape"):
        robot.replace(velocity_limit={"fl*": 0.5})


def test_a_free_joint_and_a_ball_take_all_their_entries(robot: Robot):
    moved = robot.replace(joint_reference={"fly": (1, 2, 3, 1, 0, 0, 0)}, dof_armature={"ball": (1, 2, 3)})
    at = robot.tree.full_qpos_address[robot.tree.joint("fly")]
    np.testing.assert_array_equal(moved.joint_reference[at : at + 7], [1, 2, 3, 1, 0, 0, 0])
    at = robot.tree.full_dof_address[robot.tree.joint("ball")]
    np.testing.assert_array_equal(moved.dof_armature[at : at + 3], [1, 2, 3])


def test_jit_vmap_and_grad_without_compiling_again(arm: Robot):
    old = jnp.asarray(arm.body_position[3])

    def tip(length: jax.Array) -> jax.Array:
        robot = arm.replace(
            body_position={"link3": old.at[2].add(length)}, joint_axis={"joint5": jnp.stack([length, 1, 0])}
        )
        return osik.forward_kinematics(robot, arm.q0 + 0.3).frame_pose(robot, "hand")[0]

    run = jax.jit(jax.vmap(tip))
    lengths = jnp.array([0.0, 0.01, -0.02])
    tips, others = run(lengths), lengths + 0.1
    with Compilations() as seen:
        run(others)
    assert not seen.names
    for length, found in zip(lengths, tips, strict=True):
        np.testing.assert_allclose(found, tip(length), atol=1e-12)
    step = 1e-6
    numeric = (tip(jnp.array(0.02 + step)) - tip(jnp.array(0.02 - step))) / (2 * step)
    np.testing.assert_allclose(jax.jacfwd(tip)(jnp.array(0.02)), numeric, atol=1e-8)


@pytest.mark.parametrize(
    ("error", "message", "values"),
    [
        (KeyError, "no field 'body_pos'; did you mean 'body_position'", dict(body_pos=0.0)),
        (KeyError, "no field 'tree'", dict(tree=None)),
        (
            KeyError,
            "'hand' is a frame fixed to the body 'link7': set frame_position",
            dict(body_position={"hand": (0, 0, 0)}),
        ),
        (KeyError, "no joint 'link3'.*joints: joint1", dict(joint_axis={"link3": (0, 0, 1)})),
        (KeyError, "no frame 'tool'", dict(frame_position={"tool": (0, 0, 0)})),
        (ValueError, r"body_position\['link3'\] has shape \(\), expected \(3,\)", dict(body_position={"link3": 0.1})),
        (ValueError, r"body_mass has shape \(2,\), expected \(8,\)", dict(body_mass=np.ones(2))),
        (ValueError, "axis of length 0", dict(joint_axis={"joint1": (0, 0, 0)})),
        (ValueError, "body_mass.* finite and not negative", dict(body_mass={"link3": -1.0})),
        (ValueError, "velocity_limit.* is -1.0; it has to be not neg", dict(velocity_limit={"joint1": -1.0})),
        (ValueError, "acceleration_limit.* is -inf; it has to be not neg", dict(acceleration_limit={"*": -np.inf})),
        (ValueError, "without negative moments", dict(body_inertia={"link3": -np.eye(3)})),
        (ValueError, "has to be symmetric", dict(body_inertia={"link3": np.eye(3) + np.eye(3, k=1)})),
        (ValueError, "is 0 for joint1, joint2", dict(qpos_offset={"joint3": 0.1})),
        (ValueError, "body_position.* finite", dict(body_position={"link3": (np.nan, 0, 0)})),
        (ValueError, "lower > upper in rows \\[0\\]", dict(position_lower={"joint1": 9.0})),
        (ValueError, "gives 'joint1' twice", dict(velocity_limit={"joint1": 1.0, "*": 2.0})),
        (ValueError, "length 1 within", dict(body_quaternion={"link3": (0, 0, 0, 0)})),
        (TypeError, "it is a number", dict(body_mass={"link3": "heavy"})),
    ],
)
def test_wrong_values_are_told(arm: Robot, error, message: str, values: dict):
    refuses(error, message, arm.replace, **values)
    refuses(ValueError, "a stack of robots", osik.stack([arm, arm]).replace, body_mass={"*": 1.0})

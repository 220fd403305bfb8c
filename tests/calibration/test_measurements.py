"""Predicted readings and changed robots beside Pinocchio, homogeneous matrices and shifted encoders."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pinocchio as pin
import pytest
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import calibration as cal
from osik_jax.calibration._setup import Setup, make_setup
from osik_jax.calibration._unknowns import apply, parameters_of


def homogeneous(position: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, position
    return pose


def random_frame(rng: np.random.Generator, parent: str | None) -> tuple[cal.FixedFrame, np.ndarray]:
    position, rotation = rng.normal(size=3), Rotation.random(rng=rng).as_matrix()
    return cal.FixedFrame(parent, position, rotation), homogeneous(position, rotation)


def test_readings_are_those_of_pinocchio_and_matrices():
    """A base in the world, a camera on the tool, a board and a table in the world."""
    rng, robot = np.random.default_rng(0), osik.load_robot("ur5")
    (base, world), (camera, on_tool) = random_frame(rng, None), random_frame(rng, "tool0")
    (board, board_pose), (table, table_pose) = random_frame(rng, None), random_frame(rng, None)
    setup = make_setup(robot, {"camera": camera, "board": board, "table": table}, base)
    q, corner = rng.uniform(-2.0, 2.0, (4, 6)), rng.normal(size=(4, 3))
    model = pin.buildModelFromXML(robot.to_urdf())
    data, tool = model.createData(), model.getFrameId("tool0")
    wanted: dict[str, list] = {name: [] for name in ("points", "poses", "distances", "heights", "pixels")}
    for row, point in zip(q, corner, strict=True):
        pin.framesForwardKinematics(model, data, row)
        tip = world @ data.oMf[tool].homogeneous
        seen = np.linalg.inv(tip @ on_tool) @ board_pose @ [*point, 1.0]
        wanted["points"].append((tip @ [0.1, 0.2, 0.3, 1.0])[:3])
        wanted["poses"].append(tip)
        wanted["distances"].append(np.linalg.norm(tip[:3, 3] - board_pose[:3, 3]))
        wanted["heights"].append((np.linalg.inv(table_pose) @ tip)[2, 3])
        wanted["pixels"].append([320 + 600 * seen[0] / abs(seen[2]), 240 + 500 * seen[1] / abs(seen[2])])
    zeros = np.zeros((4, 3))
    measurements = {
        "points": cal.Points("tool0", q, zeros, point=(0.1, 0.2, 0.3)),
        "distances": cal.Distances("tool0", "board", q, np.zeros(4)),
        "heights": cal.PlaneContacts("tool0", "table", q),
        "pixels": cal.Pixels("board", "camera", q, zeros[:, :2], (600, 500, 320, 240), point=corner),
    }
    for name, measurement in measurements.items():
        found = jax.jit(lambda setup, of=measurement: of.predicted(setup))(setup)
        np.testing.assert_allclose(found, np.array(wanted[name]), rtol=1e-9, atol=1e-9, err_msg=name)
    turned = np.array(wanted["poses"])[:, :3, :3]
    poses = cal.Poses("tool0", q, zeros, turned @ Rotation.from_rotvec([0.1, 0.2, -0.3]).inv().as_matrix())
    rows = poses.differences(poses.predicted(setup), poses.readings)
    np.testing.assert_allclose(rows[:, :3], np.array(wanted["poses"])[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(rows[:, 3:], np.tile([0.1, 0.2, -0.3], (4, 1)), atol=1e-9)


def test_rounded_rotations_become_the_nearest_ones():
    """Beside SciPy's polar decomposition."""
    rounded = np.round(Rotation.random(5, rng=np.random.default_rng(2)).as_matrix(), 3)
    found = cal.Poses("tool0", np.zeros((5, 6)), np.zeros((5, 3)), rounded).rotation
    np.testing.assert_allclose(found, [polar(matrix)[0] for matrix in rounded], atol=1e-12)


def test_unknowns_of_a_generator_and_a_prior_of_numpy():
    setup = make_setup(osik.load_robot("ur5"), {}, None)
    unknown = cal.Unknown("joint_offset", "elbow_joint", prior=np.float32(0.5))  # pyright: ignore[reportArgumentType]
    parameters, precision = parameters_of(setup, (one for one in [unknown]))  # pyright: ignore[reportArgumentType]
    assert [part.name for part in parameters] == ["elbow_joint"] and precision.tolist() == [4.0]


@pytest.mark.parametrize(
    ("name", "joints"), [("panda", ("panda_finger_joint1", "panda_joint4")), ("tiago", ("torso_*",))]
)
def test_an_offset_is_added_to_what_the_encoder_reads(name: str, joints: tuple[str, ...]):
    """Hinges, slides and a follower: the corrected robot at q is the old one at q plus the offset."""
    robot = osik.load_robot(name)
    setup = make_setup(robot, {}, None)
    parameters, _ = parameters_of(setup, [cal.Unknown("joint_offset", joints)])
    change = jnp.asarray(np.linspace(0.01, 0.03, len(parameters)))
    corrected = apply(setup, parameters, change)
    q = robot.q0 + 0.01
    moved = q
    for part, value in zip(parameters, change, strict=True):
        moved = moved.at[robot.joint_qpos_index(part.name)].add(value)
    for ours, theirs in zip(*(_poses(s, q) for s, q in ((corrected, q), (setup, moved))), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)


def _poses(setup: Setup, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    return osik.forward_kinematics(setup.robot, q).frame_poses(setup.robot, setup.robot.frame_names)


def test_the_derivative_by_every_unknown_is_the_difference():
    """All quantities at once, central differences in float64."""
    robot = osik.load_robot("ur5")
    camera = cal.FixedFrame("tool0", (0.0, 0.05, 0.1), Rotation.from_rotvec([0.1, 0.0, 0.2]).as_matrix())
    setup = make_setup(robot, {"camera": camera}, cal.FixedFrame(position=(0.1, 0.2, 0.3)))
    kinds = "joint_offset", "joint_axis", "body_position", "body_rotation"
    parameters, _ = parameters_of(setup, [cal.Unknown(kind) for kind in (*kinds, "base_position", "base_rotation")])
    more, _ = parameters_of(
        setup, [cal.Unknown(f"frame_{what}", ("tool0", "camera")) for what in ("position", "rotation")]
    )
    parameters, q = (*parameters, *more), jnp.asarray(np.random.default_rng(1).uniform(-2.0, 2.0, 6))

    @jax.jit
    def pose(change: jax.Array) -> jax.Array:
        position, rotation = apply(setup, parameters, change).poses(q, ("camera",))
        return jnp.concatenate([position.ravel(), rotation.ravel()])

    start = 0.01 * jnp.asarray(np.random.default_rng(2).normal(size=len(parameters)))
    exact, step = jax.jit(jax.jacfwd(pose))(start), 1e-6
    for k in range(len(parameters)):
        ahead, back = (pose(start.at[k].add(s)) for s in (step, -step))
        np.testing.assert_allclose(exact[:, k], (ahead - back) / (2 * step), atol=1e-8, err_msg=parameters[k].label)

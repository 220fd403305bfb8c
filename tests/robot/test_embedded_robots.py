"""The robots that come with the package against published figures and independent descriptions."""

import json
from importlib import resources
from pathlib import Path

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation
from task_checks import kinematics_at

import osik_jax as osik

NAO = json.loads((Path(__file__).parents[1] / "data" / "nao_reference.json").read_text(encoding="utf-8"))
# Franka Control Interface documentation: modified Denavit-Hartenberg figures (a, d, alpha), last row the flange.
PANDA_DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
    (0.0, 0.107, 0.0),
)
PANDA_LOWER = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
PANDA_UPPER = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
PANDA_SPEED = (2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61)


@pytest.fixture(scope="module")
def nao_poses(nao):
    """Poses of all frames and the centre of mass, jitted."""

    def poses(q):
        kin = osik.forward_kinematics(nao, q)
        return *kin.frame_poses(nao, nao.frame_names), osik.center_of_mass(nao, kin)

    return jax.jit(poses)


def configuration(nao: osik.Robot, recorded: dict) -> jax.Array:
    q = nao.configuration(recorded["joints"])
    return q.at[:7].set(jnp.asarray(recorded["base_position"] + recorded["base_quaternion"]))


def test_nao_has_26_joints_25_motors_and_a_floating_base(nao):
    assert nao.mj_model.njnt == 1 + 26
    assert nao.mj_model.nu == 25
    assert (nao.nq, nao.nv) == (7 + 25, 6 + 25)
    assert nao.floating_base
    assert nao.mimic_joints == {"RHipYawPitch": ("LHipYawPitch", 1.0)}
    assert set(nao.joint_names) == set(NAO["joints"]) - {"RHipYawPitch"}


def test_nao_equals_the_independent_description(nao, nao_poses):
    """All frames, and the centre of mass, in each recorded configuration."""
    for recorded in NAO["configurations"]:
        positions, rotations, com = nao_poses(configuration(nao, recorded))
        assert len(recorded["frames"]) == 63
        for name, (x, y, z, *wxyz) in recorded["frames"].items():
            at = nao.frame_names.index(name)
            expected = Rotation.from_quat(wxyz, scalar_first=True)
            angle = (Rotation.from_matrix(np.asarray(rotations[at])) * expected.inv()).magnitude()
            assert np.linalg.norm(positions[at] - np.array([x, y, z])) < 1e-4, name
            assert angle < 1e-4, name
        np.testing.assert_allclose(com, recorded["com"], atol=1e-3, rtol=0)


def test_nao_limits_and_mass_equal_the_independent_description(nao):
    for name, limit in NAO["joints"].items():
        dof = nao.joint_dof_index(name)
        assert nao.position_lower[dof] == pytest.approx(limit["lower"], abs=1e-3), name
        assert nao.position_upper[dof] == pytest.approx(limit["upper"], abs=1e-3), name
        assert nao.velocity_limit[dof] == pytest.approx(limit["velocity"], abs=1e-3), name
    assert float(nao.body_mass.sum()) == pytest.approx(NAO["mass"], rel=1e-2)
    assert np.all(np.isinf(nao.velocity_limit[:6])) and np.all(np.isinf(nao.position_upper[:6]))


def test_nao_motor_torques_equal_the_independent_description(nao):
    model = nao.mj_model
    for motor in range(model.nu):
        name = model.actuator(motor).name
        assert model.actuator_forcerange[motor, 1] == pytest.approx(NAO["joints"][name]["effort"], abs=1e-3), name


def test_nao_stands_flat_on_the_floor(nao, nao_poses):
    positions, rotations, com = nao_poses(nao.q0)
    for sole in ("l_sole", "r_sole"):
        at = nao.frame_names.index(sole)
        assert abs(float(positions[at, 2])) < 1e-6
        np.testing.assert_allclose(rotations[at], np.eye(3), atol=1e-12)
    corners = np.array([positions[nao.frame_names.index(f"{s}_sole_corner_{k}")] for s in "lr" for k in range(4)])
    np.testing.assert_allclose(corners[:, 2], 0.0, atol=1e-6)
    edges = ConvexHull(corners[:, :2]).equations
    assert (edges[:, :2] @ np.asarray(com[:2]) + edges[:, 2]).max() < -0.04  # metres inside the nearest edge
    joints = slice(6, None)
    angles = nao.q0[7:]
    room = np.minimum(angles - nao.position_lower[joints], nao.position_upper[joints] - angles)
    assert room.min() > 0.2


def test_contact_corners_go_round_each_sole_counter_clockwise(nao, nao_poses):
    positions, *_ = nao_poses(nao.q0)
    for side, expected in (("l", 0.0051096), ("r", 0.0051108)):
        x, y = np.array([positions[nao.frame_names.index(f"{side}_sole_corner_{k}")] for k in range(4)])[:, :2].T
        area = 0.5 * np.sum(x * np.roll(y, -1) - y * np.roll(x, -1))
        assert area == pytest.approx(expected, abs=1e-7)  # m^2, of the published force sensor positions


@pytest.mark.parametrize(("name", "drift"), [("nao", 0.03), ("arm7", 0.02)])
def test_position_actuators_hold_the_keyframe_in_simulation(name, drift):
    text = (resources.files("osik_jax") / "robot" / "models" / f"{name}.xml").read_text(encoding="utf-8")
    spec = mujoco.MjSpec.from_string(text)
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    start = data.qpos.copy()
    while data.time < 2.0:
        mujoco.mj_step(model, data)
    assert np.abs(data.qpos - start).max() < drift
    assert np.abs(data.qvel).max() < 0.01


def dh_product(q: np.ndarray) -> np.ndarray:
    """Pose of the flange by modified Denavit-Hartenberg transforms: Rx(alpha) Tx(a) Rz(q) Tz(d)."""
    pose = np.eye(4)
    for (a, d, alpha), angle in zip(PANDA_DH, [*q, 0.0], strict=True):
        ca, sa, cq, sq = np.cos(alpha), np.sin(alpha), np.cos(angle), np.sin(angle)
        pose = pose @ np.array(
            [[cq, -sq, 0.0, a], [sq * ca, cq * ca, -sa, -d * sa], [sq * sa, cq * sa, ca, d * ca], [0.0, 0.0, 0.0, 1.0]]
        )
    return pose


@pytest.fixture(scope="module")
def arm7_flange(arm):
    """Pose and Jacobian of the flange over a batch of configurations, jitted."""

    def flange(q):
        kin = osik.forward_kinematics(arm, q)
        return *kin.frame_pose(arm, "flange"), osik.frame_jacobian(arm, kin, "flange")

    return jax.jit(jax.vmap(flange))


@pytest.fixture
def arm7_q(rng) -> np.ndarray:
    return rng.uniform(PANDA_LOWER, PANDA_UPPER, (50, 7))


def test_arm7_flange_equals_the_denavit_hartenberg_product(arm7_flange, arm7_q):
    position, rotation, _ = arm7_flange(arm7_q)
    expected = np.array([dh_product(q) for q in arm7_q])
    np.testing.assert_allclose(position, expected[:, :3, 3], atol=1e-12, rtol=0)
    np.testing.assert_allclose(rotation, expected[:, :3, :3], atol=1e-12, rtol=0)


def test_arm7_limits_are_the_published_ones(arm):
    assert arm.joint_names == tuple(f"joint{i}" for i in range(1, 8))
    assert not arm.floating_base
    np.testing.assert_array_equal(arm.position_lower, PANDA_LOWER)
    np.testing.assert_array_equal(arm.position_upper, PANDA_UPPER)
    np.testing.assert_array_equal(arm.velocity_limit, PANDA_SPEED)


def test_arm7_masses_are_the_identified_ones(arm):
    """Masses of links 0 to 7 in the panda.urdf of example-robot-data, after Gaz et al. 2019."""
    identified = (0.629769, 4.970684, 0.646926, 3.228604, 3.587895, 1.225946, 1.666555, 0.735522)
    np.testing.assert_allclose(arm.mj_model.body_mass[1:], identified, rtol=1e-12)


def test_arm7_home_points_the_flange_down_and_the_hand_is_turned(arm):
    kin = kinematics_at(arm, arm.q0)
    position, rotation = kin.frame_pose(arm, "flange")
    np.testing.assert_allclose(position, dh_product(np.asarray(arm.q0))[:3, 3], atol=1e-12)
    np.testing.assert_allclose(rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-12)
    _, hand = kin.frame_pose(arm, "hand")
    quarter = Rotation.from_euler("z", -np.pi / 4).as_matrix()
    np.testing.assert_allclose(hand, rotation @ quarter, atol=1e-12)

"""Moving along the configuration manifold against MuJoCo C, and its derivatives where they are hard."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_files import mjcf
from refusals import refuses

import osik_jax as osik

MODEL = mjcf("manifold")
ROTATIONS = {"root": slice(3, 6), "shoulder": slice(6, 9)}
QUATERNIONS = {"root": slice(3, 7), "shoulder": slice(7, 11)}


@pytest.fixture(scope="module")
def robot() -> osik.Robot:
    return osik.Robot.from_mjmodel(mujoco.MjModel.from_xml_string(MODEL))


@pytest.fixture(scope="module")
def integrate(robot):
    return jax.jit(jax.vmap(lambda q, v, dt: osik.integrate(robot, q, v, dt)))


@pytest.fixture(scope="module")
def difference(robot):
    return jax.jit(jax.vmap(lambda qa, qb: osik.difference(robot, qa, qb)))


def slopes_of(function):
    """Return a program of the Jacobians of a function of two arguments by both of them, in both modes."""
    return jax.jit(lambda *at: [mode(function, argnums=(0, 1))(*at) for mode in (jax.jacfwd, jax.jacrev)])


@pytest.fixture(scope="module")
def integrate_slopes(robot):
    return slopes_of(lambda q, v: osik.integrate(robot, q, v))


@pytest.fixture(scope="module")
def difference_slopes(robot):
    return slopes_of(lambda qa, qb: osik.difference(robot, qa, qb))


def random_configurations(robot: osik.Robot, rng: np.random.Generator, count: int) -> np.ndarray:
    q = rng.normal(size=(count, robot.nq))
    for part in QUATERNIONS.values():
        q[:, part] /= np.linalg.norm(q[:, part], axis=1, keepdims=True)
    return q


def by_mujoco_integrate(model: mujoco.MjModel, q: np.ndarray, v: np.ndarray, dt: float) -> np.ndarray:
    out = q.copy()
    mujoco.mj_integratePos(model, out, v, dt)
    return out


def by_mujoco_difference(model: mujoco.MjModel, qa: np.ndarray, qb: np.ndarray) -> np.ndarray:
    out = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, qa, qb)
    return out


def turned(robot: osik.Robot, q: np.ndarray, joint: str, angle: float) -> np.ndarray:
    """Configuration q with one joint turned by an angle about a fixed axis of the body, by MuJoCo."""
    v = np.zeros(robot.nv)
    v[ROTATIONS[joint]] = angle * np.array([0.48, -0.6, 0.64])
    return by_mujoco_integrate(robot.mj_model, q, v, 1.0)


def same_rotations(robot: osik.Robot, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Configurations b with quaternions on the side of a's: q and -q are one rotation."""
    b = np.array(b)
    for part in QUATERNIONS.values():
        b[..., part] *= np.sign(np.sum(a[..., part] * b[..., part], -1, keepdims=True))
    return b


@pytest.mark.parametrize("speed", [0.0, 1e-9, 1e-4, 1.0, 30.0])
def test_integrate_equals_mujoco(robot, integrate, rng, speed):
    q = random_configurations(robot, rng, 20)
    v, dt = speed * rng.normal(size=(20, robot.nv)), rng.uniform(0.001, 1.0, 20)
    expected = np.array([by_mujoco_integrate(robot.mj_model, *row) for row in zip(q, v, dt, strict=True)])
    actual = integrate(q, v, dt)
    np.testing.assert_allclose(same_rotations(robot, expected, actual), expected, atol=1e-12, rtol=0)


def test_difference_equals_mujoco(robot, difference, rng):
    qa, qb = random_configurations(robot, rng, 50), random_configurations(robot, rng, 50)
    expected = np.array([by_mujoco_difference(robot.mj_model, *row) for row in zip(qa, qb, strict=True)])
    np.testing.assert_allclose(difference(qa, qb), expected, atol=1e-12, rtol=0)


@pytest.mark.parametrize("joint", ROTATIONS)
def test_difference_equals_mujoco_near_zero_and_near_pi(robot, difference, rng, joint):
    angles = [0.0, 1e-12, 1e-8, 1e-5, 1e-3, np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-9, np.pi + 1e-6, 5.0]
    qa = random_configurations(robot, rng, len(angles))
    qb = np.array([turned(robot, *row) for row in zip(qa, [joint] * len(angles), angles, strict=True)])
    expected = np.array([by_mujoco_difference(robot.mj_model, *row) for row in zip(qa, qb, strict=True)])
    np.testing.assert_allclose(difference(qa, qb), expected, atol=1e-12, rtol=0)


def test_quaternions_of_any_length_come_back_as_unit_quaternions(robot, integrate, difference, rng):
    q, other = random_configurations(robot, rng, 10), random_configurations(robot, rng, 10)
    v = rng.normal(size=(10, robot.nv))
    long = q.copy()
    for part in QUATERNIONS.values():
        long[:, part] *= 3.0
    actual = integrate(long, v, np.ones(10))
    np.testing.assert_allclose(actual, integrate(q, v, np.ones(10)), atol=1e-12, rtol=0)
    for part in QUATERNIONS.values():
        np.testing.assert_allclose(np.linalg.norm(actual[:, part], axis=1), 1.0, atol=1e-14)
    np.testing.assert_allclose(difference(long, other), difference(q, other), atol=1e-12, rtol=0)


def central_differences(function, inputs: tuple[np.ndarray, ...], argument: int) -> np.ndarray:
    """Return the derivative of a batched function by one of its arguments."""
    step, size = 1e-6, len(inputs[argument])
    moves = step * np.concatenate([np.eye(size), -np.eye(size)])
    wide = [np.broadcast_to(x, (len(moves), len(x))) for x in inputs]
    wide[argument] = wide[argument] + moves
    moved = np.asarray(function(*wide))
    return (moved[:size] - moved[size:]).T / (2 * step)


@pytest.mark.parametrize("angle", [0.0, 1e-12, 1e-6, 1e-3, 1.0, np.pi - 1e-3])
def test_derivative_of_integrate_equals_central_differences(robot, integrate, integrate_slopes, rng, angle):
    q = random_configurations(robot, rng, 1)[0]
    v = np.zeros(robot.nv)
    for part in ROTATIONS.values():
        v[part] = angle * np.array([0.48, -0.6, 0.64])
    for argument in range(2):
        numeric = central_differences(lambda q, v: integrate(q, v, np.ones(len(q))), (q, v), argument)
        for actual in integrate_slopes(q, v):
            np.testing.assert_allclose(actual[argument], numeric, atol=1e-8, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 1e-2, 1.0, 3.0, np.pi - 1e-3])
@pytest.mark.parametrize("argument", [0, 1])
def test_derivative_of_difference_equals_central_differences(
    robot, difference, difference_slopes, rng, angle, argument
):
    qa = random_configurations(robot, rng, 1)[0]
    qb = turned(robot, turned(robot, qa, "root", angle), "shoulder", angle)
    numeric = central_differences(difference, (qa, qb), argument)
    for actual in difference_slopes(qa, qb):
        np.testing.assert_allclose(actual[argument], numeric, atol=1e-7, rtol=1e-8)


@pytest.mark.parametrize("angle", [0.0, 1e-300, 1e-16, np.pi - 1e-12, np.pi, np.pi + 1e-12])
def test_gradients_are_finite_and_bounded_where_rotations_are_singular(
    robot, integrate_slopes, difference_slopes, angle
):
    """The derivative of the logarithm by the quaternion grows to pi at half a turn, and no further."""
    qa = robot.q0
    qb = jnp.asarray(turned(robot, turned(robot, np.asarray(qa), "root", angle), "shoulder", angle))
    for by_qa, _ in difference_slopes(qa, qb):
        assert np.abs(by_qa).max() < np.pi + 1e-6
    for _, by_v in integrate_slopes(qa, osik.difference(robot, qa, qb)):
        assert np.abs(by_v).max() < 1.0 + 1e-6


def test_single_precision_equals_mujoco(rng):
    with jax.enable_x64(False):
        robot = osik.Robot.from_mjmodel(mujoco.MjModel.from_xml_string(MODEL))
        qa, qb = (random_configurations(robot, rng, 20).astype(np.float32) for _ in range(2))
        v = rng.normal(size=(20, robot.nv)).astype(np.float32)

        @jax.jit
        @jax.vmap
        def all_of(qa, qb, v):
            gradient = jax.jacrev(lambda q: osik.difference(robot, q, q))(qa)
            return osik.integrate(robot, qa, v), osik.difference(robot, qa, qb), gradient

        moved, gap, gradient = all_of(qa, qb, v)
        assert moved.dtype == gap.dtype == jnp.float32
    qa, qb, v = (x.astype(float) for x in (qa, qb, v))
    expected = np.array([by_mujoco_integrate(robot.mj_model, *row, 1.0) for row in zip(qa, v, strict=True)])
    np.testing.assert_allclose(same_rotations(robot, expected, np.asarray(moved)), expected, atol=1e-5, rtol=0)
    expected = np.array([by_mujoco_difference(robot.mj_model, *row) for row in zip(qa, qb, strict=True)])
    np.testing.assert_allclose(gap, expected, atol=1e-5, rtol=0)
    np.testing.assert_allclose(gradient, 0.0, atol=1e-5)


def test_followers_and_locked_joints_have_no_entries(rng):
    """NAO's v moves q entry by entry; the full configuration moves as MuJoCo moves it with both hips at one speed."""
    robot = osik.load_robot("nao")
    v = rng.uniform(-0.5, 0.5, robot.nv)
    full = np.zeros(robot.mj_model.nv)
    for name in ("RHipYawPitch", *robot.joint_names):
        full[robot.mj_model.joint(name).dofadr[0]] = v[robot.joint_dof_index(name)]
    full[:6] = v[:6]
    expected = by_mujoco_integrate(robot.mj_model, np.array(robot.mujoco_qpos(robot.q0)), full, 0.1)
    actual = robot.mujoco_qpos(osik.integrate(robot, robot.q0, v, 0.1))
    np.testing.assert_allclose(actual, expected, atol=1e-12, rtol=0)


def test_precision_and_integers(robot):
    still = osik.integrate(robot, robot.q0.astype(jnp.float32), jnp.zeros(robot.nv))
    assert still.dtype == jnp.float64
    whole = [0, 0, 1, 1, 0, 0, 0, 1, 0, 0, 0, 0, 0]
    moved = osik.integrate(robot, jnp.array(whole), jnp.full(robot.nv, 0.25))
    np.testing.assert_allclose(moved[:3], [0.25, 0.25, 1.25], atol=1e-15)
    np.testing.assert_allclose(osik.difference(robot, jnp.array(whole), moved), 0.25, atol=1e-14)


def test_wrong_input_is_named(robot):
    q = robot.q0
    refuses(ValueError, r"q has shape \(14,\)", osik.difference, robot, q, jnp.append(q, 0.0))
    refuses(ValueError, "the quaternion of joint 'shoulder', is zero", osik.difference, robot, q.at[7:11].set(0.0), q)


def test_lists_are_configurations():
    arm = osik.load_robot("arm7")
    q, v = np.linspace(0.0, 0.3, arm.nq), np.linspace(0.1, 0.7, arm.nv)
    moved = osik.integrate(arm, q.tolist(), v.tolist(), 0.5)
    np.testing.assert_allclose(moved, q + 0.5 * v, rtol=1e-15)
    np.testing.assert_allclose(osik.difference(arm, q.tolist(), [float(angle) for angle in moved]), 0.5 * v, rtol=1e-12)
    refuses(ValueError, "not finite at indices", jax.jit(lambda v: osik.integrate(arm, np.full(7, np.nan), v)), v)
    refuses(ValueError, r"q has shape \(\)", osik.integrate, arm, None, v)

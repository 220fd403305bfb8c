"""Quaternions and matrices rounded to a few digits are rotations; zeros and NaN are none, traced or not."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refuses
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.numerics._rotations import exact_quaternion, exact_rotation
from osik_jax.retargeting import HumanMotion

POINT = np.array([0.5, 0.1, 0.3])
MATRICES = Rotation.random(50, random_state=0).as_matrix()
SPOILT = [np.zeros((3, 3)), np.full((3, 3), np.nan), 2.0 * MATRICES[0], -MATRICES[0], 1.05 * MATRICES[0]]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_rounded_matrix_becomes_the_nearest_rotation(dtype):
    """The polar factor, from SciPy's singular values; traced and not, one and many."""
    given = np.concatenate([MATRICES.round(2), MATRICES.round(3), 1.019 * MATRICES, MATRICES + 0.005])
    given = given[np.abs(given @ np.swapaxes(given, 1, 2) - np.eye(3)).max((1, 2)) < 0.04]
    nearest = np.array([polar(matrix)[0] for matrix in given])
    scale = float(jnp.finfo(dtype).eps)
    for ours in (exact_rotation(jnp.asarray(given, dtype), "R"), jax.jit(lambda m: exact_rotation(m, "R"))(given)):
        np.testing.assert_allclose(ours, nearest, atol=32 * scale)
    one = jax.jit(lambda m: exact_rotation(m, "R"))(jnp.asarray(given[0], dtype))
    np.testing.assert_allclose(one, nearest[0], atol=32 * scale)
    np.testing.assert_array_equal(exact_rotation(jnp.asarray(MATRICES), "R"), MATRICES)


@pytest.mark.parametrize("value", [[0.707, 0.0, 0.707, 0.0], [0.71, 0.0, 0.71, 0.0], [-0.577, 0.577, 0.577, 0.0]])
def test_rounded_quaternions(arm, value):
    true = Rotation.from_quat(value, scalar_first=True).as_matrix()
    if abs(np.linalg.norm(value) - 1.0) > 0.02:
        refuses(ValueError, "quaternion is not one", osik.FrameTask, arm, "hand", target=(POINT, value))
        return
    made = osik.FrameTask(arm, "hand", target=(POINT, value))
    np.testing.assert_allclose(made.target[1], true, atol=1e-15)
    np.testing.assert_allclose(made.replace(target=(POINT, np.array(value))).target[1], true, atol=1e-15)
    np.testing.assert_allclose(
        jax.jit(lambda q: made.replace(target=(POINT, q)).target[1])(np.array(value)), true, atol=1e-15
    )
    np.testing.assert_allclose(exact_quaternion(jnp.array([value] * 2), "q"), [value / np.linalg.norm(value)] * 2)


@pytest.mark.slow
def test_bad_lanes_get_a_status_and_the_others_their_answer(arm):
    """Under jit, in one call: five matrices that are no rotation beside three that are, one of them rounded."""
    task = osik.FrameTask(arm, "hand")
    given = np.array([*SPOILT, MATRICES[0], MATRICES[0].round(3), MATRICES[1]])
    both = jax.jit(jax.vmap(lambda R: osik.solve(arm, arm.q0, {"hand": task.replace(target=(POINT, R))})))(given)
    by_targets = jax.jit(jax.vmap(lambda R: osik.solve(arm, arm.q0, {"hand": task}, targets={"hand": (POINT, R)})))(
        given
    )
    for answer in (both, by_targets):
        assert (np.asarray(answer.status)[:5] == osik.Status.NUMERICAL_ERROR).all()
        assert (np.asarray(answer.status)[5:] == osik.Status.SOLVED).all()
        np.testing.assert_array_equal(answer.velocity[:5], 0.0)
        np.testing.assert_allclose(answer.velocity[6], answer.velocity[5], atol=0.05)
    gradient = jax.jacobian(lambda R: osik.solve(arm, arm.q0, {"hand": task.replace(target=(POINT, R))}).velocity)
    assert np.isfinite(jax.vmap(gradient)(given)).all()


def test_outside_jit_they_are_refused(arm):
    for spoilt in SPOILT:
        refuses(ValueError, "rotation is not one", osik.FrameTask, arm, "hand", target=(POINT, spoilt))
        with pytest.raises(ValueError, match=r"targets\['hand'\]: rotations that are none: \[1\]"):
            osik.inverse_kinematics(arm, {"hand": (np.tile(POINT, (2, 1)), np.array([MATRICES[0], spoilt]))})
    refuses(ValueError, "rotation is not one", osik.CollisionShape.box, (0.1, 0.1, 0.1), rotation=np.zeros((3, 3)))


@pytest.mark.slow
def test_inverse_kinematics_takes_what_is_rounded(arm):
    """The answer is that of the exact rotation, for one, many and traced targets; a traced zero is not found."""
    pose = osik.forward_kinematics(arm, arm.q0).frame_pose(arm, "hand")
    rounded = np.asarray(pose[1]).round(3)
    options: Any = dict(seeds=4, restarts=0, q0=arm.q0)
    for rotations in (rounded[None], Rotation.from_matrix(rounded).as_quat(scalar_first=True)[None].round(3)):
        found = osik.inverse_kinematics(arm, {"hand": (np.asarray(pose[0])[None], rotations)}, **options)
        assert found.converged.all() and found.orientation_error.max() < 1e-2
    run = jax.jit(lambda R: osik.inverse_kinematics(arm, {"hand": (pose[0], R)}, seeds=4, steps=10, q0=arm.q0))
    assert run(rounded).converged
    lost = run(np.zeros((3, 3)))
    assert not lost.converged and np.isfinite(lost.q).all()


def test_motions_of_people_are_normalised():
    exact = Rotation.random(6, random_state=1).as_quat(scalar_first=True).reshape(3, 2, 4)
    motion = HumanMotion("clip", 30.0, ("hips", "spine"), np.zeros((3, 2, 3)), exact.round(2))
    assert motion.rotations is not None
    np.testing.assert_allclose(np.linalg.norm(motion.rotations, axis=-1), 1.0, atol=1e-15)
    assert np.abs(motion.rotations - exact).max() < 0.01
    for spoilt in (0.0 * exact, 1.1 * exact, np.nan * exact):
        refuses(ValueError, "rotations", HumanMotion, "clip", 30.0, ("hips", "spine"), np.zeros((3, 2, 3)), spoilt)

"""A clutch between a held device and a frame: relative motion alone, and no motion by pressing or releasing."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik

NOWHERE = np.full(3, np.nan), np.full((3, 3), np.nan)


def pose(seed: int, turn: float = 0.6) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=3), Rotation.from_rotvec(turn * rng.normal(size=3)).as_matrix()


def test_motion_since_the_press_is_scaled_turned_and_added():
    """By scipy: positions scaled, rotations about the world's axes."""
    frame, start, now = pose(0), pose(1), pose(2)
    axes = Rotation.from_euler("z", 0.7)
    clutch = osik.Clutch(frame, scale=0.4, axes=axes.as_matrix())
    clutch, target = clutch.step(True, start, frame)
    np.testing.assert_allclose(target[0], frame[0], atol=1e-15)
    np.testing.assert_allclose(target[1], frame[1], atol=1e-15)
    _, target = clutch.step(True, now, frame)
    turn = axes * Rotation.from_matrix(now[1]) * Rotation.from_matrix(start[1]).inv() * axes.inv()
    np.testing.assert_allclose(target[0], frame[0] + 0.4 * axes.apply(now[0] - start[0]), atol=1e-14)
    np.testing.assert_allclose(target[1], (turn * Rotation.from_matrix(frame[1])).as_matrix(), atol=1e-14)


def test_an_open_clutch_lets_the_device_move_freely():
    frame, clutch = pose(0), osik.Clutch(pose(0))
    for seed in range(1, 4):
        clutch, target = clutch.step(False, pose(seed), frame)
        np.testing.assert_array_equal(target[0], frame[0])
    clutch, _ = clutch.step(True, pose(4), frame)
    step = np.array([0.01, 0.02, 0.03])
    clutch, target = clutch.step(True, (pose(4)[0] + step, pose(4)[1]), frame)
    np.testing.assert_allclose(target[0], frame[0] + step, atol=1e-15)


@pytest.mark.slow
@pytest.mark.variants(release=["True-position", "False-position", "False-pose"])
@pytest.mark.parametrize("rows", ["pose", "position"])
@pytest.mark.parametrize("reachable", [True, False])
def test_pressing_again_with_a_still_hand_moves_nothing(arm, rows, reachable):
    """The arm has come to rest, a little off its target where the posture pulls; the clutch opens, the device goes
    elsewhere, the clutch closes."""
    tasks = {"hand": osik.FrameTask(arm, "hand", rows=rows), "posture": osik.PostureTask(arm, weight=0.03)}
    clutch, q = osik.Clutch(hand(arm, arm.q0)), arm.q0
    way = np.array([0.02, -0.1, 0.03]) if reachable else np.array([0.0, 0.0, 3.0])
    device = pose(1)
    for pressed, there, steps in ((True, device, 1), (True, (device[0] + way, device[1]), 2500)):
        clutch, q = moved(arm, tasks, clutch, q, pressed, there, steps)
    still = q
    for pressed, there in ((False, pose(2)), (True, pose(3)), (True, pose(3)), (False, pose(4)), (True, pose(5))):
        clutch, q = moved(arm, tasks, clutch, q, pressed, there, 20)
    assert np.abs(np.asarray(q - still)).max() < 1e-4
    off = np.linalg.norm(np.asarray(clutch.target[0] - hand(arm, q)[0]))
    assert (0.005 < off < 0.1) if reachable else (off > 2.0)


def hand(arm, q):
    return osik.forward_kinematics(arm, q).frame_pose(arm, "hand")


def moved(arm, tasks, clutch, q, pressed, device, steps):
    """The clutch and the configuration after some steps with one pose of the device."""

    @jax.jit
    def several(clutch, q):
        def one(state, _):
            clutch, q = state
            clutch, target = clutch.step(pressed, device, hand(arm, q))
            velocity = osik.solve(arm, q, tasks, targets={"hand": target}, dt=0.01).velocity
            return (clutch, osik.integrate(arm, q, 0.01 * velocity)), None

        return jax.lax.scan(one, (clutch, q), None, length=steps)[0]

    return several(clutch, q)


def test_a_release_stops_a_frame_that_moves_and_keeps_the_target_of_one_that_rests():
    frame, device = pose(0), pose(1)
    clutch, _ = osik.Clutch(frame).step(True, device, frame)
    clutch, _ = clutch.step(True, (device[0] + 0.1, device[1]), frame)
    behind = frame[0] + 0.04, frame[1]
    released, target = clutch.step(False, device, behind)
    np.testing.assert_array_equal(target[0], behind[0])
    np.testing.assert_array_equal(released.step(False, device, frame)[1][0], behind[0])
    np.testing.assert_allclose(clutch.step(False, device, frame)[1][0], frame[0] + 0.1, atol=1e-15)
    turned = frame[0], Rotation.from_rotvec([0.0, 0.01, 0.0]).as_matrix() @ frame[1]
    np.testing.assert_array_equal(clutch.step(False, device, turned)[1][1], turned[1])


@pytest.mark.parametrize("lost", [NOWHERE, (np.zeros(3), np.zeros(4)), np.full((4, 4), np.inf)])
def test_a_device_that_is_not_tracked_opens_the_clutch(lost):
    frame, device = pose(0), pose(1)
    clutch, _ = osik.Clutch(frame).step(True, device, frame)
    clutch, target = clutch.step(True, lost, frame)
    assert not clutch.engaged
    np.testing.assert_array_equal(target[0], frame[0])
    clutch, target = clutch.step(True, pose(2), frame)  # it comes back elsewhere
    assert clutch.engaged
    np.testing.assert_allclose(target[0], frame[0], atol=1e-15)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(clutch))


def test_poses_in_every_form_batches_and_gradients():
    frame, start, now = pose(0), pose(1), pose(2)
    clutch, _ = osik.Clutch(frame).step(True, start, frame)
    wanted = clutch.step(True, now, frame)[1]
    rigid = jaxlie.SE3.from_rotation_and_translation(jaxlie.SO3.from_matrix(jnp.asarray(now[1])), jnp.asarray(now[0]))
    for form in (rigid, rigid.as_matrix(), (now[0], rigid.rotation().wxyz)):
        np.testing.assert_allclose(clutch.step(True, form, frame)[1][1], wanted[1], atol=1e-12)
    scales = jnp.array([0.5, 2.0])
    many = jax.vmap(lambda s: clutch.replace(scale=s).step(True, now, frame)[1][0])(scales)
    np.testing.assert_allclose(many, frame[0] + scales[:, None] * (now[0] - start[0]), atol=1e-14)
    slope = jax.jacobian(lambda p: clutch.step(True, (p, now[1]), frame)[1][0])(jnp.asarray(now[0]))
    np.testing.assert_allclose(slope, np.eye(3), atol=1e-14)


def test_what_is_wrong_is_refused():
    refuses(ValueError, "scale is -1", osik.Clutch, pose(0), scale=-1.0)
    refuses(ValueError, r"shape \(3,\)", osik.Clutch(pose(0)).step, True, np.zeros(3), pose(0))
    refuses(ValueError, "scale is 0", osik.Clutch(pose(0)).replace, scale=0.0)

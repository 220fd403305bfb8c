"""A filter of poses: motions without lag, the variance of the closed form, and a loop that is fed its velocity."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax.motion import PoseFilter

DT, STEPS = 0.02, 400
START = np.array([0.3, 0.1, 0.5]), Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()


@jax.jit
def filtered(own, positions, rotations):
    def step(own, pose):
        own, pose, velocity = own.update(pose, DT)
        return own, (*pose, velocity)

    return jax.lax.scan(step, own, (positions, rotations))[1]


def turning(rate, steps=STEPS):
    return Rotation.from_rotvec(DT * np.arange(1, steps + 1)[:, None] * rate).as_matrix() @ START[1]


def test_a_constant_velocity_is_followed_without_lag() -> None:
    linear, angular = np.array([0.2, -0.1, 0.3]), np.array([1.0, 2.0, -0.5])
    positions = START[0] + DT * np.arange(1, STEPS + 1)[:, None] * linear
    p, r, v = filtered(PoseFilter(START), positions, turning(angular))
    np.testing.assert_allclose(p[-1], positions[-1], atol=1e-9)
    np.testing.assert_allclose(r[-1], turning(angular)[-1], atol=1e-9)
    np.testing.assert_allclose(v[-1], [*linear, *angular], atol=1e-9)
    p, _, v = filtered(PoseFilter(START, velocity=[*linear, *angular]), positions, turning(angular))
    np.testing.assert_allclose(p, positions, atol=1e-12)  # from the first sample on


def test_positions_and_velocities_are_those_of_the_transfer_function(rng) -> None:
    """``g = 1 - t^2, h = (1 - t)^2``: both poles are at t, by SciPy's recursion."""
    seen = START[0] + 1e-3 * rng.normal(size=(STEPS, 3))
    p, _, v = filtered(PoseFilter(START, time_constant=0.08), seen, np.tile(START[1], (STEPS, 1, 1)))
    t = np.exp(-DT / 0.08)
    g, h, poles = 1.0 - t**2, (1.0 - t) ** 2, [1.0, -2.0 * t, t**2]
    np.testing.assert_allclose(p, START[0] + lfilter([g, h - g], poles, seen - START[0], axis=0), atol=1e-12)
    np.testing.assert_allclose(v[:, :3], lfilter([h / DT, -h / DT], poles, seen - START[0], axis=0), atol=1e-12)


def test_a_missing_pose_lets_the_velocity_fade() -> None:
    positions = np.full((STEPS, 3), np.nan)
    rotations = np.tile(START[1], (STEPS, 1, 1))
    p, r, v = filtered(PoseFilter(START, velocity=[0.5, 0, 0, 0, 0, 1.0]), positions, rotations)
    assert np.isfinite(p).all() and np.isfinite(r).all()
    np.testing.assert_allclose(v[:, 0], 0.5 * np.exp(-DT * np.arange(1, STEPS + 1) / 0.1), atol=1e-12)
    np.testing.assert_allclose(p[-1] - START[0], [0.5 * DT / (1.0 - np.exp(-DT / 0.1)), 0.0, 0.0], atol=1e-9)


def test_many_filters_in_one_call_and_derivatives(rng) -> None:
    positions = START[0] + 1e-2 * rng.normal(size=(3, STEPS, 3))
    rotations = np.tile(turning(np.array([0.0, 1.0, 0.0])), (3, 1, 1, 1))
    own = PoseFilter(START)
    many = jax.vmap(lambda p, r: filtered(own, p, r))(positions, rotations)
    for found, wanted in zip(many, filtered(own, positions[1], rotations[1]), strict=True):
        np.testing.assert_allclose(found[1], wanted, atol=1e-12)

    def end(constant):
        return jnp.sum(filtered(own.replace(time_constant=constant), positions[0], rotations[0])[2][-1])

    slope = (end(0.1 + 1e-6) - end(0.1 - 1e-6)) / 2e-6
    np.testing.assert_allclose(jax.grad(end)(0.1), slope, rtol=1e-5)


def test_its_velocity_lets_a_low_gain_follow_and_stay_calm(rng) -> None:
    """Against the raw poses with gain 20: less than half the error at less than a third of the acceleration."""
    arm = osik.load_robot("arm7")
    hand = osik.FrameTask(arm, "hand", gain=10.0)
    wave = 0.1 * np.sin(DT * np.arange(STEPS))
    true = np.asarray(hand.target[0]) + wave[:, None] * np.array([0.0, 1.0, 0.5])
    seen = true + 1e-3 * rng.normal(size=true.shape)

    @jax.jit
    def run(gain, use):
        def step(state, seen):
            q, own = state
            own, (place, turn), velocity = own.update((seen, hand.target[1]), DT)
            place, velocity = jnp.where(use, place, seen), jnp.where(use, velocity, 0.0)
            task = hand.replace(target=(place, turn), target_velocity=velocity, gain=gain)
            v = osik.solve(arm, q, {"hand": task}, dt=DT).velocity
            q = osik.integrate(arm, q, v, DT)
            return (q, own), (v, osik.forward_kinematics(arm, q).frame_pose(arm, "hand")[0])

        return jax.lax.scan(step, (arm.q0, PoseFilter(hand.target, time_constant=0.08)), seen)[1]

    def measured(gain, use):
        v, place = map(np.asarray, run(gain, use))
        error = np.linalg.norm(place[:-1] - true[1:], axis=1)[50:]
        return np.sqrt((error**2).mean()), np.sqrt((np.diff(v, axis=0)[50:] ** 2).mean()) / DT

    raw, smooth = measured(20.0, False), measured(10.0, True)
    assert raw[0] > 2.0 * smooth[0] and raw[1] > 3.0 * smooth[1]


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: PoseFilter(START, time_constant=0.0), "time_constant is 0; it is positive"),
        (lambda: PoseFilter(START, velocity=np.zeros(3)), "velocity"),
        (lambda: PoseFilter(np.zeros(5)), "4, 4"),
        (lambda: PoseFilter(START).update(START, 0.0), "dt is 0; it is the positive time"),
        (lambda: PoseFilter(START).update(START, -0.02), "dt is -0.02"),
    ],
)
def test_what_cannot_be_is_refused(call, message) -> None:
    with pytest.raises(osik.OsikError, match=message):
        call()

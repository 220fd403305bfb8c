"""Retargeting frame by frame: beside the whole clip, and with a stream that is noisy and has holes."""

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from motion_files import bent_forward, dancer, write_bvh
from small_robots import assert_limits_hold, nao_soles

import osik_jax as osik
from benchmarks.replayed import replay
from osik_jax.retargeting import LiveRetargeter, load_motion, report, retarget
from osik_jax.retargeting._live import LiveStatus
from osik_jax.retargeting._stance import Stance, hold_feet
from osik_jax.retargeting._terms import soles

FPS, LOOK_AHEAD = 30.0, 5


@pytest.fixture(scope="module")
def motion(tmp_path_factory):
    return load_motion(write_bvh(tmp_path_factory.mktemp("clips") / "dance.bvh", dancer(45), 0.01))


@pytest.fixture(scope="module")
def live(nao, motion):
    """One retargeter for all tests, since each compiles for seconds; ``reset`` comes first."""
    return LiveRetargeter(nao, motion, look_ahead=LOOK_AHEAD / FPS)


def streamed(live, frames):
    live.reset()
    found = [live.step(frame) for frame in frames]
    assert all(frame is None for frame in found[: live.frames_ahead])
    return [frame for frame in found if frame is not None] + live.finish()


def joints_of(robot, q):
    return np.array(q)[:, [robot.joint_qpos_index(name) for name in robot.joint_names]]


def assert_inside(robot, frames, fps, acceleration=240.0):
    assert_limits_hold(robot, joints_of(robot, [frame.q for frame in frames]), fps, acceleration)


@pytest.mark.release
def test_the_centre_of_mass_stays_over_the_feet_frame_by_frame(nao, motion):
    margins = []
    for balance in (None, 0.01):
        make = partial(LiveRetargeter, nao, look_ahead=LOOK_AHEAD / FPS, balance=balance)
        margins.append(report(replay(make, bent_forward(motion))[0])["balance"]["com_margin_mm_min"])
    assert margins[0] < -5.0 and margins[1] > 10.0 - 0.5


@pytest.mark.slow
def test_frame_by_frame_is_near_the_whole_clip(nao, motion, live):
    whole = retarget(nao, motion)
    result, frames = replay(lambda _: live, motion)
    assert len(frames) == motion.frames and live.latency == pytest.approx(LOOK_AHEAD / motion.fps)
    assert {frame.status for frame in frames} == {LiveStatus.FOLLOWED}
    apart = np.degrees(np.abs(joints_of(nao, [frame.q for frame in frames]) - joints_of(nao, whole.q)))
    assert apart.mean() < 1.0
    figures, best = report(result), report(whole)
    assert figures["feet"]["slip_mm_max"] < 0.1
    assert figures["feet"]["float_mm_max"] < 0.1 and figures["feet"]["below_floor_mm_max"] < 0.1
    assert figures["tracking"]["segment_angle_deg_mean"] < best["tracking"]["segment_angle_deg_mean"] + 0.5
    assert_inside(nao, frames, motion.fps)


@pytest.mark.slow
def test_feet_hold_exactly_at_any_rate_with_few_iterations(nao, motion):
    """MuJoCo's feet, from the written positions; three iterations of a plan leave millimetres by themselves."""
    fast = motion.resampled(120.0)
    live = LiveRetargeter(nao, fast, iterations=3)
    assert live.frames_ahead == 32 and live.latency == pytest.approx(32 / 120)
    frames = streamed(live, fast.positions[:50])
    assert len(frames) == 50 and max(frame.iterations for frame in frames) <= 3
    corners = nao_soles(nao, [np.asarray(nao.mujoco_qpos(frame.q)) for frame in frames])
    assert all(frame.contact.all() for frame in frames)
    assert np.abs(corners[..., 2]).max() < 2e-6 and np.ptp(corners[..., :2], axis=0).max() < 4e-6
    assert max(frame.feet_off for frame in frames) < 2e-6
    assert_inside(nao, frames, 120.0)


@pytest.mark.slow
def test_a_step_whose_bounds_let_no_foot_hold_is_no_worse_than_planned(nao, live, rng):
    """A free base, as after a jump of the plan, and three joints in four that are hardly free; soles by MuJoCo."""
    cases, base = 60, 6
    step = np.concatenate([rng.normal(size=(cases, base)) * 1e-3, rng.normal(size=(cases, nao.nv - base)) * 1e-3], 1)
    room = np.where(rng.random(step.shape) < 0.75, 1e-5, 0.02) * rng.random(step.shape)
    lower, upper = step - room, step + np.where(rng.random(step.shape) < 0.5, 0.0, room)
    points = soles(live._body, osik.forward_kinematics(nao, nao.q0))[0].reshape(4, 2, 3).mean(1)
    stance = Stance(points[:, :2], jnp.ones(4, bool))

    @jax.jit
    @partial(jax.vmap, in_axes=(0, 0, 0))
    def held(step, lower, upper):
        found = hold_feet(live._body, nao.q0, step, lower, upper, jnp.ones(4, bool), stance)
        return osik.integrate(nao, nao.q0, found.step), found.step, found.off

    q, found, off = (np.asarray(part) for part in held(step, lower, upper))
    planned = np.asarray(held(step, step, step)[2])
    assert (found >= lower - 1e-15).all() and (found <= upper + 1e-15).all()
    assert (off <= planned * (1.0 + 1e-9)).all() and (off < 0.5 * planned).any() and off.max() > 1e-4
    corners = nao_soles(nao, [np.asarray(nao.mujoco_qpos(one)) for one in q])
    assert (np.abs(corners[..., 2]).max(1) <= off + 1e-9).all()


def lifted_until(motion, frame, count, aside):
    """Positions in which the left foot is lifted, and said to stand from a frame on; (count, J, 3) and (count, 4)."""
    positions = np.repeat(motion.positions[:1], count, 0)
    for name, shift in (
        ("LeftLeg", [aside, 0.0, 0.2]),
        ("LeftFoot", [0.1, 0.0, 0.3]),
        ("LeftToeBase", [0.1, 0.0, 0.3]),
    ):
        positions[:frame, motion.joint_names.index(name)] += shift
    return positions, np.array([[f >= frame, f >= frame, True, True] for f in range(count)])


@pytest.mark.release
def test_a_foot_that_cannot_land_in_time_is_told(nao, motion):
    """A foot that was lifted is said to stand from one frame to the next; heights are MuJoCo's."""
    live = LiveRetargeter(nao, motion, look_ahead=1 / FPS, acceleration=20.0)
    live.reset()
    found = [live.step(*seen) for seen in zip(*lifted_until(motion, 12, 24, 0.3), strict=True)]
    frames = [frame for frame in found if frame is not None] + live.finish()
    told = [f for f, frame in enumerate(frames) if frame.status is LiveStatus.FEET_OFF]
    assert told[0] == 12 and all((frame.feet_off > 1e-3) == (f in told) for f, frame in enumerate(frames))
    height = np.abs(nao_soles(nao, [np.asarray(nao.mujoco_qpos(frames[12].q))])[..., 2]).max()
    assert frames[12].feet_off == pytest.approx(height, abs=1e-3) and height > 5e-3
    assert_inside(nao, frames, motion.fps, 20.0)


@pytest.mark.slow
def test_limits_hold_on_a_noisy_stream_with_holes(nao, motion, live):
    rng = np.random.default_rng(0)
    noisy = motion.positions + rng.normal(scale=0.03, size=motion.positions.shape)
    noisy[rng.random(noisy.shape[:2]) < 0.1] = np.nan
    noisy[20] += [3.0, 0.0, 1.0]  # a frame in which somebody else was seen
    gone = rng.random(len(noisy)) < 0.15
    frames = streamed(live, [None if lost else seen for lost, seen in zip(gone, noisy, strict=True)])
    assert len(frames) == motion.frames and np.isfinite([frame.q for frame in frames]).all()
    assert LiveStatus.FILLED in {frame.status for frame in frames}
    assert_inside(nao, frames, motion.fps)


@pytest.mark.slow
def test_a_person_who_is_lost_leaves_the_robot_at_rest(nao, motion, live):
    frames = streamed(live, [*motion.positions[:20], *[None] * 25])
    assert [frame.status for frame in frames][-20:] == [LiveStatus.LOST] * 20
    q = joints_of(nao, [frame.q for frame in frames])
    assert np.abs(np.diff(q[-5:], axis=0)).max() * motion.fps < 0.02  # rad/s
    assert np.abs(np.diff(q[:20], axis=0)).max() * motion.fps > 0.5
    assert_inside(nao, frames, motion.fps)


def test_short_streams_and_wrong_frames(nao, motion, live):
    live.reset()
    assert live.finish() == []
    assert live.step(motion.positions[0]) is None and len(live.finish()) == 1
    live.reset()
    with pytest.raises(ValueError, match=r"a frame has shape \(3, 3\), expected \(18, 3\): Hips, "):
        live.step(motion.positions[0, :3])
    live.step(motion.positions[0], [True] * 4)
    with pytest.raises(ValueError, match="in some frames and not in others"):
        live.step(motion.positions[1])
    with pytest.raises(ValueError, match="balance is nan"):
        LiveRetargeter(nao, motion, balance=np.nan)
    wrong: Any
    for wrong, message in (
        (dict(look_ahead=0), "look_ahead is 0; it is a time in seconds"),
        (dict(look_ahead=8), "look_ahead is 8; it is a time in seconds, over 0 and up to 2"),
        (dict(iterations=0), "iterations is 0; it is an integer, at least 1"),
    ):
        with pytest.raises(ValueError, match=message):
            LiveRetargeter(live.robot, motion, **wrong)

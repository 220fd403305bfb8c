"""Timed motions along poses: tool and joints beside dense samples in NumPy, MuJoCo's kinematics as the judge."""

from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
from refusals import refuses
from scipy.spatial.transform import Rotation

import osik_jax as osik
from osik_jax import cli
from osik_jax.core import _library
from osik_jax.motion import follow, load_motion

ARM = osik.load_robot("arm7")
LIMITS: dict[str, Any] = {
    "velocity": np.array([2.175] * 4 + [2.61] * 3),
    "acceleration": np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0]),
    "jerk": np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0]),
}
RADIUS, TOP = 0.15, np.array([0.5, 0.0, 0.25])


def raster(rows: int, columns: int) -> tuple[np.ndarray, np.ndarray]:
    """Poses on a lying cylinder: rows along its axis, there and back, tool axes into it."""
    position, rotation = [], []
    for row, angle in enumerate(np.linspace(-0.3, 0.3, rows)):
        outward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        for y in np.linspace(-0.1, 0.1, columns)[:: -1 if row % 2 else 1]:
            position.append(TOP + RADIUS * outward + [0.0, y, 0.0])
            side = np.array([0.0, -1.0, 0.0])
            rotation.append(np.stack([np.cross(side, -outward), side, -outward], axis=1))
    return np.array(position), np.array(rotation)


def placed(q: np.ndarray, frame: str = "hand") -> tuple[np.ndarray, np.ndarray]:
    """Positions (T, 3) and rotations (T, 3, 3) of a frame by MuJoCo."""
    model = ARM.mj_model
    data, number = mujoco.MjData(model), mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, frame)
    assert number >= 0
    found = []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(model, data)
        found.append((data.site_xpos[number].copy(), data.site_xmat[number].reshape(3, 3).copy()))
    return np.array([p for p, _ in found]), np.array([r for _, r in found])


@pytest.fixture(scope="module")
def followed():
    return follow(ARM, {"hand": raster(3, 8)}, speed=0.3, **LIMITS)


@pytest.mark.slow
def test_limits_hold_at_a_millisecond_and_nothing_jumps(followed) -> None:
    time = np.arange(0.0, followed.duration, 1e-3)
    q, v, a, j = followed.at(time)
    for seen, kind in zip((v, a, j), LIMITS.values(), strict=True):
        assert (np.abs(seen) <= 1.0001 * kind).all()
    assert (np.abs(np.diff(q, axis=0)) / 1e-3 <= 1.0001 * LIMITS["velocity"]).all()
    assert (np.abs(np.diff(a, axis=0)) / 1e-3 <= 1.0001 * LIMITS["jerk"]).all()
    lower, upper = np.asarray(ARM.position_lower), np.asarray(ARM.position_upper)
    assert (lower <= q).all() and (q <= upper).all()


@pytest.mark.slow
def test_the_tool_stays_on_the_cylinder_and_meets_all_poses(followed) -> None:
    q = followed.at(np.arange(0.0, followed.duration, 2e-3))[0]
    place, turn = placed(q)
    distance = np.hypot(place[:, 0] - TOP[0], place[:, 2] - TOP[2])
    rows, _ = raster(3, 8)
    on_row = np.abs(place[:, 1]) < 0.0995  # between rows the curve is a chord of the cylinder
    assert np.abs(distance - RADIUS)[on_row].max() < 1e-4
    outward = (place - TOP) * [1.0, 0.0, 1.0] / distance[:, None]
    tilt = np.arccos(np.clip(-(turn[:, :, 2] * outward).sum(axis=1), -1.0, 1.0))
    assert np.degrees(tilt[on_row]).max() < 0.1
    nearest = np.linalg.norm(place[:, None] - rows, axis=2).min(axis=0)
    assert nearest.max() < 1e-3  # of samples 2 ms apart


@pytest.mark.slow
def test_the_wanted_speed_is_kept_on_rows(followed) -> None:
    place, _ = placed(followed.at(np.arange(0.0, followed.duration, 1e-3))[0])
    speed = np.linalg.norm(np.diff(place, axis=0), axis=1) / 1e-3
    assert speed.max() <= 0.3001 and (speed > 0.297).mean() > 0.6
    slow = followed.slow_parts()
    assert slow and all(part.limit in ("speed", "acceleration", "jerk") for part in slow)


@pytest.mark.slow
def test_more_cells_reach_a_low_speed_sooner() -> None:
    """A row of 4 s, where joints need 12 ms; the ends are what is slow."""
    slow = {}
    for cells in (400, 1600):
        found = follow(ARM, {"hand": raster(1, 8)}, speed=0.05, cells=cells, **LIMITS)
        time = np.arange(0.0, found.duration, 1e-3)
        q, *rates = found.at(time)
        for seen, kind in zip(rates, LIMITS.values(), strict=True):
            assert (np.abs(seen) <= 1.0001 * kind).all()
        speed = np.linalg.norm(np.diff(placed(q)[0], axis=0), axis=1) / 1e-3
        slow[cells] = 1e-3 * (speed < 0.99 * 0.05).sum()
    assert slow[1600] < 0.6 * slow[400] and slow[1600] < 0.04


def test_a_tool_may_spin_about_a_free_axis() -> None:
    poses = raster(2, 8)
    fast = follow(ARM, {"hand": poses}, free={"hand": "z"}, velocity=LIMITS["velocity"], acceleration=5.0)
    place, turn = placed(fast.at(np.linspace(0.0, fast.duration, 200))[0])
    assert fast.position_error < 1e-4 and fast.orientation_error < 1.7e-3
    assert np.abs(turn[:, 2, 2] + np.cos(np.arcsin((place[:, 0] - TOP[0]) / RADIUS))).max() < 2e-3


POSES = raster(1, 8)
AWAY = POSES[0] + np.linspace(0, 1.5, 8)[:, None] * [1.0, 0.0, 0.0]


@pytest.mark.slow
def test_a_command_follows_a_file(tmp_path, capsys) -> None:
    quaternion = Rotation.from_matrix(POSES[1]).as_quat(scalar_first=True)
    rows = np.column_stack([POSES[0], quaternion])
    np.savetxt(tmp_path / "path.csv", rows, delimiter=",", header="x,y,z,qw,qx,qy,qz", comments="")
    given = ["follow", str(tmp_path / "path.csv"), "--robot", "arm7", "--frame", "hand", "--dt", "0.01"]
    pictures = ["--film", str(tmp_path / "m.gif"), "--picture", str(tmp_path / "m.png")]
    assert cli.main([*given, "--out", str(tmp_path / "motion.npz"), *pictures]) == 0
    assert (tmp_path / "m.gif").stat().st_size > 1000 and (tmp_path / "m.png").stat().st_size > 1000
    assert "off the path" in capsys.readouterr().out
    place, _ = placed(np.asarray(load_motion(tmp_path / "motion.npz").position))
    np.testing.assert_allclose(place[[0, -1]], POSES[0][[0, -1]], atol=1e-4)
    np.savetxt(tmp_path / "path.csv", rows[:, :4], delimiter=",")
    assert cli.main(given) == 2 and "they are x,y,z or" in capsys.readouterr().err


@pytest.mark.parametrize(
    "poses, more, message",
    [
        ({"hand": POSES[0][[0, 1, 1, 2]]}, {}, "poses 1 and 2 are equal"),
        ({"hand": POSES[0] * np.nan}, {}, "have to be finite"),
        ({"hand": POSES[0][:, :2]}, {}, "got an array of shape"),
        pytest.param(
            *({"hand": (AWAY, POSES[1])}, {"free": {"hand": "z"}}),
            r"of 8 poses cannot be reached: .*, 7. Pose 2: not found in .* is 0.04.* m and",
            marks=pytest.mark.slow,
        ),
        ({"hnd": POSES}, {}, "did you mean 'hand'"),
        ({"hand": POSES}, {"free": {"hand": "w"}}, "axis"),
        ({"hand": POSES}, {"speed": 0.0}, "speed is"),
        ({"hand": POSES}, {"cells": 3}, "cells is 3"),
        ({"hand": POSES}, {"jerk": 0.0}, "limits of jerk are positive"),
    ],
)
def test_what_cannot_be_is_refused(poses, more, message) -> None:
    with pytest.raises(osik.OsikError, match=message):
        follow(ARM, poses, **({"acceleration": 5.0} | more))


@pytest.mark.skipif(not _library.installed(), reason="no compiled core")
class TestObstacles:
    """A line of UR5's tool, with a lamp where the elbow would be."""

    LINE = np.stack([np.full(20, 0.5), np.linspace(-0.2, 0.2, 20), np.full(20, 0.35)], axis=1)
    DOWN = np.tile([0.0, 1.0, 0.0, 0.0], (20, 1))
    OPTIONS: ClassVar = {"speed": 0.1, "acceleration": 5.0, "q0": np.array([0.0, -1.5, 1.8, -1.9, -1.57, 0.0])}

    @pytest.mark.slow
    def test_another_branch_is_taken_and_the_whole_motion_is_free(self):
        ur5, poses = osik.load_robot("ur5"), {"tool0": (self.LINE, self.DOWN)}
        plain = follow(ur5, poses, **self.OPTIONS)
        middle = plain.at(np.array([plain.duration / 2]))[0, 0]
        elbow = osik.forward_kinematics(ur5, middle).frame_pose(ur5, "forearm_link")[0]
        scene = osik.Scene({"lamp": osik.CollisionShape.sphere(0.08, elbow + np.array([0.0, 0.0, 0.05]))})
        found = follow(ur5, poses, scene=scene, clearance=0.01, **self.OPTIONS)
        for motion, is_clear in ((plain, False), (found, True)):
            q = motion.at(np.linspace(0.0, motion.duration, 2001))[0]
            distance = np.asarray(osik.clearance(ur5, q, scene).distance)
            assert (distance.min() >= 0.01) == is_clear
        assert found.position_error < 1e-4

    def test_an_obstacle_on_the_line_is_named(self):
        scene = osik.Scene({"lamp": osik.CollisionShape.sphere(0.05, self.LINE[10])})
        refuses(
            ValueError, "(?s)9 of 20 poses.*Pose 6.*lamp", follow, osik.load_robot("ur5"),
            {"tool0": (self.LINE, self.DOWN)}, scene=scene, **self.OPTIONS,
        )  # fmt: skip

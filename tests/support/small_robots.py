"""Small robots of other shapes than a person's, and the walk of a dog, for tests of retargeting."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable
from typing import Any

import mujoco
import numpy as np

import osik_jax as osik
from osik_jax.retargeting import HumanMotion

FPS = 30.0
LEG = """<body name="{s}_hip_yaw" pos="0 {y} 0"><joint name="{s}_hip_yaw" axis="0 0 1" range="-60 60"/>
  <geom size="0.04"/><body name="{s}_hip_roll"><joint name="{s}_hip_roll" axis="1 0 0" range="-40 40"/>
  <geom size="0.04"/>
  <body name="{s}_hip_pitch"><joint name="{s}_hip_pitch" axis="0 1 0" range="-120 90"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.05"/>
  <body name="{s}_shin" pos="0 0 -0.4"><joint name="{s}_knee" axis="0 1 0" range="0 140"/>
    <geom type="capsule" fromto="0 0 0 0 0 -0.4" size="0.04"/>
  <body name="{s}_ankle" pos="0 0 -0.4"><joint name="{s}_ankle_pitch" axis="0 1 0" range="-50 50"/><geom size="0.03"/>
  <body name="{s}_foot"><joint name="{s}_ankle_roll" axis="1 0 0" range="-30 30"/>
    <geom type="box" pos="0.04 0 -0.05" size="0.1 0.04 0.02"/></body></body></body></body></body></body>"""
ARM = """<body name="{s}_pitch" pos="0 {y} 0.4"><joint name="{s}_pitch" axis="0 1 0" range="-170 170"/>
  <geom size="0.03"/>
  <body name="{s}_roll" pos="0 {dy} 0"><joint name="{s}_roll" axis="1 0 0" range="-150 150"/>
  <geom type="capsule" fromto="0 0 0 0 0 -0.25" size="0.03"/>{forearm}</body></body>"""
FOREARM = """<body name="{s}_yaw" pos="0 0 -0.1"><joint name="{s}_yaw" axis="0 0 1" range="-170 170"/>
  <geom size="0.03"/>
  <body name="{s}_elbow" pos="0 0 -0.15"><joint name="{s}_elbow" axis="0 1 0" range="-60 90"/>
  <geom type="capsule" fromto="0.03 0 0 0.25 0 0" size="0.03"/></body></body>"""
WHEEL = """<body name="{s}_wheel" pos="0 {y} -0.3"><joint name="{s}_wheel" axis="0 1 0" limited="false"/>
  <geom type="cylinder" size="0.1 0.02" euler="90 0 0"/></body>"""
PAW = """<body name="{s}_hip" pos="{x} {y} 0"><joint name="{s}_abduction" axis="1 0 0" range="-45 45"/>
  <geom size="0.03"/>
  <body name="{s}_thigh" pos="0 {dy} 0"><joint name="{s}_thigh" axis="0 1 0" range="-120 120"/>
  <geom type="capsule" fromto="0 0 0 -0.12 0 -0.2" size="0.02"/>
  <body name="{s}_shank" pos="-0.12 0 -0.2"><joint name="{s}_shank" axis="0 1 0" range="-60 100"/>
  <geom type="capsule" fromto="0 0 0 0.12 0 -0.2" size="0.015"/><geom name="{s}_ball" pos="0.12 0 -0.2" size="0.02"/>
  <site name="{s}_foot" pos="0.12 0 -0.2"/></body></body></body>"""
SIDES = (("left", 1.0), ("right", -1.0))


def nao_soles(nao: osik.Robot, qpos: Iterable[np.ndarray]) -> np.ndarray:
    """Corners of a NAO's soles in the world by MuJoCo, from configurations of its model [m]. (F, 8, 3)."""
    names = [f"{side}_sole_corner_{k}" for side in "lr" for k in range(4)]
    return by_mujoco(nao, qpos, lambda data: [data.site(name).xpos for name in names])


def by_mujoco(robot: osik.Robot, qpos: Iterable[Any], read: Callable[[mujoco.MjData], Any]) -> np.ndarray:
    """What ``read`` takes from MuJoCo's poses in each configuration of the robot's model. (F, ...)."""
    data, out = mujoco.MjData(robot.mj_model), []
    for own in qpos:
        data.qpos[:] = own
        mujoco.mj_kinematics(robot.mj_model, data)
        mujoco.mj_comPos(robot.mj_model, data)
        out.append(np.array(read(data)))
    return np.array(out)


def assert_limits_hold(
    robot: osik.Robot, q: np.ndarray, fps: float, acceleration: float = np.inf, names: Iterable[str] | None = None
) -> None:
    """Joints are inside their ranges, their speed limits and this limit of acceleration. ``q``: (F, joints)."""
    dofs = [robot.joint_dof_index(name) for name in names or robot.joint_names]
    low, high, fast = (np.asarray(x)[dofs] for x in (robot.position_lower, robot.position_upper, robot.velocity_limit))
    assert (q >= low - 1e-12).all() and (q <= high + 1e-12).all()
    speed = np.diff(q, axis=0) * fps
    assert (np.abs(speed) <= fast * (1.0 + 1e-9)).all()
    assert np.abs(np.diff(speed, axis=0)).max() * fps <= acceleration * (1.0 + 1e-9)


def robot_of(*parts: str, free: bool = True, turn: float = 0.0, forearm: str = FOREARM) -> osik.Robot:
    """A trunk with the parts that are named on both sides, turned about the vertical [deg]."""
    inside = ""
    for s, sign in SIDES:
        arm = ARM.replace("{forearm}", forearm)
        texts = {"legs": LEG, "arms": arm, "wheels": WHEEL}
        inside += "".join(texts[part].format(s=s, y=0.15 * sign, dy=0.05 * sign) for part in parts)
    return osik.Robot.from_mjcf(
        f"""<mujoco><compiler autolimits="true"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
        <body name="base" pos="0 0 0.85" euler="0 0 {turn}">{"<freejoint/>" if free else ""}
        <geom type="box" pos="0 0 0.2" size="0.06 0.1 0.2"/>{inside}</body></worldbody></mujoco>""",
    )


def on_four(arm: str = "") -> osik.Robot:
    """A robot on four feet with knees that point backwards; its feet are balls of 2 cm. Its floor is at z = 0.6 m."""
    legs = ""
    for row, x in (("front", 0.25), ("hind", -0.25)):
        for s, sign in SIDES:
            legs += PAW.format(s=f"{s}_{row}", x=x, y=0.08 * sign, dy=0.06 * sign)
    return osik.Robot.from_mjcf(
        f"""<mujoco><compiler autolimits="true"/><default><geom contype="0" conaffinity="0"/></default><worldbody>
        <body name="trunk" pos="0 0 1.02"><freejoint/><geom type="box" size="0.25 0.07 0.05"/>{legs}{arm}</body>
        </worldbody></mujoco>""",
    )


def trotting(frames: int = 36, speed: float = 0.4, period: float = 0.6, lift: float = 0.06) -> HumanMotion:
    """A dog: diagonal pairs of paws stand for half of the period; knees point forward, elbows backward."""
    time, points = np.arange(frames) / FPS, {}
    for s, sign in SIDES:
        rows = (("hip", "knee", "ankle"), -0.3, 0.0), (("shoulder", "elbow", "wrist"), 0.3, 0.5)
        for names, x, phase in rows:
            phase = (phase + 0.5 * (sign < 0.0)) % 1.0
            steps, part = np.divmod(time / period + phase, 1.0)
            swing = np.clip(2.0 * part - 1.0, 0.0, 1.0)
            at = (steps - phase + 0.25 + swing**2 * (3.0 - 2.0 * swing)) * period * speed
            still = np.full(frames, 0.1 * sign)
            top = np.stack([speed * time + x, still, 0.45 + 0.01 * np.sin(4.0 * np.pi * time / period)], 1)
            paw = np.stack([at + x, still, lift * np.sin(np.pi * swing) ** 2], 1)
            bend = [0.06 if x < 0.0 else -0.06, 0.0, 0.0]
            tracks = zip(names, (top, 0.5 * (top + paw) + bend, paw), strict=True)
            points |= {f"{s}_{name}": track for name, track in tracks}
    return HumanMotion("trot", FPS, tuple(points), np.stack(list(points.values()), 1))


def quietly(make: Callable[..., Any], *arguments: Any, **options: Any) -> Any:
    """Return the result of a function, without the warning in which a guess says what it found."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", osik.OsikWarning)
        return make(*arguments, **options)

"""Upright walk of a figure with the published skeleton of LAFAN1, whose pelvis and spine slant in every posture."""

from __future__ import annotations

import numpy as np
from motion_files import Figure, along_x, with_rest

_SPINE_BENDS = {"Spine": 5.5, "Spine1": 1.0, "Spine2": 0.6, "Neck": 1.0}
"""Forward bends of the published clips' upright frames [deg]."""
_OFFSETS = {  # [cm] in the frame of a bone at rest: x along the bone, y forward in the trunk, z to the left
    "Hips": ("", (0.0, 0.0, 0.0)),
    "Spine": ("Hips", (6.90, -2.60, 0.0)), "Spine1": ("Spine", (12.59, 0.0, 0.0)),
    "Spine2": ("Spine1", (12.34, 0.0, 0.0)), "Neck": ("Spine2", (25.83, 0.0, 0.0)),
    "Head": ("Neck", (11.77, 0.0, 0.0)),
    **{f"{side}Shoulder": ("Spine2", (19.75, -1.48, 6.0 * sign)) for side, sign in (("Left", 1.0), ("Right", -1.0))},
    **{f"{side}UpLeg": ("Hips", (0.10, 1.86, 10.55 * sign)) for side, sign in (("Left", 1.0), ("Right", -1.0))},
}  # fmt: skip
_THIGH, _SHANK, _ANKLE = 0.435, 0.4237, 0.09


def _joints() -> tuple[tuple[str, int, tuple[float, float, float]], ...]:
    """Name, parent and offset [m] of each joint standing upright: y up, facing z, arms to the sides."""
    names = list(_OFFSETS)
    joints = [(name, names.index(parent) if parent else -1, (0.01 * z, 0.01 * x, 0.01 * y))
              for name, (parent, (x, y, z)) in _OFFSETS.items()]  # fmt: skip
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        before = names.index(f"{side}Shoulder")
        for part, length in (("Arm", 0.1128), ("ForeArm", 0.33), ("Hand", 0.252)):
            joints.append((f"{side}{part}", before, (sign * length, 0.0, 0.0)))
            before = len(joints) - 1
        before = names.index(f"{side}UpLeg")
        for part, offset in (("Leg", (0.0, -_THIGH, 0.0)), ("Foot", (0.0, -_SHANK, 0.0)), ("Toe", (0.0, -0.08, 0.15))):
            joints.append((f"{side}{part}", before, offset))
            before = len(joints) - 1
    return tuple(joints)


def lafan_walk(frames: int = 48, fps: float = 30.0, speed: float = 0.6, period: float = 1.2) -> Figure:
    """A person walks along z with an upright trunk; each foot is flat on the floor for 0.6 of the period."""
    joints = _joints()
    at = {name: i for i, (name, _, _) in enumerate(joints)}
    time, angles = np.arange(frames) / fps, np.zeros((frames, len(joints), 3))  # z, x, y
    root = np.stack([0.0 * time, np.full(frames, _ANKLE + 0.80), speed * time], 1)
    for name, bend in _SPINE_BENDS.items():
        angles[:, at[name], 1] = bend
    for side, sign, phase in (("Left", 1.0, 0.0), ("Right", -1.0, 0.5)):
        steps, part = np.divmod(time / period + phase, 1.0)
        swing = np.clip((part - 0.6) / 0.4, 0.0, 1.0)
        ahead = (steps - phase + 0.3 + swing**2 * (3.0 - 2.0 * swing)) * period * speed
        hip = root + np.array(joints[at[f"{side}UpLeg"]][2])
        down = hip[:, 1] - _ANKLE - 0.08 * np.sin(np.pi * swing) ** 2
        forward = ahead - hip[:, 2]
        reach = np.hypot(down, forward)
        knee = np.pi - np.arccos((_THIGH**2 + _SHANK**2 - reach**2) / (2.0 * _THIGH * _SHANK))
        before = np.arcsin(_SHANK * np.sin(knee) / reach)
        thigh = -np.arctan2(forward, down) - before
        for name, angle in (("UpLeg", thigh), ("Leg", knee), ("Foot", -thigh - knee)):
            angles[:, at[side + name], 1] = np.degrees(angle)
        angles[:, at[f"{side}Arm"], 0] = -80.0 * sign
        angles[:, at[f"{side}ForeArm"], 2] = -sign * (20.0 + 10.0 * np.cos(2.0 * np.pi * time / period))
    return Figure(joints, root, angles, ("ZXY",) * len(joints), fps)


def as_published(own: Figure) -> Figure:
    """The same with all bones along x in the rest pose and channels z, y, x, as the published files have it."""
    turns = along_x(own)
    turns[0] = np.roll(np.eye(3), 1, axis=0)  # x of the pelvis points up, y forward, z to the left
    return with_rest(own, turns, "ZYX")

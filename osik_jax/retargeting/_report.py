"""Quality report of a retargeted motion, recomputed by MuJoCo's C code from the numbers of its file."""

from __future__ import annotations

import functools
import operator
from collections.abc import Mapping
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from ..robot._mujoco import model_qpos
from ..tasks._polygon import hull
from ._contact import stretches
from ._facing import facing_at_home
from ._places import CapsuleDistances, Places, find_places, pairs_at_home
from ._retargeted import Retargeted
from ._roles import CHAINS, SIDES
from ._skeletons import shortened

JUMP, AT_SPEED, AT_END = 15.0, 0.97, 0.01
"""A change of joint speed from one frame to the next that counts as a jump [rad/s], the share of its speed limit at
which a joint counts as at the limit (a plan stays below 98 %), and the share of its range within which it counts as at
an end.
"""

FIGURES = {
    "off_plan_rad": ("off_plan_rad",),
    "beyond_range_max": ("joints", "beyond_range_max"),
    "speed_over_limit_max": ("joints", "speed_over_limit_max"),
    "acceleration_max": ("joints", "acceleration_max"),
    "acceleration_rms": ("joints", "acceleration_rms"),
    "jerk_rms": ("joints", "jerk_rms"),
    "slip_mm_max": ("feet", "slip_mm_max"),
    "float_mm_max": ("feet", "float_mm_max"),
    "below_floor_mm_max": ("feet", "below_floor_mm_max"),
    "penetration_mm_max": ("shapes", "penetration_mm_max"),
    "limb_error_mm_mean": ("tracking", "limb_error_mm_mean"),
    "segment_angle_deg_mean": ("tracking", "segment_angle_deg_mean"),
    "pelvis_angle_deg_mean": ("tracking", "trunk_angle_deg", "pelvis"),
    "chest_angle_deg_mean": ("tracking", "trunk_angle_deg", "chest"),
}
"""Figures of summaries by name, with their keys in a report."""


_BOUNDS = {
    ("feet", "slip_mm_max"): (1.0, "feet that stand slip by {:.1f} mm"),
    ("feet", "float_mm_max"): (2.0, "feet that stand are {:.1f} mm above the floor"),
    ("feet", "below_floor_mm_max"): (2.0, "soles are {:.1f} mm below the floor"),
    ("shapes", "penetration_mm_max"): (1.0, "shapes overlap by {:.1f} mm"),
    ("touches", "off_mm_max"): (5.0, "hands are {:.1f} mm off what they hold"),
    ("joints", "beyond_range_max"): (1e-6, "a joint is {:.2g} rad or m beyond its range"),
    ("joints", "speed_over_limit_max"): (1.0 + 1e-6, "a joint has {:.3g} times its greatest speed"),
}
"""Figures of a report, the largest value where bounds hold, and the note for a larger value."""
_LEAST_STANDING = 0.2
_OFTEN, _OFF = 0.5, 4.0
"""Share of frames with a joint at its speed limit, and mean angle between segments [deg], above both of which a clip is
too fast.
"""
_LEANS, _RESTS, _MOST_JOINTS = 10.0, 0.5, 4
"""Angle between the trunks of person and robot [deg], and share of frames with a joint at an end of its range, above
which each is told; and largest number of joints that a note names.
"""


def report(result: Retargeted) -> dict[str, Any]:
    """Return the figures of a motion, recomputed by MuJoCo: lengths in mm, angles in rad unless the name ends in deg.

    - ``joints``: largest excess beyond ranges and speed limits, share of frames with a joint at its speed limit, share
      of frames in which each joint is within 1 % of an end of its range, accelerations and jerks (``rms``: root mean
      square over joints and frames), and frames with a speed jump over 15 rad/s.
    - ``feet``: distance of contact points from their landing place (``slip``), their height (``float``), and depth of
      soles below the floor.
    - ``balance``: in double support, the share of frames with the centre of mass over the support polygon, and its
      least distance inside the edge (negative outside).
    - ``shapes``: depth of overlaps between the profile's capsules.
    - ``tracking``: keypoint errors per limb, at the scale that fits each limb best; mean angles between the person's
      segments and the robot's; ``trunk_angle_deg``: those of the orientations of pelvis and chest, and of the line from
      hips to shoulders (None without these).
    - ``touches``: distance of joints from their place on what they hold.
    - ``notes``: sentences on violated bounds, on clips that are too fast for the joints, on a trunk that leans over 10
      degrees away from the person's, on joints at an end of their range in most frames, and on clips whose feet stand
      in less than 20 % of the frames.
    """
    places = find_places(result.robot, result.profile, model_qpos(result.robot, result.q))
    figures = {
        "frames": len(result.q),
        "fps": result.motion.fps,
        "iterations": result.iterations,
        "off_plan_rad": float(result.off_plan.max()),
        "joints": _joints(result),
        "feet": _feet(places, result),
        "balance": _balance(places.soles, places.center, result.contact),
        "shapes": {"penetration_mm_max": _penetration(result, places.capsules)},
        "tracking": _tracking(result, places),
        "touches": {"off_mm_max": _off_touch(result, places.keypoints)},
    }
    return {**figures, "notes": notes(figures)}


def picked(figures: Any) -> dict[str, float | None]:
    """Return the figures of a report that ``FIGURES`` names."""
    return {name: functools.reduce(operator.getitem, path, figures) for name, path in FIGURES.items()}


def _joints(result: Retargeted) -> dict[str, Any]:
    robot, names, fps = result.robot, result.robot.joint_names, result.motion.fps
    dofs = [robot.joint_dof_index(name) for name in names]
    low, high, fast = (np.asarray(x)[dofs] for x in (robot.position_lower, robot.position_upper, robot.velocity_limit))
    q = result.q[:, [robot.joint_qpos_index(name) for name in names]]
    room = np.where(np.isfinite(high - low), AT_END * (high - low), 0.0)
    at_end = (((q <= low + room) | (q >= high - room)) & (high > low)).mean(0)
    speed = np.diff(q, axis=0) * fps
    change = np.abs(np.diff(speed, axis=0))
    return {
        "beyond_range_max": float(max(0.0, (low - q).max(), (q - high).max())),
        "speed_over_limit_max": float((np.abs(speed) / fast).max()),
        "at_speed_limit_share": float((np.abs(speed) > AT_SPEED * fast).any(1).mean()),
        "at_end_share": {name: float(own) for name, own in zip(names, at_end, strict=True) if own},
        "acceleration_max": float(change.max() * fps),
        "acceleration_max_joint": names[int(np.argmax(change.max(0)))],
        "acceleration_rms": _rms(change) * fps,
        "jerk_rms": _rms(np.diff(speed, 2, axis=0)) * fps**2,
        "jump_frames": int((change > JUMP).any(1).sum()),
    }


def _rms(values: np.ndarray) -> float:
    """Return the root mean square, or 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if values.size else 0.0


def _feet(places: Places, result: Retargeted) -> dict[str, Any]:
    """Return what ``report`` says of the feet: None without feet or with a fixed base; slip is None for wheels."""
    if not result.profile.feet or not result.robot.floating_base:
        return dict.fromkeys(("contact_share", "slip_mm_max", "float_mm_max", "below_floor_mm_max"))
    points, contact = places.standing, result.contact
    slip = [0.0]
    for k in range(4):
        for start, end in stretches(contact[:, k]):
            track = points[start:end, k, :2]
            slip.append(float(np.linalg.norm(track - track[0], axis=-1).max()))
    heights = points[..., 2][contact]
    return {
        "contact_share": float(contact.any(1).mean()),
        "slip_mm_max": None if result.profile.rolls else 1e3 * max(slip),
        "float_mm_max": 1e3 * float(max(0.0, heights.max(initial=0.0))),
        "below_floor_mm_max": 1e3 * float(max(0.0, -places.soles[..., 2].min())),
    }


def _balance(
    corners: Float[np.ndarray, "F corners 3"], center: Float[np.ndarray, "F 3"], contact: Bool[np.ndarray, "F 4"]
) -> dict[str, Any]:
    margins = []
    both = contact[:, :2].any(1) & contact[:, 2:].any(1) & (corners.shape[1] > 0)
    for f in np.flatnonzero(both):
        polygon = hull(corners[f, np.repeat(contact[f], 2), :2])
        if polygon is not None:
            normals, offsets, _ = polygon
            margins.append(float((offsets - normals @ center[f, :2]).min()))
    return {
        "double_support_frames": int(both.sum()),
        "com_inside_share": float(np.mean(np.array(margins) >= 0.0)) if margins else None,
        "com_margin_mm_min": 1e3 * min(margins) if margins else None,
    }


def _penetration(result: Retargeted, ends: Float[np.ndarray, "F k 2 3"]) -> float | None:
    """Return the deepest overlap [mm] of the capsule pairs with three or more joints between them and a gap at home."""
    if not result.profile.capsules:
        return None
    pairs, distances = pairs_at_home(result.robot, result.profile), CapsuleDistances(result.profile)
    return 1e3 * max(0.0, *(-distance for placed in ends for distance in distances.of(placed, pairs)), 0.0)


def _tracking(result: Retargeted, places: Places) -> dict[str, Any]:
    robot = places.keypoints
    person = {name: result.human[:, k] for k, name in enumerate(result.human_names)}
    errors = {}
    chains = {
        f"{side}_{limb}": [f"{side}_{role}" for role in roles] for side in SIDES for limb, roles in CHAINS.items()
    }
    if result.profile.is_hand:
        chains = {tip.removesuffix("_4"): [first, tip] for first, tip in result.profile.reached}
    for name, roles in chains.items():
        first, *others = [role for role in roles if role in robot and role in person] or [""]
        if others:
            h, r = (np.concatenate([points[o] - points[first] for o in others]) for points in (person, robot))
            scale = np.sum(h * r) / np.sum(h * h)
            errors[name] = 1e3 * float(np.linalg.norm(scale * h - r, axis=-1).mean())
    limbs = result.profile.followed
    angles = {f"{a}-{b}": _angle(person[b] - person[a], robot[b] - robot[a]) for a, b in limbs}
    return {
        "limb_error_mm": errors,
        "limb_error_mm_mean": float(np.mean(list(errors.values()))),
        "segment_angle_deg": angles,
        "segment_angle_deg_mean": float(np.mean(list(angles.values()))),
        "trunk_angle_deg": _trunk(result, places, person),
    }


def _trunk(result: Retargeted, places: Places, person: dict[str, Float[np.ndarray, "F 3"]]) -> dict[str, float | None]:
    """Return mean angles [deg] between person and robot: of pelvis, chest and line from hips to shoulders."""
    robot, profile = result.robot, result.profile
    if profile.is_hand:
        return dict.fromkeys(("pelvis", "chest", "hips-shoulders"))
    home = find_places(robot, profile, model_qpos(robot, robot.q0)).turns[0, :2]
    turns = places.turns[:, :2] @ np.swapaxes(home, -1, -2) @ facing_at_home(robot, profile.across)
    off = Rotation.from_matrix((np.swapaxes(turns, -1, -2) @ result.turns).reshape(-1, 3, 3)).magnitude()
    pelvis, chest = np.degrees(off.reshape(-1, 2).mean(0))
    ends = [f"{side}_{role}" for role in ("hip", "shoulder") for side in SIDES]
    lines = [
        points[ends[2]] + points[ends[3]] - points[ends[0]] - points[ends[1]]
        for points in (person, places.keypoints)
        if set(ends) <= set(points)
    ]
    line = _angle(*lines) if len(lines) == 2 else None
    return {"pelvis": float(pelvis), "chest": float(chest), "hips-shoulders": line}


def _off_touch(result: Retargeted, robot: dict[str, Float[np.ndarray, "F 3"]]) -> float | None:
    """Return the largest distance [mm] of a joint from where it holds something; None if it never does."""
    off = [0.0]
    for first, second, goal, held in result.touches:
        at = robot[second] - robot.get(first, np.zeros(3))
        off.append(float(np.linalg.norm(at - goal, axis=-1)[held].max(initial=0.0)))
    return 1e3 * max(off) if result.touches else None


def _angle(a: Float[np.ndarray, "F 3"], b: Float[np.ndarray, "F 3"]) -> float:
    """Return the mean angle between two sequences of vectors [deg]."""
    across, along = np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, -1)
    return float(np.degrees(np.arctan2(across, along)).mean())


def notes(figures: Mapping[str, Any], balance: float | None = None) -> list[str]:
    """Return notes that a user must read before using a motion; empty if there are none.

    ``balance`` is the requested margin of the centre of mass inside the support polygon [m].
    """
    limited, angle = figures["joints"]["at_speed_limit_share"], figures["tracking"]["segment_angle_deg_mean"]
    out = []
    if limited > _OFTEN and angle > _OFF:
        out.append(
            f"segments are {angle:.1f} deg off, and in {100.0 * limited:.0f} % of the frames a joint is at its largest "
            "speed: slow down the clip, or check the speed limits in the robot's file"
        )
    out += _posture(figures)
    found = [(figures[group][name], most, text) for (group, name), (most, text) in _BOUNDS.items()]
    out += [
        f"a bound gave way: {text.format(value)}" for value, most, text in found if value is not None and value > most
    ]
    margin = figures["balance"]["com_margin_mm_min"]
    if balance is not None and margin is not None and margin < 0.0:
        out.append(f"a bound gave way: the centre of mass is {-margin:.1f} mm outside the feet")
    share = figures["feet"]["contact_share"]
    if share is not None and share < _LEAST_STANDING:
        out.append(
            f"feet stand in {100.0 * share:.0f} % of the frames, and nothing holds them elsewhere; where the person "
            "walks or stands, check the unit, the up axis and the contact labels of the clip"
        )
    return out


def _posture(figures: Mapping[str, Any]) -> list[str]:
    """Return notes on a trunk that leans, and on joints that rest at an end."""
    out, leans = [], figures["tracking"]["trunk_angle_deg"]["hips-shoulders"]
    if leans is not None and leans > _LEANS:
        out.append(
            f"the trunk leans {leans:.0f} deg away from the person's: check which joint of the clip is the chest, and "
            "the range of the waist"
        )
    share: Mapping[str, float] = figures["joints"]["at_end_share"]
    rests = sorted((name for name in share if share[name] > _RESTS), key=lambda name: -share[name])
    if rests:
        told = [f"{name} ({100.0 * share[name]:.0f} % of the frames)" for name in rests]
        out.append(f"joints rest at an end of their range: {shortened(told, _MOST_JOINTS)}")
    return out

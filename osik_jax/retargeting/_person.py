"""Person seen by retargeting: limb directions, trunk and foot orientations, and contacts, from a clip's joints."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError, warn
from ._contact import find_contact, find_ground, find_noise, mean_over, noise_steps
from ._motion import CONTACT_POINTS, HumanMotion, Touch
from ._profile import Limb
from ._roles import FINGER_REACHES, FINGERS, LEGS, LIMBS, REACHES, SIDES, chain
from ._up import find_up

# Vectors shorter than this [m] have no direction; a spine shorter than 1 mm means chest and hips are one joint.
_SHORTEST = 1e-9
_SPINE = 1e-3
# A missing toe is 0.35 shanks before and 0.12 shanks below the ankle; a missing heel is 0.3 feet behind it.
_TOE, _SOLE, _HEEL = 0.35, 0.12, 0.3
# Share of frames among which a flat foot is searched.
_FLAT = 0.05
# Upright frames are those in which the neck is at most 5 % lower above the feet than in the tallest frames.
_TALL = 0.05
# Lengths of a leg [m] outside which the file's unit must be wrong.
_LEGS = (0.1, 3.0)

_CENTERED = 0.02
"""Largest distance of the middle of the hips from the origin in all frames of such a clip [m]."""


@dataclasses.dataclass(frozen=True)
class Person:
    """Motion of a person in world axes with z up and the floor at height 0."""

    fps: float  # frame rate [1/s]
    points: Mapping[str, Float[np.ndarray, "F 3"]]  # positions by role, heels and toes included [m]
    pelvis: Float[np.ndarray, "F 3 3"]  # forward, left and up axes of the pelvis as columns
    torso: Float[np.ndarray, "F 3 3"]  # forward, left and up axes of the chest as columns
    root: Float[np.ndarray, "F 3"]  # midpoint of the hips, or of the shoulders if the hips are unknown [m]
    feet: Float[np.ndarray, "F 2 3 3"]  # forward, left and up axes of the left and right foot as columns
    # whether the points of ``Profile.standing`` stand: left heel, left toe, right heel and right toe, or the four feet
    # of a four-legged robot
    contact: Bool[np.ndarray, "F 4"]
    lengths: Mapping[Limb, float]  # lengths of the limbs and reaches with known ends [m]
    ankle: float  # height of the ankles above the floor when standing [m]
    # poses of objects, as of ``HumanMotion``
    objects: Mapping[str, Float[np.ndarray, "F 7"]] = dataclasses.field(default_factory=dict)
    touches: tuple[Touch, ...] = ()  # as of ``HumanMotion``


def unit(vector: np.ndarray) -> np.ndarray:
    """Return vectors scaled to unit length; the x axis where the length is 0. (..., 3)."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > _SHORTEST, vector / np.maximum(length, _SHORTEST), np.eye(3)[0])


def directions(points: Mapping[str, np.ndarray], limbs: Sequence[Limb]) -> Float[np.ndarray, "F limbs 3"]:
    """Return unit vectors along limbs. (F, limbs, 3)."""
    return unit(np.stack([points[b] - points[a] for a, b in limbs], 1))


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product a x b; twice as fast as NumPy's for about 100 vectors. (..., 3)."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], -1)


def axes_from(left: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return right-handed axes as columns: y along ``left``, z as near to ``up`` as possible. (..., 3, 3)."""
    y = unit(left)
    x = unit(_cross(y, up))
    return np.stack([x, y, _cross(x, y)], -1)


def foot_axes(forward: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Return right-handed axes as columns: x along ``forward``, z as near to ``up`` as possible. (..., 3, 3)."""
    x = unit(forward)
    y = unit(_cross(up, x))
    return np.stack([x, y, _cross(x, y)], -1)


@dataclasses.dataclass(frozen=True)
class Measures:
    """Constant measures of a person: leg length, ankle height, floor, noise and reference poses."""

    lengths: Mapping[Limb, float]  # lengths of the limbs and reaches with known ends [m]
    ankle: float  # height of the ankles above the floor when standing; 0 if unknown [m]
    floor: float  # height of the floor [m]
    noise: float  # standard deviation of each coordinate of the standing points [m]
    # per side, positions of knee, ankle and toe while the foot is flat on the floor [m]. (1, 3) each
    flat: Mapping[str, Mapping[str, np.ndarray]]
    # axes of pelvis and chest when the person is upright, by the rest pose or by the clip's upright frames; None for a
    # hand. (1, 3, 3) each
    straight: tuple[np.ndarray, np.ndarray] | None


def measure(motion: HumanMotion, roles: Mapping[str, str], standing: tuple[str, ...] = CONTACT_POINTS) -> Measures:
    """Measure a person and the floor from a clip.

    An ``OsikWarning`` is given if z does not seem to point up. ``standing`` are the points that say when feet stand.
    """
    points = {role: motion.track(name) for role, name in roles.items()}
    legs, on_four = _has_legs(points), bool(standing) and standing != CONTACT_POINTS
    if not on_four and (up := find_up(motion, "z", roles)) != "z":
        warn(
            f"{motion.name}: z is taken to point up, and the motion looks as if {up} did; "
            f"load_motion(path, up={up!r}) and --up={up} turn {up} up"
        )
    straight, flat = None, {}
    if legs:
        flat = {side: _flat({**points, **_toes(points, side)}, side) for side in SIDES}
    if on_four:
        turns = _turns(points)
        middle = np.argsort(turns[0][:, 2, 2], kind="stable")[len(turns[0]) // 2]
        straight = turns[0][middle, None], turns[1][middle, None]
    elif motion.rest_positions is not None and "wrist" not in roles:
        at = {role: motion.joint_names.index(name) for role, name in roles.items()}
        rest = {role: motion.rest_positions[None, i] for role, i in at.items()}
        flat = {side: {**rest, **_toes(rest, side)} for side in SIDES} if legs else {}
        straight = _turns(rest)
    elif "wrist" not in roles:
        straight = _upright(points)
    known = [limb for limb in LIMBS if set(limb) <= set(points)]
    lengths = {(a, b): float(np.linalg.norm(points[b] - points[a], axis=-1).mean()) for a, b in known}
    reaches = [limb for limb in (*REACHES, *FINGER_REACHES) if set(limb) <= set(points)]
    lengths |= {limb: bone_length(points, limb) for limb in reaches}
    if legs and not on_four:
        leg = 0.5 * sum(lengths[limb] for limb in LEGS)
        if not _LEGS[0] < leg < _LEGS[1]:
            raise OsikValueError(f"the legs of {motion.name} are {leg:.4g} m long; positions are metres")
    soles = _with_soles(points, flat)
    found = np.stack([soles[name] for name in standing if name in soles] or [np.zeros((motion.frames, 3))], 1)
    noise, seen = find_noise(found), all(name in soles for name in standing) and bool(standing)
    detected = find_ground(found, noise_steps(noise, motion.fps)) if seen else 0.0
    floor = detected if motion.ground is None else motion.ground
    ends = standing if on_four else ("left_ankle", "right_ankle")
    ankle = 0.0
    if set(ends) <= set(points):
        heights = np.stack([points[role][:, 2] for role in ends], 1)
        # the height of an ankle over a flat foot; single frames may be lower, so not the minimum
        ankle = float(np.percentile(heights.min(1), 5)) - floor
    return Measures(lengths, ankle, floor, noise, flat, straight)


def read_person(
    motion: HumanMotion,
    roles: Mapping[str, str],
    measures: Measures | None = None,
    standing: tuple[str, ...] = CONTACT_POINTS,
) -> Person:
    """Return the person of a clip.

    ``measures`` are those of a person whom the clip is too short to show; None: measured from the clip. ``standing``
    are the points whose contact with the floor counts (``Profile.standing``).
    """
    known = measure(motion, roles, standing) if measures is None else measures
    down = np.array([0.0, 0.0, known.floor])
    points = _with_soles({role: motion.track(name) for role, name in roles.items()}, known.flat)
    points = {role: track - down for role, track in points.items()}
    contact = None if standing != CONTACT_POINTS and "left_toe" in roles else motion.contact
    if contact is None and standing and set(standing) <= set(points):
        soles = np.stack([points[name] for name in standing], 1)
        contact = find_contact(soles, motion.fps, 0.0, noise=known.noise)
    turns, straight = _turns(points), known.straight
    pelvis, torso = (turns[k] if straight is None else _from_rest(turns[k], straight[k][0]) for k in range(2))
    level = np.broadcast_to(np.eye(3), (motion.frames, 2, 3, 3))
    root = path_of(points)
    return Person(
        fps=motion.fps,
        points=points,
        pelvis=pelvis,
        torso=torso,
        root=root,
        feet=np.stack([_foot(points, side) for side in SIDES], 1) if _has_legs(points) else level,
        contact=np.zeros((motion.frames, 4), bool) if contact is None else np.asarray(contact, bool),
        lengths=known.lengths,
        ankle=known.ankle,
        objects={name: poses - np.pad(down, (0, 4)) for name, poses in motion.objects.items()},
        touches=motion.touches,
    )


def bone_length(points: Mapping[str, np.ndarray], limb: Limb) -> float:
    """Return the median over frames of a limb's length [m]: between its ends, or along the bones of a finger."""
    roles = [role for role in chain(limb) if role in points] if limb in FINGER_REACHES else limb
    bones = [np.linalg.norm(points[b] - points[a], axis=-1) for a, b in itertools.pairwise(roles)]
    return float(np.median(sum(bones)))


def _has_legs(points: Mapping[str, np.ndarray]) -> bool:
    """Return whether both legs are known from hip to ankle."""
    return all(role in points for limb in LEGS for role in limb)


def _middle(points: Mapping[str, np.ndarray], *parts: str) -> np.ndarray:
    """Return the midpoint of the left and the right of the first part of which one at least is known. (F, 3)."""
    for part in parts:
        found = [points[f"{side}_{part}"] for side in SIDES if f"{side}_{part}" in points]
        if found:
            return 0.5 * (found[0] + found[-1])
    raise OsikValueError(f"none of these is known: {', '.join(parts)}")


def path_of(points: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the point of a person that the robot's path follows: the wrist of a hand, else the middle of the hips."""
    return points["wrist"] if "wrist" in points else _middle(points, "hip", "shoulder")


def palm_axes(points: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return a hand's axes as columns: z from wrist to knuckles, y as near to the index as possible. (..., 3, 3).

    The knuckles of fingers that one hand has and another lacks do not turn z: it goes to the middle finger's, if known.
    """
    knuckles = {finger: points[f"{finger}_1"] for finger in FINGERS[1:] if f"{finger}_1" in points}
    first, *_, last = knuckles.values()
    z = unit(knuckles.get("middle", 0.5 * (first + last)) - points["wrist"])
    x = unit(_cross(first - last, z))
    return np.stack([x, _cross(z, x), z], -1)


def _turns(points: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of pelvis and chest as columns; upright if the clip lacks joints. (F, 3, 3) each."""
    if "wrist" in points:
        return palm_axes(points), palm_axes(points)
    low, vertical = _middle(points, "hip", "shoulder"), np.array([0.0, 0.0, 1.0])
    high = points["neck"] if "neck" in points else _middle(points, "shoulder", "hip")
    chest = points.get("chest", low)

    def or_else(part: np.ndarray, other: np.ndarray) -> np.ndarray:
        return np.where(np.linalg.norm(part, axis=-1, keepdims=True) > _SPINE, part, other)

    def axes(parts: tuple[str, str], part: np.ndarray) -> np.ndarray:
        up = or_else(or_else(part, high - low), vertical)
        pairs = [(f"left_{name}", f"right_{name}") for name in parts]
        known = [points[left] - points[right] for left, right in pairs if {left, right} <= set(points)]
        return axes_from(known[0] if known else np.broadcast_to(np.eye(3)[1], up.shape), up)

    return axes(("hip", "shoulder"), chest - low), axes(("shoulder", "hip"), high - chest)


def _upright(points: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of pelvis and chest of a person who is upright and faces x, from a clip. (1, 3, 3) each.

    The line through hips and chest joint slants in some skeletons, by 33 degrees in LAFAN1's. Its pitch relative to the
    line from hips to neck is therefore measured: the median over the frames in which the person is tallest.
    """
    trunk = _turns({role: track for role, track in points.items() if role != "chest"})
    top = points["neck"] if "neck" in points else _middle(points, "shoulder", "hip")
    ankles = [points[f"{side}_ankle"][:, 2] for side in SIDES if f"{side}_ankle" in points]
    height = top[:, 2] - np.min(ankles or [_middle(points, "hip", "shoulder")[:, 2]], 0)
    tallest = np.percentile(height, 95)
    tall = height >= tallest - _TALL * abs(tallest)
    found = []
    for upright, axes in zip(trunk, _turns(points), strict=True):
        pitched = np.swapaxes(upright, -1, -2) @ axes
        pitch = np.median(np.arctan2(pitched[:, 0, 2], pitched[:, 2, 2])[tall])
        found.append(Rotation.from_rotvec([[0.0, pitch, 0.0]]).as_matrix())
    return found[0], found[1]


def _from_rest(axes: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """Return axes relative to the rest pose, so that they are upright there whatever the heading. (F, 3, 3)."""
    heading = axes_from(rest[:, 1] * [1.0, 1.0, 0.0], np.array([0.0, 0.0, 1.0]))
    return axes @ rest.T @ heading


def _foot(points: Mapping[str, np.ndarray], side: str) -> np.ndarray:
    """Return the axes of a foot as columns: x along the sole, z as near to the shank as possible. (F, 3, 3)."""
    shank = points[f"{side}_knee"] - points[f"{side}_ankle"]
    return foot_axes(points[f"{side}_toe"] - points[f"{side}_heel"], shank)


def _with_soles(
    points: Mapping[str, np.ndarray], flat: Mapping[str, Mapping[str, np.ndarray]]
) -> dict[str, np.ndarray]:
    """Return the points with missing heels and toes added, fixed to the foot as in its flat pose."""
    out = dict(points)
    for side in flat:
        out |= _toes(out, side)
        if f"{side}_heel" not in out:
            out[f"{side}_heel"] = _heel(out, flat[side], side)
    return out


def _toes(points: Mapping[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """Return a missing toe: below and in front of the ankle, at right angles to the shank and sized after it [m]."""
    if f"{side}_toe" in points:
        return {}
    shank = points[f"{side}_ankle"] - points[f"{side}_knee"]
    forward = _cross(points["left_hip"] - points["right_hip"], -shank)
    length = np.linalg.norm(shank, axis=-1, keepdims=True)
    return {f"{side}_toe": points[f"{side}_ankle"] + length * (_TOE * unit(forward) + _SOLE * unit(shank))}


def _flat(points: Mapping[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """Return knee, ankle and toe in one frame in which the foot is presumably flat [m]. (1, 3) each.

    Of the 5 % of frames with the lowest ankle and toe, the one with the median height difference is taken; others may
    have the foot in the floor or on its tip.
    """
    ankle, toe = points[f"{side}_ankle"][:, 2], points[f"{side}_toe"][:, 2]
    low = np.argsort(ankle + toe, kind="stable")[: int(np.ceil(_FLAT * len(toe)))]
    frame = low[np.argsort((ankle - toe)[low], kind="stable")[len(low) // 2]]
    return {role: points[role][frame, None] for role in (f"{side}_knee", f"{side}_ankle", f"{side}_toe")}


def _heel(points: Mapping[str, np.ndarray], flat: Mapping[str, np.ndarray], side: str) -> np.ndarray:
    """Return the heel: slightly behind the ankle, and as low as the toe in the flat pose [m]. (F, 3)."""

    def axes(at: Mapping[str, np.ndarray]) -> np.ndarray:
        ankle = at[f"{side}_ankle"]
        return foot_axes(at[f"{side}_toe"] - ankle, at[f"{side}_knee"] - ankle)

    ankle, toe = flat[f"{side}_ankle"][0], flat[f"{side}_toe"][0]
    heel = ankle - _HEEL * (toe - ankle)
    heel[2] = toe[2]
    return points[f"{side}_ankle"] + axes(points) @ (axes(flat)[0].T @ (heel - ankle))


def with_path(motion: HumanMotion, roles: Mapping[str, str]) -> HumanMotion:
    """Return a clip with the person's path, if the middle of the hips is its origin, as pose estimators have it.

    The lowest of heels and toes (of ankles without these) is on the floor in each frame, and does not move to the next.
    So a jump has no flight. An ``OsikWarning`` says that the path is inferred.
    """
    points = {role: motion.track(name) for role, name in roles.items()}
    ends = [f"{side}_{part}" for side in SIDES for part in ("heel", "toe")]
    ends = [role for role in ends if role in points] or [f"{side}_ankle" for side in SIDES]
    if not {*ends, "left_hip", "right_hip"} <= set(points):
        return motion
    if np.linalg.norm(points["left_hip"] + points["right_hip"], axis=-1).max() > 2.0 * _CENTERED:
        return motion
    feet = np.stack([points[role] for role in ends], 1)
    steps = noise_steps(find_noise(feet), motion.fps)
    feet = mean_over(feet.reshape(motion.frames, -1), steps).reshape(feet.shape)
    # a point that stands is among the lowest before and after a step
    lowest = np.maximum(feet[:-1, :, 2], feet[1:, :, 2]).argmin(1)
    path = np.zeros((motion.frames, 3))
    path[1:] = -np.cumsum(np.diff(feet, axis=0)[np.arange(len(lowest)), lowest], 0)
    path[:, 2] = -feet[..., 2].min(1)
    warn(f"{motion.name} has the hips at the origin in all frames; its path is inferred from the lowest foot")
    moved = {name: poses + np.pad(path, ((0, 0), (0, 4))) for name, poses in motion.objects.items()}
    return dataclasses.replace(motion, positions=motion.positions + path[:, None], objects=moved)

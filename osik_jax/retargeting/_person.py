"""Person seen by retargeting: limb directions, trunk and foot orientations, and contacts, from a clip's joints."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from .._errors import OsikValueError, warn
from ._contact import find_contact, find_noise
from ._floor import Floor, find_floor
from ._motion import CONTACT_POINTS, HumanMotion
from ._roles import LIMBS, SIDES
from ._up import find_up

# Vectors shorter than this [m] have no direction; a spine shorter than 1 mm means chest and hips are one joint.
_SHORTEST = 1e-9
_SPINE = 1e-3
# A missing toe is 0.35 shanks before and 0.12 shanks below the ankle; a missing heel is 0.3 feet behind it.
_TOE, _SOLE, _HEEL = 0.35, 0.12, 0.3
# Share of frames among which a flat foot is searched.
_FLAT = 0.05
# Lengths of a leg [m] outside which the file's unit must be wrong.
_LEGS = (0.1, 3.0)


@dataclasses.dataclass(frozen=True)
class Person:
    """Motion of a person in world axes with z up and the floor at height 0.

    Attributes:
        fps: frame rate [1/s].
        points: positions by role, heels and toes included [m]. (F, 3) each
        directions: unit vectors along each of ``LIMBS``. (F, 8, 3)
        pelvis: forward, left and up axes of the pelvis as columns. (F, 3, 3)
        torso: forward, left and up axes of the chest as columns. (F, 3, 3)
        root: midpoint of the hips [m]. (F, 3)
        feet: forward, left and up axes of the left and right foot as columns. (F, 2, 3, 3)
        contact: whether left heel, left toe, right heel and right toe stand. (F, 4)
        leg: length of a leg, thigh and shank [m].
        ankle: height of the ankles above the floor when standing [m].
    """

    fps: float
    points: Mapping[str, Float[np.ndarray, "F 3"]]
    directions: Float[np.ndarray, "F 8 3"]
    pelvis: Float[np.ndarray, "F 3 3"]
    torso: Float[np.ndarray, "F 3 3"]
    root: Float[np.ndarray, "F 3"]
    feet: Float[np.ndarray, "F 2 3 3"]
    contact: Bool[np.ndarray, "F 4"]
    leg: float
    ankle: float


def unit(vector: np.ndarray) -> np.ndarray:
    """Return vectors scaled to unit length; the x axis where the length is 0. (..., 3)."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > _SHORTEST, vector / np.maximum(length, _SHORTEST), np.eye(3)[0])


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
    """Constant measures of a person: leg length, ankle height, floor, noise and reference poses.

    Attributes:
        leg: length of a leg, thigh and shank [m].
        ankle: height of the ankles above the floor when standing [m].
        floor: the floor under the clip.
        noise: standard deviation of each coordinate of heels and toes [m].
        flat: per side, positions of knee, ankle and toe while the foot is flat on the floor [m]. (1, 3) each
        straight: axes of pelvis and chest in the rest pose; None if unknown. (1, 3, 3) each
    """

    leg: float
    ankle: float
    floor: Floor
    noise: float
    flat: Mapping[str, Mapping[str, np.ndarray]]
    straight: tuple[np.ndarray, np.ndarray] | None


def measure(motion: HumanMotion, roles: Mapping[str, str]) -> Measures:
    """Measure a person and the floor from a clip.

    Args:
        motion: the clip.
        roles: joint name of the clip for each role (``find_roles``).

    An ``OsikWarning`` is given if z does not seem to point up.

    Raises:
        ValueError: the legs are shorter than 0.1 m or longer than 3 m, so the clip is not in metres.
    """
    points = {role: motion.track(name) for role, name in roles.items()}
    up, other = find_up(motion, "z", roles)
    other = up if up != "z" else other
    if other is not None:
        warn(
            f"{motion.name}: z is taken to point up, and the motion looks as if {other} did; "
            f"load_motion(path, up={other!r}) and --up={other} turn {other} up"
        )
    straight, flat = None, {side: _flat({**points, **_toes(points, side)}, side) for side in SIDES}
    if motion.rest_positions is not None:
        at = {role: motion.joint_names.index(name) for role, name in roles.items()}
        rest = {role: motion.rest_positions[None, i] for role, i in at.items()}
        flat = {side: {**rest, **_toes(rest, side)} for side in SIDES}
        straight = _turns(_with_soles(rest, flat))
    leg = 0.5 * float(sum(np.linalg.norm(points[b] - points[a], axis=-1).mean() for a, b in LIMBS[:4]))
    if not _LEGS[0] < leg < _LEGS[1]:
        raise OsikValueError(f"the legs of {motion.name} are {leg:.4g} m long; positions are metres")
    soles = _with_soles(points, flat)
    found = np.stack([soles[name] for name in CONTACT_POINTS], 1)
    noise = find_noise(found)
    floor = find_floor(found, motion.fps, noise) if motion.ground is None else Floor(motion.ground)
    ankles = np.stack([points["left_ankle"], points["right_ankle"]], 1)
    # the height of an ankle over a flat foot; single frames may be lower, so not the minimum
    ankle = float(np.percentile(floor.leveled(ankles, motion.fps)[..., 2].min(1), 5))
    return Measures(leg, ankle, floor, noise, flat, straight)


def read_person(motion: HumanMotion, roles: Mapping[str, str], measures: Measures | None = None) -> Person:
    """Return the person of a clip.

    Args:
        motion: the clip.
        roles: joint name of the clip for each role (``find_roles``).
        measures: measures of the person if the clip is too short to show them; None: measured from the clip.
    """
    known = measure(motion, roles) if measures is None else measures
    # a drift counts from the first frame of the measured clip, which another clip does not share
    floor = known.floor if measures is None else dataclasses.replace(known.floor, drift=0.0)
    points = _with_soles({role: motion.track(name) for role, name in roles.items()}, known.flat)
    points = {role: floor.leveled(track, motion.fps) for role, track in points.items()}
    contact = motion.contact
    if contact is None:
        soles = np.stack([points[name] for name in CONTACT_POINTS], 1)
        contact = find_contact(soles, motion.fps, 0.0, noise=known.noise)
    turns, straight = _turns(points), known.straight
    pelvis, torso = (turns[k] if straight is None else _from_rest(turns[k], straight[k][0]) for k in range(2))
    return Person(
        fps=motion.fps,
        points=points,
        directions=unit(np.stack([points[b] - points[a] for a, b in LIMBS], 1)),
        pelvis=pelvis,
        torso=torso,
        root=0.5 * (points["left_hip"] + points["right_hip"]),
        feet=np.stack([_foot(points, side) for side in SIDES], 1),
        contact=np.asarray(contact, bool),
        leg=known.leg,
        ankle=known.ankle,
    )


def _turns(points: Mapping[str, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return the axes of the pelvis and of the chest as columns. (F, 3, 3) each."""
    hips = 0.5 * (points["left_hip"] + points["right_hip"])
    shoulders = 0.5 * (points["left_shoulder"] + points["right_shoulder"])
    neck = points.get("neck", shoulders)
    chest = points.get("chest", hips)
    spine = chest - hips
    up = np.where(np.linalg.norm(spine, axis=-1, keepdims=True) > _SPINE, spine, neck - hips)
    pelvis = axes_from(points["left_hip"] - points["right_hip"], up)
    return pelvis, axes_from(points["left_shoulder"] - points["right_shoulder"], neck - chest)


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
    for side in SIDES:
        out |= _toes(out, side)
        if f"{side}_heel" not in out:
            out[f"{side}_heel"] = _heel(out, flat[side], side)
    return out


def _toes(points: Mapping[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    return {} if f"{side}_toe" in points else {f"{side}_toe": _toe(points, side)}


def _toe(points: Mapping[str, np.ndarray], side: str) -> np.ndarray:
    """Return a toe below and in front of the ankle, at right angles to the shank, sized after the shank [m]. (F, 3)."""
    shank = points[f"{side}_ankle"] - points[f"{side}_knee"]
    forward = _cross(points["left_hip"] - points["right_hip"], -shank)
    length = np.linalg.norm(shank, axis=-1, keepdims=True)
    return points[f"{side}_ankle"] + length * (_TOE * unit(forward) + _SOLE * unit(shank))


def _flat(points: Mapping[str, np.ndarray], side: str) -> dict[str, np.ndarray]:
    """Return knee, ankle and toe in one frame in which the foot is presumably flat [m]. (1, 3) each.

    Of the 5 % of frames with the lowest ankle and toe, the one with the median height difference is taken; others may
    have the foot in the floor or on its tip.
    """
    ankle, toe = points[f"{side}_ankle"][:, 2], points[f"{side}_toe"][:, 2]
    low = np.argsort(ankle + toe, kind="stable")[: int(np.ceil(_FLAT * len(toe)))]
    frame = low[np.argsort((ankle - toe)[low], kind="stable")[len(low) // 2]]
    return {
        name: points[f"{side}_{name.split('_', 1)[1]}"][frame, None]
        for name in (f"{side}_knee", f"{side}_ankle", f"{side}_toe")
    }


def _heel(points: Mapping[str, np.ndarray], flat: Mapping[str, np.ndarray], side: str) -> np.ndarray:
    """Return the heel: slightly behind the ankle, and as low as the toe in the flat pose [m]. (F, 3)."""

    def axes(at: Mapping[str, np.ndarray]) -> np.ndarray:
        ankle = at[f"{side}_ankle"]
        return foot_axes(at[f"{side}_toe"] - ankle, at[f"{side}_knee"] - ankle)

    ankle, toe = flat[f"{side}_ankle"][0], flat[f"{side}_toe"][0]
    heel = ankle - _HEEL * (toe - ankle)
    heel[2] = toe[2]
    return points[f"{side}_ankle"] + axes(points) @ (axes(flat)[0].T @ (heel - ankle))

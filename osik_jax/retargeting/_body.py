"""Data derived from a robot and its profile: collision pairs, a person's goals, and the first guess of a plan."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import distance_transform_edt
from scipy.spatial.transform import Rotation

from .._errors import OsikValueError
from ..kinematics._forward import home_kinematics, independent_columns
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._contact import stretches
from ._facing import facing_at_home
from ._goals import Goals
from ._person import Person, axes_from, directions, palm_axes
from ._places import pairs_at_home
from ._profile import Limb, Profile, world_points
from ._roles import LEGS, SIDES
from ._rotations import moved_poses
from ._terms import ORIGIN, Bounds, reach_length

_TOUCH, _NEARS = 1e5, 0.03
"""Weight of what is held [1/m^2], relative to that of limbs, and the time in which it grows tenfold before [s]: a hand
that begins to move in the frame before would have to accelerate beyond its limits.
"""
# A plan stays 1 mrad (or 1 mm) inside the ranges and below 98 % of speed and acceleration limits, so that the
# last pass, which holds the limits exactly, can follow it.
_INSET, _SHARE = 1e-3, 0.98
_LONG = 15
"""Number of frames of contact beyond which a contact point gets a larger weight. A pull of 1 per frame, as that of a
limb 1 rad off, then moves the point by at most ``_LONG^2 / 4`` over ``Weights.stance``, which is 0.06 mm.
"""
_AT_END, _ARM_AT_END, _BENT = 0.01, 0.05, 1.0
"""Shares of a joint's range: a leg joint within 1 % of an end, or an arm joint within 5 % (a GR3's elbow extends 3 %
beyond straight), starts from a bent position. That position is 1 rad from the end, or the middle of the range if
nearer.
"""
_LEANS, _FINGER_AT_END = 0.3, 0.25
"""A finger's joint that bends backwards by 0.3 rad or more, and by less than 25 % of its range (a LEAP's by 0.31 to
0.51 rad), starts 0.3 rad forward.
"""


def pairs_apart(robot: Robot, profile: Profile) -> list[tuple[int, int]]:
    """Return the pairs of capsules that a plan keeps apart (``pairs_at_home``), as indices of the profile's capsules.

    A pair is left out if it is implied by another: one capsule is inside a wider capsule that is kept from the same
    shape.
    """
    pairs = pairs_at_home(robot, profile)
    around = [{i, *(j for j, c in enumerate(profile.capsules) if c.hides(own))}
              for i, own in enumerate(profile.capsules)]  # fmt: skip
    kept = {frozenset(pair) for pair in pairs}

    def follows(a: int, b: int) -> bool:
        return any(frozenset(wider) in kept for wider in itertools.product(around[a], around[b]) if wider != (a, b))

    return [pair for pair in pairs if not follows(*pair)]


@dataclasses.dataclass(frozen=True)
class Build:
    """Dimensions and limits of a robot with its profile, taken at its home configuration, as NumPy arrays."""

    robot: Robot
    profile: Profile
    points: Mapping[str, Float[np.ndarray, "3"]]  # world positions of the keypoints [m]
    lengths: Mapping[Limb, float]  # lengths of the limbs that give the scale (``measured``) [m]
    ankle: float  # height of the ankles above the soles, or of the pelvis if the robot does not walk [m]
    # the point that follows the person's path: midpoint of the hips, or the pelvis without legs [m]
    root: Float[np.ndarray, "3"]
    base: Float[np.ndarray, "3"]  # origin of the root body [m]
    turn: Float[np.ndarray, "3 3"]  # rotation matrix of the root body
    facing: Float[np.ndarray, "3 3"]  # forward, left and up axes of the robot as columns
    start: Float[np.ndarray, " nq"]  # the home configuration with limbs bent (``_with_bent_limbs``)
    free: int | None  # index of the base's free joint in q; None: the base is fixed

    @classmethod
    def of(cls, robot: Robot, profile: Profile) -> Build:
        """Measure a robot at its home configuration."""
        kinematics = home_kinematics(robot)
        root, origin = robot.tree.body_names[robot.tree.root], (0.0, 0.0, 0.0)
        places = [*profile.keypoints.values(), *profile.corners, (profile.pelvis, origin), (root, origin)]
        positions = world_points(robot, kinematics, places)
        points = dict(zip(profile.keypoints, positions, strict=False))
        lengths = {(a, b): float(np.linalg.norm(points[b] - points[a])) for a, b in measured(profile)}
        lengths |= {limb: reach_length(robot, profile, limb) for limb in profile.reached if limb in lengths}
        ankle = 0.0
        if profile.feet:
            ends = profile.standing if len(profile.feet) == 4 else [f"{side}_ankle" for side in SIDES]
            above = [points[role][2] for role in ends] if profile.walks else positions[-2, 2]
            ankle = float(np.mean(above) - np.mean(positions[len(points) : -2, 2] - profile.rises))
        bases = robot.tree.free_bases
        return cls(
            robot=robot,
            profile=profile,
            points=points,
            lengths=lengths,
            ankle=ankle,
            root=0.5 * (points["left_hip"] + points["right_hip"]) if profile.walks else positions[-2],
            base=positions[-1],
            turn=np.asarray(kinematics.frame_pose(robot, root)[1]),
            facing=palm_axes(points) if profile.is_hand else facing_at_home(robot, profile.across),
            start=_with_bent_limbs(robot, profile),
            free=robot.tree.qpos_address[bases[0]] if bases else None,
        )

    def seen(self, person: Person) -> Person:
        """Return the person without the motion that the robot's base cannot follow.

        A walking robot follows the person in the world. A robot on wheels stays upright and follows heading and path. A
        robot whose feet stay in place follows orientations relative to the heading. A robot with a fixed base follows
        limbs relative to the trunk: to the pelvis if its own trunk bends, else to the chest.
        """
        profile, frames = self.profile, len(person.root)
        if profile.walks and self.free is not None:
            return person
        trunk = person.torso if profile.torso is None else person.pelvis
        heading = axes_from(trunk[..., 1] * [1.0, 1.0, 0.0], np.array([0.0, 0.0, 1.0]))
        fixed = self.free is None
        to = heading if profile.rolls and not fixed else np.broadcast_to(self.facing, trunk.shape)
        turn = to @ np.swapaxes(trunk if fixed or profile.rolls else heading, 1, 2)
        root = np.tile(self.root, (frames, 1))
        root[:, 2] = self.root[2] if fixed else self.ankle
        if profile.rolls and not fixed:
            root[:, :2] = self.scale(person) * person.root[:, :2]
        points = {role: root + np.einsum("fij,fj->fi", turn, at - person.root) for role, at in person.points.items()}
        return dataclasses.replace(
            person,
            points=points,
            pelvis=turn @ trunk,
            torso=turn @ person.torso,
            root=root,
            feet=turn[:, None] @ person.feet,
            objects={
                name: moved_poses(poses, turn, root - np.einsum("fij,fj->fi", turn, person.root))
                for name, poses in person.objects.items()
            },
            contact=np.full((frames, 4), bool(profile.feet) and not fixed),
        )

    def scale(self, person: Person) -> float:
        """Return the factor on the person's path: the profile's, or the ratio of limb lengths times ``stretch``."""
        profile = self.profile
        if profile.scale is not None:
            return profile.scale
        return profile.stretch * sum(self.lengths.values()) / sum(person.lengths[limb] for limb in measured(profile))

    def goals(self, person: Person, firm: bool = True) -> Goals:
        """Return the goals for a person (``seen``): hip path, ankle height and directions on the robot.

        ``firm``: whether long contacts get a larger weight (``_firmness``).
        """
        profile, root = self.profile, person.root
        if profile.walks and self.free is not None:
            scale = self.scale(person)
            root = scale * root
            root[:, 2] += self.ankle - scale * person.ankle
        reached, followed, touches = profile.reached, profile.followed, self.touches(person)
        wanted = directions(person.points, followed)
        for k, (a, b) in enumerate(reached, len(followed) - len(reached)):
            length = person.lengths[a, b] if profile.walks else self.lengths[a, b] / self.scale(person)
            wanted[:, k] = (person.points[b] - person.points[a]) / length
        pulls = [_pull(touch.held, person.fps)[:, None] for touch in touches]
        dtype = self.start.dtype
        parts: dict[str, Any] = {  # NumPy's arrays: each one of JAX's would cost more than its numbers
            **{name: getattr(person, name) for name in ("pelvis", "torso", "feet")},
            "directions": np.concatenate([wanted, *(touch.goal[:, None] for touch in touches)], 1),
            "held": np.concatenate([np.ones((len(root), len(reached))), *pulls], 1),
            "contact": _firmness(person.contact) if firm and dtype == np.float64 else person.contact,
            "root": root,
            "present": np.ones(len(root)),
        }
        return Goals(**{name: part.astype(dtype) for name, part in parts.items()})

    def touches(self, person: Person) -> tuple[TouchGoal, ...]:
        """Return what the robot's joints hold, for a person (``seen``)."""
        out, scale = [], self.scale(person) if person.touches else 1.0
        for role, other, held in person.touches:
            if role not in self.points:
                raise OsikValueError(f"the profile has no keypoint {role}, which holds {other}")
            at = person.points[role]
            if other in person.objects:
                goal = self._in_world(person, held_point(person.objects[other], at, held), scale)
                out.append(TouchGoal(ORIGIN, role, goal, held))
            elif other in self.points:
                out.append(TouchGoal(other, role, scale * (at - person.points[other]), held))
            else:
                raise OsikValueError(f"{role} holds {other}, which is no object of the clip and no keypoint")
        return tuple(out)

    def objects(self, person: Person) -> dict[str, Float[np.ndarray, "F 7"]]:
        """Return poses of the person's objects in the robot's world; positions are scaled like the path of its base."""
        return {
            name: np.concatenate([self._in_world(person, poses[:, :3], self.scale(person)), poses[:, 3:]], -1)
            for name, poses in person.objects.items()
        }

    def _in_world(self, person: Person, at: Float[np.ndarray, "F 3"], scale: float) -> Float[np.ndarray, "F 3"]:
        """Return points of a person's world in the robot's: scaled, about the root if the base does not walk."""
        walks = self.profile.walks and self.free is not None
        return scale * at if walks else person.root + scale * (at - person.root)

    def first_guess(self, goals: Goals) -> Float[np.ndarray, "F nq"]:
        """Return configurations with the start posture in all frames and the pelvis at the goal pose. (F, nq)."""
        turn = np.asarray(goals.pelvis)
        q = np.tile(self.start, (len(turn), 1))
        if self.free is not None:
            at = self.free
            q[:, at : at + 3] = np.asarray(goals.root) - turn @ (self.root - self.base)
            q[:, at + 3 : at + 7] = Rotation.from_matrix(turn @ self.turn).as_quat(scalar_first=True)
        return q

    def bounds(self, acceleration: Float[np.ndarray, " nv"], dt: float) -> Bounds:
        """Return the joint bounds of a plan, slightly inside the robot's limits so that the last pass has room."""
        robot = self.robot
        lower, upper, speed = map(np.asarray, (robot.position_lower, robot.position_upper, robot.velocity_limit))
        inset = np.minimum(_INSET, 0.01 * (upper - lower))
        parts: list[Any] = [lower + inset, upper - inset, _SHARE * speed * dt, _SHARE * acceleration * dt**2]
        return Bounds(*(part.astype(self.start.dtype) for part in parts))


class TouchGoal(NamedTuple):
    """Goal of a joint that holds an object or another joint: its vector from what it holds."""

    first: str  # another joint's role, or ``ORIGIN``
    second: str  # the joint's role
    goal: Float[np.ndarray, "F 3"]  # vector from the first to the second [m]
    held: Bool[np.ndarray, " F"]  # whether it is held


def _pull(held: Bool[np.ndarray, " F"], fps: float) -> Float[np.ndarray, " F"]:
    """Return the weight of a touch goal: full while it is held, rising before and falling after. (F,)."""
    if not held.any():
        return np.zeros(len(held))
    weight = _TOUCH * 10.0 ** (-distance_transform_edt(~held) / (_NEARS * fps))
    return np.where(weight >= 1.0, weight, 0.0)


def held_point(
    poses: Float[np.ndarray, "F 7"], at: Float[np.ndarray, "F 3"], held: Bool[np.ndarray, " F"]
) -> Float[np.ndarray, "F 3"]:
    """Return a joint's positions as if it did not move on the object while it holds it [m]. (F, 3)."""
    turns, out = Rotation.from_quat(poses[:, 3:], scalar_first=True), at.copy()
    inside = turns.inv().apply(at - poses[:, :3])
    for start, end in stretches(held):
        out[start:end] = poses[start:end, :3] + turns[start:end].apply(inside[start:end].mean(0))
    return out


def measured(profile: Profile) -> tuple[Limb, ...]:
    """Return the limbs whose lengths are compared with the person's: the legs, or all limbs without legs."""
    return LEGS if profile.walks and len(profile.feet) == 2 else profile.reached or profile.followed


def _firmness(contact: Bool[np.ndarray, "F 4"]) -> Float[np.ndarray, "F 4"]:
    """Return the weight factor of each contact point: 1 in contact, more in a long contact, 0 elsewhere. (F, 4).

    Without the factor the drift of a standing point grows with the square of the contact's duration. The weight of a
    step is ``stance`` times the square of this factor, which cancels that growth. Single precision gets no factor: such
    a weight would lose the limb terms to rounding.
    """
    out = contact.astype(float)
    for k in range(contact.shape[1]):
        for start, end in stretches(contact[:, k]):
            out[start:end, k] = max(1.0, (end - start) / _LONG)
    return out


def _with_bent_limbs(robot: Robot, profile: Profile) -> Float[np.ndarray, " nq"]:
    """Return the home configuration with limb joints that are at an end of their range moved inside it. (nq,).

    A straight limb that bends to one side only is singular. The range bound blocks its hinge, and a rotation of the
    hinge does not move the limb's end to first order, so the solver cannot bend it. A finger that bends backwards too
    would stay bent to that side.
    """
    q = np.array(robot.q0)
    scalar, index = scalar_layout(robot)
    ends = [profile.keypoints[end][0] for _, end in profile.followed]
    legs = [end.endswith(("knee", "ankle")) for _, end in profile.followed]
    bodies = [robot.tree.frame_bodies[robot.tree.frame(frame)] for frame in ends]
    each = np.asarray(independent_columns(robot.tree, jnp.asarray(robot.tree.moves[bodies], float))).astype(bool)
    moves, at_end = each.any(0), np.where(each[legs].any(0), _AT_END, _ARM_AT_END)
    lower, upper = np.asarray(robot.position_lower), np.asarray(robot.position_upper)
    for dof in np.flatnonzero(scalar & moves & np.isfinite(upper - lower)):
        width, below, above = upper[dof] - lower[dof], q[index[dof]] - lower[dof], upper[dof] - q[index[dof]]
        inside = min(_BENT, 0.5 * width)
        if below < at_end[dof] * width:
            q[index[dof]] = lower[dof] + inside
        elif above < at_end[dof] * width:
            q[index[dof]] = upper[dof] - inside
        elif profile.is_hand and _LEANS <= min(below, above) < _FINGER_AT_END * width:
            q[index[dof]] += _LEANS if below < above else -_LEANS
    return q

"""Profile of a robot: frames that stand for a person's joints, soles, collision capsules, scale and weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from .._errors import OsikValueError, unknown_name
from ..kinematics import Kinematics
from ..robot import Robot
from ._goals import Weights
from ._roles import FINGER_REACHES, FINGERS, HAND, LIMBS, NEEDED, REACHES, STANDING

Point = tuple[float, float, float]
Place = tuple[str, Point]
"""A frame of the robot, and a point in it [m]."""
Limb = tuple[str, str]
"""Two roles, the first and the second end of a limb."""


@dataclasses.dataclass(frozen=True)
class Foot:
    """A foot's sole."""

    frame: str  # a frame of the robot with x forward and z up when the foot stands
    heel: tuple[Point, Point]  # the rear left and the rear right corner in that frame [m]
    toe: tuple[Point, Point]  # the front left and the front right corner in that frame [m]
    radius: float = 0.0  # radius of a round foot, whose corners are its centre [m]

    def __post_init__(self) -> None:
        _check_points(f"heel of {self.frame}", self.heel, (2, 3))
        _check_points(f"toe of {self.frame}", self.toe, (2, 3))
        if not self.radius >= 0.0:
            raise OsikValueError(f"the radius of {self.frame} is {self.radius}; it is a length in metres, 0 or more")


@dataclasses.dataclass(frozen=True)
class Capsule:
    """Collision capsule of a link: all points within a radius of a segment in a frame [m]."""

    frame: str
    start: Point
    end: Point
    radius: float

    def __post_init__(self) -> None:
        _check_points(f"start of the capsule on {self.frame}", self.start, (3,))
        _check_points(f"end of the capsule on {self.frame}", self.end, (3,))
        if not self.radius > 0.0:
            raise OsikValueError(
                f"the capsule on {self.frame} has radius {self.radius}; it is a length in metres, over 0"
            )

    def hides(self, other: Capsule) -> bool:
        """Return whether another capsule is inside this one, about the same segment."""
        return dataclasses.replace(other, radius=self.radius) == self and other.radius < self.radius


@dataclasses.dataclass(frozen=True)
class Profile:
    """A robot as retargeting sees it.

    Attributes:
        keypoints: place on the robot of those of a person's hips, knees, ankles, shoulders, elbows and wrists that it
            has. A limb may end early or be absent. A hand has ``wrist`` and ``thumb_1`` to ``little_4`` instead.
        pelvis: the frame that follows the orientation of the person's pelvis; x forward, z up.
        torso: the frame that follows the orientation of the person's chest; None: the robot's trunk is rigid.
        feet: ``left`` and ``right``; ``left_front`` and ``right_front`` too on four feet; empty without feet.
        capsules: shapes that are kept apart and above the floor.
        scale: factor on the person's path; None: the ratio of leg lengths (arm lengths without legs) times ``stretch``.
        stretch: factor on the ratio of lengths.
        weights: weights of the cost terms.
        rolls: whether the feet are wheels that roll in any direction: they stay on the floor and move along it.

    Raises:
        ValueError: a limb lacks its beginning, no limb is left, or feet, scale or stretch are invalid.
        KeyError: a role does not exist.
    """

    keypoints: Mapping[str, Place]
    pelvis: str
    torso: str | None = None
    feet: Mapping[str, Foot] = dataclasses.field(default_factory=dict)
    capsules: tuple[Capsule, ...] = ()
    scale: float | None = None
    stretch: float = 1.0
    weights: Weights = dataclasses.field(default_factory=Weights)
    rolls: bool = False

    def __post_init__(self) -> None:
        hips = "left_hip", "right_hip"
        missing = [a for a, b in (*LIMBS, hips, hips[::-1]) if b in self.keypoints and a not in self.keypoints]
        if missing:
            raise OsikValueError(
                f"the profile has no keypoints {', '.join(dict.fromkeys(missing))}; a limb begins at a hip or a "
                "shoulder, and there are two hips or none"
            )
        for role, (_, point) in self.keypoints.items():
            if role not in (*NEEDED, *HAND):
                raise unknown_name("keypoint", role, (*NEEDED, *HAND))
            _check_points(f"the keypoint {role}", point, (3,))
        knuckles = [finger for finger in FINGERS[1:] if f"{finger}_1" in self.keypoints]
        if self.is_hand and (len(knuckles) < 2 or "wrist" not in self.keypoints):
            raise OsikValueError("a hand has a keypoint wrist, and index_1, middle_1, ring_1 or little_1: two of these")
        if not self.followed:
            raise OsikValueError("the profile has no limb: give the keypoints of a leg or an arm")
        if self.feet and tuple(sorted(self.feet)) not in STANDING:
            known = " or ".join(", ".join(names) for names in STANDING)
            raise OsikValueError(f"the profile has feet {', '.join(self.feet)}; it has {known}, or none")
        if self.scale is not None and not self.scale > 0.0:
            raise OsikValueError(f"scale is {self.scale}; it is robot over person, more than 0")
        if not self.stretch > 0.0:
            raise OsikValueError(f"stretch is {self.stretch}; it has to be more than 0")

    @property
    def reached(self) -> tuple[Limb, ...]:
        """Return the pairs of roles whose vector is tracked, direction and length, relative to nominal lengths.

        Hip to ankle and shoulder to wrist of a robot that walks on four feet, wrist to fingertips of a hand.
        """
        pairs = FINGER_REACHES if self.is_hand else REACHES if len(self.feet) == 4 and self.walks else ()
        return tuple(pair for pair in pairs if set(pair) <= set(self.keypoints))

    @property
    def followed(self) -> tuple[Limb, ...]:
        """Return what is tracked: the limbs between keypoints that do not end where a reach does, then the reaches."""
        ends = {role for limb in self.reached for role in limb}
        limbs = (limb for limb in LIMBS if set(limb) <= set(self.keypoints) and not ends & set(limb))
        return (*limbs, *self.reached)

    @property
    def is_hand(self) -> bool:
        """Return whether the robot is a hand, which follows the wrist and the fingers of a person's."""
        return not set(HAND).isdisjoint(self.keypoints)

    @property
    def walks(self) -> bool:
        """Return whether the robot has legs that walk: feet and hips, and no wheels."""
        return bool(self.feet) and "left_hip" in self.keypoints and not self.rolls

    @property
    def standing(self) -> tuple[str, ...]:
        """Return the person's contact points that the robot's feet follow, such as heels and toes; () without feet."""
        return STANDING.get(tuple(sorted(self.feet)), ())

    @property
    def across(self) -> tuple[str, str] | None:
        """Return a frame on the left and its mirror on the right; None: no pair of hips or shoulders is known."""
        pairs = [("left_" + part, "right_" + part) for part in ("hip", "shoulder")]
        found = [pair for pair in pairs if set(pair) <= set(self.keypoints)]
        return (self.keypoints[found[0][0]][0], self.keypoints[found[0][1]][0]) if found else None

    @property
    def turned(self) -> tuple[str, str, str, str]:
        """Return the frames of pelvis, chest, left and right foot; the pelvis again if one is absent."""
        left, right = (self.feet[side].frame if side in self.feet else self.pelvis for side in ("left", "right"))
        return self.pelvis, self.torso or self.pelvis, left, right

    @property
    def frames(self) -> tuple[str, ...]:
        """Return all frames that the profile names, each once."""
        places = [*self.keypoints.values(), *self.corners, *((c.frame, c.start) for c in self.capsules)]
        trunk = [self.pelvis, *([] if self.torso is None else [self.torso])]
        return tuple(dict.fromkeys([*trunk, *(frame for frame, _ in places)]))

    @property
    def corners(self) -> tuple[Place, ...]:
        """Return two corners for each point of ``standing``.

        Of two feet, these are the corners of heel and toe; of four, the midpoints of heel and of toe.
        """
        parts = []
        for name in sorted(self.feet):
            foot = self.feet[name]
            pairs = (foot.heel, foot.toe) if len(self.feet) == 2 else ((_middle(*foot.heel), _middle(*foot.toe)),)
            parts += [(foot.frame, point) for pair in pairs for point in pair]
        return tuple(parts)

    @property
    def rises(self) -> tuple[float, ...]:
        """Return the height of each corner above the floor in contact: the radius of its foot [m]."""
        each = 8 // max(len(self.feet), 1)
        return tuple(self.feet[name].radius for name in sorted(self.feet) for _ in range(each))


def world_points(robot: Robot, kinematics: Kinematics, places: Sequence[Place]) -> Float[np.ndarray, "k 3"]:
    """Return where places of a robot are in the world [m]."""
    positions, rotations = (np.asarray(x) for x in kinematics.frame_poses(robot, [frame for frame, _ in places]))
    return positions + np.einsum("kij,kj->ki", rotations, np.array([point for _, point in places]))


def in_frame(
    robot: Robot, kinematics: Kinematics, frame: str, points: Float[np.ndarray, "*k 3"]
) -> Float[np.ndarray, "*k 3"]:
    """Return points of the world in a frame [m]."""
    position, rotation = (np.asarray(x) for x in kinematics.frame_pose(robot, frame))
    return (points - position) @ rotation


def as_place(robot: Robot, kinematics: Kinematics, frame: str, point: Float[np.ndarray, "3"]) -> Place:
    """Return a point of the world [m] as a place in a frame, rounded to 1 um."""
    x, y, z = np.round(in_frame(robot, kinematics, frame, point), 6).tolist()
    return frame, (x, y, z)


def _check_points(what: str, points: object, shape: tuple[int, ...]) -> None:
    """Raise ValueError unless these are points, finite and of a shape."""
    numbers = np.asarray(points, float)
    if numbers.shape != shape or not np.isfinite(numbers).all():
        raise OsikValueError(f"{what} is {points!r}, of shape {numbers.shape}; expected {shape}, finite, in metres")


def _middle(a: Point, b: Point) -> Point:
    """Return the midpoint of two points [m]."""
    return 0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2])

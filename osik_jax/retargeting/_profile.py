"""Profile of a robot: frames that stand for a person's joints, soles, collision capsules, scale and weights."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from .._errors import OsikValueError
from ._goals import Weights
from ._roles import NEEDED, SIDES

Point = tuple[float, float, float]
Place = tuple[str, Point]
"""A frame of the robot, and a point in it [m]."""


@dataclasses.dataclass(frozen=True)
class Foot:
    """A foot's sole.

    Attributes:
        frame: a frame of the robot with x forward and z up when the foot stands.
        heel: the rear left and the rear right corner in that frame [m].
        toe: the front left and the front right corner in that frame [m].
    """

    frame: str
    heel: tuple[Point, Point]
    toe: tuple[Point, Point]


@dataclasses.dataclass(frozen=True)
class Capsule:
    """Collision capsule of a link: all points within a radius of a segment in a frame [m]."""

    frame: str
    start: Point
    end: Point
    radius: float

    def hides(self, other: Capsule) -> bool:
        """Return whether another capsule is inside this one, about the same segment."""
        return dataclasses.replace(other, radius=self.radius) == self and other.radius < self.radius


@dataclasses.dataclass(frozen=True)
class Profile:
    """Mapping from a person to a robot, with shapes and weights.

    Attributes:
        keypoints: place on the robot of each of a person's hips, knees, ankles, shoulders, elbows and wrists.
        pelvis: the frame that follows the orientation of the person's pelvis; x forward, z up.
        torso: the frame that follows the orientation of the person's chest; None: the robot's trunk is rigid.
        feet: the left and the right foot.
        capsules: shapes that are kept apart and above the floor.
        scale: factor on the person's path; None: the ratio of leg lengths times ``stretch``.
        stretch: factor on the ratio of leg lengths.
        weights: weights of the cost terms.
    """

    keypoints: Mapping[str, Place]
    pelvis: str
    torso: str | None
    feet: Mapping[str, Foot]
    capsules: tuple[Capsule, ...] = ()
    scale: float | None = None
    stretch: float = 1.0
    weights: Weights = dataclasses.field(default_factory=Weights)

    def __post_init__(self) -> None:
        missing = [role for role in NEEDED if role not in self.keypoints]
        if missing:
            raise OsikValueError(f"the profile has no keypoints {', '.join(missing)}; it needs {', '.join(NEEDED)}")
        if set(self.feet) != set(SIDES):
            raise OsikValueError(f"the profile has feet {', '.join(self.feet) or 'none'}; it needs left and right")
        if self.scale is not None and not self.scale > 0.0:
            raise OsikValueError(f"scale is {self.scale}; it is robot over person, more than 0")
        if not self.stretch > 0.0:
            raise OsikValueError(f"stretch is {self.stretch}; it has to be more than 0")

    @property
    def frames(self) -> tuple[str, ...]:
        """Return all frames that the profile names, each once."""
        places = [*self.keypoints.values(), *self.corners, *((c.frame, c.start) for c in self.capsules)]
        trunk = [self.pelvis, *([] if self.torso is None else [self.torso])]
        return tuple(dict.fromkeys([*trunk, *(frame for frame, _ in places)]))

    @property
    def corners(self) -> tuple[Place, ...]:
        """Return the soles' corners: of the left foot two heel and two toe corners, then of the right foot."""
        return tuple(
            (self.feet[side].frame, point)
            for side in ("left", "right")
            for part in (self.feet[side].heel, self.feet[side].toe)
            for point in part
        )

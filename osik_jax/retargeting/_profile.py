"""What is known of a robot: which of its frames are a person's joints, where its soles are, what it is taken for."""

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
        frame: of the robot; x forward, z up when the foot stands.
        heel: the rear left and the rear right corner [m].
        toe: the front left and the front right corner [m].
    """

    frame: str
    heel: tuple[Point, Point]
    toe: tuple[Point, Point]


@dataclasses.dataclass(frozen=True)
class Capsule:
    """What a link is taken for: all points within a radius of a segment [m]."""

    frame: str
    start: Point
    end: Point
    radius: float

    def hides(self, other: Capsule) -> bool:
        """Whether another is inside this one, about the same segment."""
        return dataclasses.replace(other, radius=self.radius) == self and other.radius < self.radius


@dataclasses.dataclass(frozen=True)
class Profile:
    """A robot as retargeting sees it.

    Attributes:
        keypoints: of each of a person's joints, its place on the robot: hips, knees, ankles, shoulders, elbows, wrists.
        pelvis: the frame that turns as the person's pelvis; x forward, z up.
        torso: the frame that turns as the person's chest; None: the robot's trunk does not bend.
        feet: the left and the right foot.
        capsules: shapes that are kept from each other and above the floor.
        scale: robot over person: what the person's path is multiplied with; None: the ratio of their legs, and stretch.
        stretch: what the ratio of legs is multiplied with.
        weights: of what the robot is asked for.
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
        """All frames that it speaks of, each once."""
        places = [*self.keypoints.values(), *self.corners, *((c.frame, c.start) for c in self.capsules)]
        trunk = [self.pelvis, *([] if self.torso is None else [self.torso])]
        return tuple(dict.fromkeys([*trunk, *(frame for frame, _ in places)]))

    @property
    def corners(self) -> tuple[Place, ...]:
        """The soles' corners: of the left foot, two of the heel and two of the toe, then of the right."""
        return tuple(
            (self.feet[side].frame, point)
            for side in ("left", "right")
            for part in (self.feet[side].heel, self.feet[side].toe)
            for point in part
        )

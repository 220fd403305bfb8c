"""``osik calibrate``."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from ._inputs import HasBase, read_robot
from ._messages import CommandError, told, writing

if TYPE_CHECKING:
    from ..calibration import FixedFrame, Unknown


@dataclasses.dataclass(frozen=True)
class Calibrate(HasBase):
    """Finds a robot's offsets, lengths, tool, base or camera from measurements in a CSV file.

    Prints each number with its deviation, and what the measurements do not determine. Writes calibration.yaml,
    robot.urdf and residuals.png.
    """

    robot: str
    """A URDF or MJCF file, or a robot by name: nao, ur5, g1 and others, or one of robot_descriptions."""
    measurements: Path
    """CSV file: joints by name, and x,y,z or x,y,z,qw,qx,qy,qz or distance or height or u,v; a reading a line."""
    frame: str
    """The frame that was measured."""
    unknowns: tuple[str, ...]
    """QUANTITY[:NAMES[:AXES[:PRIOR]]], such as joint_offset, joint_offset:wrist_*, body_position:forearm_link:z or
    frame_position:tool0:xyz:0.01. Quantities: joint_offset, joint_axis, body_position, body_rotation, frame_position,
    frame_rotation, base_position, base_rotation."""
    sigma: float | None = None
    """Deviation of the readings [m or pixels]."""
    loss: Literal["squared", "huber", "cauchy", "geman_mcclure"] = "squared"
    """With outliers: geman_mcclure."""
    noise: Literal["given", "estimated"] = "given"
    """Source of the deviations: --sigma, or the residuals."""
    other: str | None = None
    """The other frame of distances, the plane of heights, the camera of pixels."""
    intrinsics: tuple[float, float, float, float] | None = None
    """fx fy cx cy of the camera [pixels]."""
    frames: Path | None = None
    """JSON, such as the frames of a calibration.yaml: {"camera": {"parent": "tool0", "position": [0, 0, 0.1]}}."""
    out: Path = Path("osik-calibration")
    """Folder for the files."""

    def run(self) -> int:
        """Run the command; return the exit code: 1 if the fit did not converge."""
        from .. import calibration

        robot = read_robot(self.robot, self.base)
        with told():
            measured = calibration.read_measurements(
                self.measurements, robot, self.frame, other=self.other, intrinsics=self.intrinsics, sigma=self.sigma
            )
            found = calibration.calibrate(
                robot,
                measured,
                [_unknown(text) for text in self.unknowns],
                frames=_frames(self.frames),
                loss=self.loss,
                noise=self.noise,
            )
        print(found.explain())
        with told(), writing(self.out):
            self.out.mkdir(parents=True, exist_ok=True)
            found.save(self.out / "calibration.yaml")
            found.robot.to_urdf(self.out / "robot.urdf")
            found.figure().savefig(self.out / "residuals.png")
        print(f"written: {self.out}/calibration.yaml, robot.urdf, residuals.png")
        return 0 if bool(found.converged) else 1


def _unknown(text: str) -> Unknown:
    """Return what an argument of ``--unknowns`` says."""
    from ..calibration import Unknown

    quantity, names, axes, prior, *more = (*text.split(":"), "", "", "")[: max(4, text.count(":") + 1)]
    try:
        if more:
            raise ValueError("it has more than four parts")
        return Unknown(quantity, names or "*", axes=axes or None, prior=float(prior) if prior else math.inf)
    except (KeyError, ValueError) as error:
        raise CommandError(f"--unknowns {text}: {error}") from None


def _frames(path: Path | None) -> dict[str, FixedFrame]:
    """Return the fixed frames of a JSON file."""
    from ..calibration import FixedFrame

    if path is None:
        return {}
    try:
        given = json.loads(path.read_text(encoding="utf-8"))
        return {name: FixedFrame(**frame) for name, frame in given.items()}
    except (TypeError, AttributeError, ValueError) as error:
        raise CommandError(f"--frames {path}: {error}; it is JSON such as {{'board': {{'parent': null}}}}") from None

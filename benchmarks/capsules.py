"""What links are taken for where collisions are avoided: capsules around their meshes.

The Unitree G1 of example-robot-data has meshes as collision shapes. Each capsule here is about the smallest one that
holds all vertices of a link's mesh, found by minimising its volume (Nelder and Mead, from the principal axes), rounded
outward to 1 mm; the torso's two halves have one each. Right links are mirrored left ones.
"""

from __future__ import annotations

from typing import NamedTuple

import osik_jax as osik


class Capsule(NamedTuple):
    """All within a radius of a segment; in metres, in the frame of a link."""

    link: str
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    def mirrored(self) -> Capsule:
        """On the right link, of one on the left one; or on the other half of the same link."""
        (ax, ay, az), (bx, by, bz) = self.start, self.end
        return Capsule(self.link.replace("left_", "right_"), (ax, -ay, az), (bx, -by, bz), self.radius)


_MIDDLE = {
    "pelvis": Capsule("pelvis", (-0.002, 0.0, -0.074), (0.0, 0.0, -0.06), 0.082),
    "head": Capsule("head_link", (-0.007, 0.0, 0.347), (0.007, 0.0, 0.456), 0.081),
}
_LEFT = {
    "chest": Capsule("torso_link", (0.002, 0.022, 0.063), (-0.003, 0.035, 0.233), 0.087),
    "hip": Capsule("left_hip_roll_link", (0.026, 0.0, -0.115), (0.039, -0.001, -0.01), 0.057),
    "thigh": Capsule("left_hip_yaw_link", (-0.072, -0.004, -0.177), (0.001, 0.0, -0.02), 0.061),
    "shin": Capsule("left_knee_link", (0.019, 0.0, -0.26), (0.01, 0.0, -0.004), 0.059),
    "foot": Capsule("left_ankle_roll_link", (-0.03, -0.001, -0.014), (0.103, 0.0, -0.021), 0.042),
    "shoulder": Capsule("left_shoulder_roll_link", (-0.004, 0.01, -0.065), (0.0, 0.001, 0.001), 0.05),
    "upper_arm": Capsule("left_shoulder_yaw_link", (0.0, -0.008, 0.015), (0.013, -0.004, -0.081), 0.045),
    "forearm": Capsule("left_elbow_link", (0.0, 0.011, -0.004), (0.08, 0.002, -0.013), 0.037),
    "wrist": Capsule("left_wrist_roll_link", (0.007, 0.0, 0.001), (0.045, -0.001, -0.001), 0.032),
    "palm": Capsule("left_wrist_pitch_link", (0.0, 0.0, 0.0), (0.046, 0.0, -0.001), 0.035),
    "hand": Capsule("left_rubber_hand", (0.087, -0.024, 0.005), (0.052, -0.009, 0.002), 0.059),
}
G1 = (
    _MIDDLE
    | {f"left_{name}": capsule for name, capsule in _LEFT.items()}
    | {f"right_{name}": capsule.mirrored() for name, capsule in _LEFT.items()}
)


def shapes(capsules: dict[str, Capsule]) -> dict[str, osik.CollisionShape]:
    """The capsules as shapes on the robot's links."""
    return {
        name: osik.CollisionShape.capsule(capsule.radius, capsule.start, capsule.end, frame=capsule.link)
        for name, capsule in capsules.items()
    }

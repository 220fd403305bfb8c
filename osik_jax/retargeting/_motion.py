"""Record of a person's motion, returned by every reader."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Bool, Float

from .._errors import OsikValueError, unknown_name
from ..numerics._rotations import ROUNDED
from ._rotations import continuous, slerp

CONTACT_POINTS = ("left_heel", "left_toe", "right_heel", "right_toe")
"""Columns of ``HumanMotion.contact``."""
LARGEST = 1e6
"""Largest accepted coordinate [m]."""
_FASTEST = 1e5
"""Largest accepted frame rate [1/s]."""
Touch = tuple[str, str, Bool[np.ndarray, " F"]]
"""Role of a joint, the object or the role of the joint that it holds, and in which frames. (F,)"""


@dataclasses.dataclass(frozen=True)
class HumanMotion:
    """A person's motion: joint positions at a constant rate, in a world whose z axis points up.

    Attributes:
        name: name of the clip, for display.
        fps: frame rate [1/s].
        joint_names: unique names of the joints.
        positions: joint positions in the world [m]. (F, J, 3)
        rotations: joint orientations in the world as quaternions w x y z, of length 1 within 2 % and then normalised;
            None: unknown. (F, J, 4)
        rest_positions: joint positions in the pose in which all rotations are the identity [m]; None: unknown. (J, 3)
        contact: whether left heel, left toe, right heel and right toe stand on the ground; without toes, the
            left hind, left front, right hind and right front paw of an animal; None: detected. (F, 4)
        ground: height of the floor [m]; None: detected.
        objects: pose of each object: position [m] and quaternion w x y z. (F, 7) each
        touches: joints that hold objects or each other; the robot keeps them together. Each has the role of the joint
            (such as ``left_wrist``), an object or the role of another joint, and in which frames it holds it (F,).

    Raises:
        ValueError: shapes that do not agree, numbers that are not finite or over 1e6 m, quaternions that are not of
            unit length, a name that occurs twice, or a rate that is not positive.
    """

    name: str
    fps: float
    joint_names: tuple[str, ...]
    positions: Float[np.ndarray, "F J 3"]
    rotations: Float[np.ndarray, "F J 4"] | None = None
    rest_positions: Float[np.ndarray, "J 3"] | None = None
    contact: Bool[np.ndarray, "F 4"] | None = None
    ground: float | None = None
    objects: Mapping[str, Float[np.ndarray, "F 7"]] = dataclasses.field(default_factory=dict)
    touches: tuple[Touch, ...] = ()

    def __post_init__(self) -> None:
        frames, joints = len(self.positions), len(self.joint_names)
        if not 0.0 < self.fps <= _FASTEST:
            raise OsikValueError(f"fps is {self.fps}; it is frames a second, more than 0 and {_FASTEST:g} at most")
        repeated = sorted({name for name in self.joint_names if self.joint_names.count(name) > 1})
        if repeated:
            raise OsikValueError(f"joint names occur twice: {', '.join(repeated)}")
        if frames < 1 or joints < 1:
            raise OsikValueError(f"a motion has a frame and a joint at least; this one has {frames} and {joints}")
        _check_array("positions", self.positions, (frames, joints, 3))
        _check_array("rest_positions", self.rest_positions, (joints, 3))
        _check_array("rotations", self.rotations, (frames, joints, 4))
        if self.contact is not None and np.shape(self.contact) != (frames, 4):
            raise OsikValueError(
                f"contact has shape {np.shape(self.contact)}, expected {(frames, 4)}: {CONTACT_POINTS}"
            )
        for name, poses in self.objects.items():
            _check_array(f"objects[{name!r}]", poses, (frames, 7))
            if np.abs(np.linalg.norm(poses[:, 3:], axis=-1) - 1.0).max() > ROUNDED:
                raise OsikValueError(f"the pose of {name} is its position and a unit quaternion w x y z")
        for role, _, held in self.touches:
            if held.shape != (frames,):
                raise OsikValueError(f"held of {role} has shape {held.shape}, expected {(frames,)}")
        if self.ground is not None and not abs(self.ground) <= LARGEST:
            raise OsikValueError(f"ground is {self.ground}; it is a height in metres")
        if self.rotations is not None:
            length = np.linalg.norm(self.rotations, axis=-1)
            if np.abs(length - 1.0).max() > ROUNDED:
                frame, joint = np.unravel_index(np.argmax(np.abs(length - 1.0)), length.shape)
                raise OsikValueError(
                    f"rotations are unit quaternions w x y z; that of {self.joint_names[joint]} in frame {frame} has "
                    f"length {length[frame, joint]:.4g}"
                )
            object.__setattr__(self, "rotations", np.asarray(self.rotations) / length[..., None])

    @property
    def frames(self) -> int:
        """Return the number of frames."""
        return len(self.positions)

    def track(self, name: str) -> Float[np.ndarray, "F 3"]:
        """Return the positions of one joint in the world [m]. (F, 3).

        Raises:
            KeyError: no such joint; the message lists those that exist.
        """
        if name not in self.joint_names:
            raise unknown_name("joint", name, self.joint_names)
        return self.positions[:, self.joint_names.index(name)]

    def resampled(self, fps: float) -> HumanMotion:
        """Return the motion at another rate: linear interpolation of positions, spherical interpolation of rotations.

        Contacts are those of the nearer frame. Lower rates are not low-pass filtered first.

        Raises:
            ValueError: a rate that is not positive.
        """
        if check_rate(fps) == self.fps or self.frames == 1:
            return dataclasses.replace(self, fps=float(fps))
        before, part = instants(self.frames, self.fps, fps)
        rotations, nearer = self.rotations, before + (part >= 0.5)
        if rotations is not None:
            share = np.broadcast_to(part[:, None], (len(part), rotations.shape[1]))
            rotations = continuous(slerp(rotations[before], rotations[before + 1], share))
        low, high = self.positions[before], self.positions[before + 1]
        objects = {}
        for name, poses in self.objects.items():
            at = poses[before, :3] + part[:, None] * (poses[before + 1, :3] - poses[before, :3])
            objects[name] = np.concatenate([at, slerp(poses[before, 3:], poses[before + 1, 3:], part)], -1)
        return dataclasses.replace(
            self,
            objects=objects,
            touches=tuple((role, other, held[nearer]) for role, other, held in self.touches),
            fps=float(fps),
            positions=low + part[:, None, None] * (high - low),
            rotations=rotations,
            contact=None if self.contact is None else self.contact[nearer],
        )


def check_rate(fps: float) -> float:
    """Return a frame rate [1/s], or raise ValueError if it is not positive and finite."""
    if not (np.isfinite(fps) and fps > 0.0):
        raise OsikValueError(f"fps is {fps}; it is frames a second, more than 0")
    return fps


def instants(frames: int, fps: float, wanted: float) -> tuple[np.ndarray, np.ndarray]:
    """Return, for each instant of another rate, the frame before it and its fraction of the way to the next frame."""
    # 1e-9 keeps the last frame where the rates divide evenly up to rounding
    at = np.arange(int(np.floor((frames - 1) / fps * wanted + 1e-9)) + 1) / wanted * fps
    before = np.minimum(at.astype(int), frames - 2)
    return before, np.clip(at - before, 0.0, 1.0)


def _check_array(name: str, value: np.ndarray | None, shape: tuple[int, ...]) -> None:
    """Raise ValueError if an array has another shape, or an entry that is not finite or above ``LARGEST``."""
    if value is None:
        return
    if np.shape(value) != shape:
        raise OsikValueError(f"{name} has shape {np.shape(value)}, expected {shape}")
    wrong = ~np.isfinite(value)
    if wrong.any():
        raise OsikValueError(f"{name} is not finite at {tuple(np.argwhere(wrong)[0].tolist())}")
    far = np.abs(value) > LARGEST
    if far.any():
        at = np.argwhere(far)[0]
        raise OsikValueError(f"{name} is {value[tuple(at)]:g} at {tuple(at.tolist())}; it is {LARGEST:g} m at most")

"""A robot with its base, and the frames that a measurement needs beside the robot's: cameras, markers, planes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float, Num

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..kinematics import Kinematics, forward_kinematics
from ..kinematics._rigid import compose_poses
from ..numerics._arguments import as_vector, check_finite
from ..numerics._rotations import exact_rotation
from ..robot import Robot

BASE = ""
"""Name of the robot's base in the measuring world, the first of a setup's fixed frames."""


class FixedFrame(eqx.Module):
    """A frame that is fixed to a frame of the robot or to the world: a camera, a marker, a plane.

    Attributes:
        parent: name of the robot's frame that carries it; None: the world in which is measured (static).
        position: its origin in the parent [m]. (3,)
        rotation: from its axes to the parent's. (3, 3)
    """

    parent: str | None = eqx.field(static=True)
    position: Float[Array, "3"]
    rotation: Float[Array, "3 3"]

    def __init__(
        self,
        parent: str | None = None,
        position: Num[ArrayLike, "3"] | Sequence[float] = (0.0, 0.0, 0.0),
        rotation: Num[ArrayLike, "3 3"] | None = None,
    ):
        """Place a frame, exactly or as a first guess of what is calibrated.

        Raises:
            ValueError: wrong shapes, not finite, no rotation.
        """
        self.parent = parent
        self.position = as_vector(jnp.asarray(position), (3,), "position", float)
        check_finite(self.position, "position")
        turn = as_vector(np.eye(3) if rotation is None else rotation, (3, 3), "rotation", float)
        self.rotation = jnp.asarray(exact_rotation(turn, "rotation"))


class Setup(eqx.Module):
    """A robot and fixed frames, the base first, as arrays that unknowns change."""

    robot: Robot
    names: tuple[str, ...] = eqx.field(static=True)  # of the fixed frames; the first is ``BASE``
    parents: tuple[str | None, ...] = eqx.field(static=True)  # the robot's frame that carries each, None for the world
    position: Float[Array, "m 3"]  # of each in its parent [m]
    rotation: Float[Array, "m 3 3"]  # from the axes of each to its parent's

    def check(self, name: str) -> None:
        """Raise KeyError unless a frame of the robot or a fixed frame has this name."""
        known = (*self.robot.frame_names, *self.names[1:])
        if name not in known:
            raise unknown_name("frame", name, known)

    def poses(self, q: Float[Array, " nq"], names: Sequence[str]) -> tuple[Float[Array, "k 3"], Float[Array, "k 3 3"]]:
        """Return the poses of several frames in the world in which is measured, at one configuration."""
        kinematics = forward_kinematics(self.robot, q)
        found = [self._pose(kinematics, name) for name in names]
        return jnp.stack([p for p, _ in found]), jnp.stack([r for _, r in found])

    def _pose(self, kinematics: Kinematics, name: str) -> tuple[Array, Array]:
        if name not in self.names:
            return compose_poses((self.position[0], self.rotation[0]), kinematics.frame_pose(self.robot, name))
        own = self.names.index(name)
        pose, parent = (self.position[own], self.rotation[own]), self.parents[own]
        return pose if parent is None else compose_poses(self._pose(kinematics, parent), pose)

    def frame(self, name: str) -> FixedFrame:
        """Return a fixed frame as it is here."""
        own = self.names.index(name)
        frame = FixedFrame(self.parents[own])
        pose = self.position[..., own, :], self.rotation[..., own, :, :]
        return eqx.tree_at(lambda f: (f.position, f.rotation), frame, pose)


def make_setup(robot: Robot, frames: Mapping[str, FixedFrame], base: FixedFrame | None) -> Setup:
    """Return a robot with fixed frames in its precision, checked."""
    for name, frame in {"base": base or FixedFrame(), **frames}.items():
        if not isinstance(frame, FixedFrame):
            raise OsikTypeError(f"frame {name!r} is a {type(frame).__name__}; it is a calibration.FixedFrame")
    for name, frame in frames.items():
        if name in robot.frame_names or not name:
            raise OsikValueError(
                f"a fixed frame is called {name!r}, as a frame of the robot is: give it a name of its own"
            )
        if frame.parent is not None and frame.parent not in robot.frame_names:
            raise unknown_name("frame", frame.parent, robot.frame_names)
    if base is not None and base.parent is not None:
        raise OsikValueError(f"the base has the parent {base.parent!r}; it stands in the world, parent=None")
    parts = [base or FixedFrame(), *frames.values()]
    dtype = robot.q0.dtype
    position, rotation = (
        jnp.stack([getattr(part, field).astype(dtype) for part in parts]) for field in ("position", "rotation")
    )
    return Setup(robot, (BASE, *frames), tuple(part.parent for part in parts), position, rotation)


def poses_at(setup: Setup, q: Float[Array, "n nq"], *names: str) -> tuple[tuple[Array, Array], ...]:
    """Return for each name the positions (n, 3) and rotations (n, 3, 3) at n configurations."""
    positions, rotations = jax.vmap(lambda one: setup.poses(one, names))(q)
    return tuple((positions[:, k], rotations[:, k]) for k in range(len(names)))

"""Obstacles of joint paths, and proofs that curves keep clear of them (``core/way_around.hpp``)."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Bool, Float

from ..collision import Scene, robot_shapes
from ..collision._clearance import checked_clearance
from ..collision._clearance import clearance as clearance_at
from ..collision._core import CoreRobot, CoreScene, are_free_curves, core_robot, core_scene, require_core
from ..collision._robot_shapes import Given
from ..collision._scene import check_scene
from ..collision._table import RobotShapes
from ..robot import Robot

_CURVES = jax.jit(are_free_curves)
_STATES = 2_000
"""Configurations that a proof of one curve tries at most."""


class Obstacles(NamedTuple):
    """A scene, the robot's shapes, and the distance that all pairs keep, as given and as the core has them.

    Attributes:
        given: arguments of ``inverse_kinematics``.
        shapes: of the robot.
        around: the scene's arrays.
        clearance: [m]. (1,)
    """

    given: dict[str, Any]
    shapes: RobotShapes
    around: CoreScene
    clearance: Float[np.ndarray, "1"]

    @classmethod
    def read(cls, robot: Robot, scene: Scene, clearance: Any, srdf: Given, what: str) -> Obstacles:
        """Check the arguments of function ``what``, and return them.

        Raises:
            OsikError: no compiled core, or no CPU.
            TypeError, ValueError: a scene that is no ``Scene``, a clearance that is negative.
        """
        require_core(what)
        check_scene(scene)
        least = checked_clearance(clearance)
        shapes = robot_shapes(robot, srdf)
        given = {"scene": scene, "clearance": clearance, "srdf": srdf}
        return cls(given, shapes, core_scene(scene, shapes), np.asarray(least, float))

    def for_core(
        self, robot: Robot, moving: np.ndarray, ranges: list[np.ndarray], states: int, key: int
    ) -> tuple[CoreRobot, np.ndarray, np.ndarray, CoreScene, np.ndarray]:
        """Return the arguments of the core after the configurations; see ``collision/_core.py: ways``."""
        own = core_robot(robot, self.shapes, entries=tuple(moving.tolist()))
        options = np.concatenate([[len(moving), states, key], moving]).astype(np.int32)
        return own, options, np.concatenate(ranges), self.around, self.clearance

    def are_clear(self, robot: Robot, curves: Float[np.ndarray, "K 4 n"]) -> Bool[np.ndarray, " K"]:
        """Return which cubic Bezier curves are proven free, by their control points; few numbers are compiled."""
        count, moving = len(curves), np.arange(robot.nq)
        more = 1 << (count - 1).bit_length()
        padded = np.concatenate([curves, np.repeat(curves[-1:], more - count, axis=0)])
        ranges = [curves.min(axis=(0, 1)), curves.max(axis=(0, 1)), np.ones(1)]
        return np.asarray(_CURVES(padded, *self.for_core(robot, moving, ranges, _STATES, 0)))[:count]

    def nearest(self, robot: Robot, q: Float[np.ndarray, " n"]) -> str:
        """Return the names of the nearest pair at a configuration, and their distance."""
        found = clearance_at(robot, q, self.given["scene"], srdf=self.given["srdf"])
        first, second = found.pair_names()
        return f"{first} and {second} are {1e3 * float(found.distance):.3g} mm apart"


def line_curves(path: Float[np.ndarray, "S n"]) -> Float[np.ndarray, "S_1 4 n"]:
    """Return the control points of the straight lines between neighbours."""
    shares = np.arange(4)[:, None] / 3.0
    return path[:-1, None] + shares * np.diff(path, axis=0)[:, None]


def spline_curves(knots: np.ndarray, coefficients: np.ndarray) -> Float[np.ndarray, "K 4 n"]:
    """Return the control points of the parts of a ``Spline``."""
    width = np.diff(knots)[:, None]
    a, b, c, d = (coefficients[:, power] * width**power for power in range(4))
    return np.stack([a, a + b / 3.0, a + (2.0 * b + c) / 3.0, a + b + c + d], axis=1)

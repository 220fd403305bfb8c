"""Result of a search for a base."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from ..collision import Scene
from ..inverse import InverseKinematicsSolution
from ..robot import Robot
from ._bases import base_poses, stands_free
from ._gradient import BaseGradient, base_gradient
from ._score import Task

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Placement:
    """The best base for a set of poses, and how well each base of the grid does.

    Attributes:
        robot: the robot.
        scene: the obstacles, in world axes, or None.
        clearance: smallest distance of all pairs of shapes [m].
        poses: positions of the poses, of all frames [m]. (m, 3)
        x: coordinates of the grid [m]. (nx,)
        y: likewise. (ny,)
        yaw: likewise [rad]. (nyaw,)
        height: likewise [m]. (nh,)
        base_clearance: signed distance from the scene to what stands with the base [m]. (nx, ny, nyaw, nh)
        blocked_by: by the nearest object and link, how many bases of the grid do not stand free; most first.
        reaches: whether each pose is reached; False for bases that do not stand free. All searches are made at the
            eighth of the bases with the most poses. The others have an eighth of them for each pose, and all of them
            for one pose after another until one is missed: so much is sure of each. (nx, ny, nyaw, nh, poses)
        too_far: number of poses that are out of reach even with all links in one line. Where it is above 0, the base
            does not reach all poses, whatever the search. (nx, ny, nyaw, nh)
        margin: smallest distance of a joint from its limits over its range, of all poses reached: 0.5 if all joints are
            in the middle; NaN if no pose is reached. Of the first configuration found, so a lower bound of the best.
            (nx, ny, nyaw, nh)
        manipulability: smallest index of Yoshikawa of the same configurations, likewise. (nx, ny, nyaw, nh)
        best: x [m], y [m], yaw [rad] and height [m] of the best base, which is improved off the grid. (4,)
        q: configuration with the largest margin that is found for each pose at the best base; NaN where none is.
            (poses, nq)
        best_margin: margin of each of these. (poses,)
        best_manipulability: index of each of these. (poses,)
        solution: the answers for all poses at the best base, in the base's axes: ``solution.explain(i)`` says what
            stops the robot at pose i.
        task: frames, poses and settings of the searches.
    """

    robot: Robot
    scene: Scene | None
    clearance: float
    poses: Float[np.ndarray, "m 3"]
    x: Float[np.ndarray, " nx"]
    y: Float[np.ndarray, " ny"]
    yaw: Float[np.ndarray, " nyaw"]
    height: Float[np.ndarray, " nh"]
    base_clearance: Float[np.ndarray, "nx ny nyaw nh"]
    blocked_by: dict[tuple[str, str], int]
    reaches: Bool[np.ndarray, "nx ny nyaw nh poses"]
    too_far: Int[np.ndarray, "nx ny nyaw nh"]
    margin: Float[np.ndarray, "nx ny nyaw nh"]
    manipulability: Float[np.ndarray, "nx ny nyaw nh"]
    best: Float[np.ndarray, "4"]
    q: Float[np.ndarray, "poses nq"]
    best_margin: Float[np.ndarray, " poses"]
    best_manipulability: Float[np.ndarray, " poses"]
    solution: InverseKinematicsSolution

    task: Task

    def __repr__(self) -> str:
        return f"Placement, {self._summary()}"

    @property
    def reached(self) -> Int[np.ndarray, "nx ny nyaw nh"]:
        """Return the number of poses reached by each base of the grid."""
        return self.reaches.sum(-1)

    @property
    def gradient(self) -> BaseGradient:
        """Return the derivatives of ``best_margin``, ``best_manipulability`` and ``q`` by the base's coordinates."""
        return base_gradient(self.task, self.best, self.q)

    @property
    def is_reached(self) -> Bool[np.ndarray, " poses"]:
        """Return whether the best base reaches each pose."""
        return np.asarray(np.isfinite(self.q).all(-1))

    @property
    def best_pose(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
        """Return the position [m] and rotation of the best base in world axes."""
        position, rotation = base_poses(self.best[None])
        return position[0], rotation[0]

    @property
    def stands_free(self) -> Bool[np.ndarray, "nx ny nyaw nh"]:
        """Return whether the base keeps the clearance to the scene at each base of the grid."""
        return np.asarray(stands_free(self.base_clearance, self.clearance))

    def explain(self) -> str:
        """Return the best base, how many bases of the grid do how well, and what stops the robot, in words."""
        count, found, lines = len(self.q), self.is_reached, [self._summary()]
        if found.any():
            lines.append(
                f"smallest margin of a joint {100.0 * np.nanmin(self.best_margin):.1f} % of its range, "
                f"smallest manipulability {np.nanmin(self.best_manipulability):.3g}"
            )
        full, free, seeds = int((self.reached == count).sum()), self.stands_free, self.task.settings["seeds"]
        far = int((free & (self.too_far > 0)).sum())
        pairs = [f"{name} and {link}: {number}" for (name, link), number in self.blocked_by.items()]
        why = f" ({', '.join(pairs[:3])}{', ...' if len(pairs) > 3 else ''})" if pairs else ""
        lines.append(
            f"of {free.size} bases of the grid {full} reach all poses, {int((~free).sum())} do not stand free{why}, "
            f"{far} have a pose out of reach even with all links in one line, "
            f"and {int(free.sum()) - far - full} miss one after {seeds} searches"
        )
        lines += [f"pose {k}: {self.solution.explain(int(k))}" for k in np.flatnonzero(~found)]
        return "\n".join(lines)

    def _summary(self) -> str:
        x, y, yaw, height = self.best
        where = f"best base: x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad, height {height:.3f} m"
        return f"{where}; {self.is_reached.sum()} of {len(self.q)} poses reached"

    def figure(self) -> Figure:
        """Return a matplotlib figure from above: poses reached by each base, the scene, the poses and the best base."""
        from ._picture import draw_placement  # matplotlib, an extra

        return draw_placement(self)


def compare_placements(found: Mapping[str, Placement]) -> str:
    """Return a table of placements by name: robots, tools or heights for the same poses.

    It has the poses that the best base reaches, their smallest margin and manipulability, and how many bases of the
    grid reach all poses.
    """
    head = ("", "best base reaches", "smallest margin", "smallest manipulability", "bases that reach all poses")
    rows: list[tuple[str, ...]] = [head]
    for name, one in found.items():
        reached, count = one.is_reached, len(one.q)
        scores = ["-", "-"]
        if reached.any():
            scores = [f"{100.0 * np.nanmin(one.best_margin):.1f} %", f"{np.nanmin(one.best_manipulability):.3g}"]
        full = int((one.reached == count).sum())
        rows.append((name, f"{reached.sum()} of {count}", *scores, f"{full} of {one.reached.size}"))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join("  ".join(map(str.ljust, row, widths)).rstrip() for row in rows)

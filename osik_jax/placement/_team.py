"""Several robots for one set of poses: bases that keep clear of one another, and which robot takes which pose."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Int

from .._errors import OsikTypeError, OsikValueError, unknown_name
from ..collision import Scene
from ..collision._robot_shapes import robot_shapes
from ..collision._scene import with_objects
from ..collision._table import ConvexShape, RobotShapes, table_shapes
from ..kinematics import forward_kinematics
from ..kinematics._rigid import compose_poses
from ._bases import base_poses, grid_bases, shape_clearances
from ._placement import Placement
from ._score import Task, score_bases

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_STARTS = 8
"""Bases of the first robot from which the choice of all bases starts."""


@dataclasses.dataclass(frozen=True, eq=False, repr=False)
class Team:
    """Bases of several robots for one set of poses, and which robot takes which pose.

    Attributes:
        names: of the robots.
        bases: x [m], y [m], yaw [rad] and height [m] of each. (robots, 4)
        robot: number of the robot that takes each pose, that with the largest margin; -1: none reaches it. (poses,)
        q: of each robot, its configuration for each pose, while the others stand at their homes; NaN where there is
            none. Each (poses, nq)
        margin: smallest distance of a joint from its limits over its range, of these. (robots, poses)
        members: the robots with their homes, poses and scenes.
    """

    names: tuple[str, ...]
    bases: Float[np.ndarray, "robots 4"]
    robot: Int[np.ndarray, " poses"]
    q: tuple[np.ndarray, ...]
    margin: Float[np.ndarray, "robots poses"]
    members: tuple[Member, ...]

    def __repr__(self) -> str:
        return f"Team, {self.explain()}"

    @property
    def is_reached(self) -> Bool[np.ndarray, " poses"]:
        """Return whether a robot reaches each pose."""
        return self.robot >= 0

    def distances(self, first: str, second: str) -> Float[np.ndarray, "poses poses"]:
        """Return the distance of two robots [m] while the first works at one pose and the second at another one.

        Row k is for pose k of the first robot, column l for pose l of the second; NaN where one of them does not reach
        its pose. Where shapes overlap the distance is negative. It tells which poses can be worked at once:
        ``team.distances("left", "right") >= 0.02``.

        Raises:
            KeyError: no such robot.
        """
        i, j = (self._number(name) for name in (first, second))
        rows, columns = (np.flatnonzero(np.isfinite(self.q[k]).all(1)) for k in (i, j))
        found, bases = np.full((len(self.robot),) * 2, np.nan), np.tile(self.bases[i], (len(rows), 1))
        for column in columns if len(rows) else ():
            other = self.members[j].shapes_at(self.bases[j], self.q[j][column])
            found[rows, column] = self.members[i].distances(bases, other, self.q[i][rows])
        return found

    def _number(self, name: str) -> int:
        if name not in self.names:
            raise unknown_name("robot", name, self.names)
        return self.names.index(name)

    def figure(self) -> Figure:
        """Return a matplotlib figure from above: the robots at home, the scene, and the poses that each takes."""
        from ._picture import draw_team  # matplotlib, an extra

        return draw_team(self)

    def explain(self) -> str:
        """Return where each robot stands, and how many poses it takes, in words."""
        lines = [f"{int(self.is_reached.sum())} of {len(self.robot)} poses reached"]
        for k, (name, (x, y, yaw, height)) in enumerate(zip(self.names, self.bases, strict=True)):
            lines.append(
                f"{name}: x {x:.3f} m, y {y:.3f} m, yaw {yaw:.3f} rad, height {height:.3f} m; reaches "
                f"{int(np.isfinite(self.margin[k]).sum())} poses, takes {int((self.robot == k).sum())}"
            )
        missed = np.flatnonzero(~self.is_reached).tolist()
        return "\n".join([*lines, *([f"reached by no robot: {missed}"] if missed else [])])


def place_robots(found: Mapping[str, Placement]) -> Team:
    """Return bases for several robots, so that each pose is reached by at least one of them.

    The robots take bases of the grids of their placements. In turn, each takes the base that adds most to the poses
    that the others reach, until nothing changes. All shapes of the robots at home (``q0`` of ``place_base``) keep the
    clearance of the placements. Then all poses are searched for anew at these bases, with the other robots at home as
    obstacles: one robot works while the others stand at home.

    Args:
        found: by name, the placement of each robot, for the same poses in the same order: only their number is checked,
            as robots may reach the same thing with other frames. One placement twice is two robots of a kind.

    Raises:
        TypeError: something else than placements by name.
        ValueError: fewer than two placements, ones without a scene, or with different numbers of poses.
    """
    if not isinstance(found, Mapping) or not all(isinstance(part, Placement) for part in found.values()):
        raise OsikTypeError(f"found is {repr(found)[:80]}; it is a dictionary, name of a robot to its Placement")
    parts = list(found.values())
    counts = {name: len(part.q) for name, part in found.items()}
    if len(parts) < 2 or len(set(counts.values())) > 1:
        raise OsikValueError(f"place_robots takes two placements or more, of the same poses; poses of each: {counts}")
    if any(part.scene is None for part in parts):
        raise OsikValueError(
            "a placement has no scene, so nothing collides: place each robot with scene=Scene() or more"
        )
    members = [Member.of(part) for part in parts]
    if not all(len(member.bases) for member in members):
        raise OsikValueError("a placement reaches no pose from any base: its robot has no place among the others")
    chosen = [list(zip(members, _chosen(members, start), strict=True)) for start in members[0].starts(members[1])]
    best = max(chosen, key=lambda stands: _covered(stands).sum())
    bases, numbers = np.stack([member.bases[at] for member, at in best]), [at for _, at in best]
    scores = [score_bases(_among(members, numbers, k), bases[k : k + 1], every=True) for k in range(len(members))]
    margin = np.concatenate([score.margin for score in scores])
    robot = np.where(np.isfinite(margin).any(0), np.nan_to_num(margin, nan=-1.0).argmax(0), -1)
    return Team(tuple(found), bases, robot, tuple(score.q[0] for score in scores), margin, tuple(members))


@dataclasses.dataclass(frozen=True)
class Member:
    """A robot that is placed among others."""

    task: Task  # its poses and scene
    home: Float[np.ndarray, " nq"]  # its configuration while others work
    bases: Float[np.ndarray, "n 4"]  # those of its grid that reach a pose
    reaches: Bool[np.ndarray, "n poses"]  # which poses they reach

    @classmethod
    def of(cls, found: Placement) -> Member:
        """Return the robot of a placement."""
        reaches, grid = found.reaches.reshape(-1, len(found.q)), grid_bases((found.x, found.y, found.yaw, found.height))
        some = reaches.any(1)
        return cls(found.task, np.asarray(found.task.search.home), grid[some], reaches[some])

    @property
    def shapes(self) -> RobotShapes:
        """Return the robot's shapes."""
        return robot_shapes(self.task.robot, self.task.settings["srdf"])

    def starts(self, other: Member) -> list[int]:
        """Return the numbers of the bases that reach most poses together with any one base of another robot."""
        own, more = (member.reaches.astype(np.int32) for member in (self, other))
        together = own.sum(1)[:, None] + more.sum(1) - own @ more.T
        return np.argsort(-together.max(1), kind="stable")[:_STARTS].tolist()

    def shapes_at(self, base: np.ndarray, q: np.ndarray) -> list[ConvexShape]:
        """Return the robot's shapes in a configuration (nq,) on a base (4,), in world axes."""
        shapes, placed = self.shapes, forward_kinematics(self.task.robot, q)
        position, rotation = base_poses(base[None])
        bodies = np.asarray(placed.body_position)[shapes.bodies], np.asarray(placed.body_rotation)[shapes.bodies]
        bodies = compose_poses((position, rotation), bodies)
        moved = zip(*compose_poses(bodies, (shapes.table.position, shapes.table.rotation)), strict=True)
        parts = zip(table_shapes(shapes.table), moved, strict=True)
        return [shape._replace(position=place, rotation=turn) for shape, (place, turn) in parts]

    def home_at(self, at: int) -> list[ConvexShape]:
        """Return the robot's shapes at home on one of its bases, in world axes."""
        return self.shapes_at(self.bases[at], self.home)

    def distances(self, bases: np.ndarray, others: Sequence[ConvexShape], q: np.ndarray) -> Float[np.ndarray, " n"]:
        """Return the distance [m] to some shapes on bases (n, 4), in configurations (n, nq) or one (nq,)."""
        alone = self.shapes._replace(pairs=np.zeros((0, 2), np.int32), world=np.ones(len(self.shapes.names), bool))
        return shape_clearances(self.task.robot, bases, Scene({"others": others}), alone, q)[0]


def _chosen(members: Sequence[Member], start: int) -> list[int]:
    """Return the number of each robot's base, from one of the first robot.

    Raises:
        ValueError: a robot stands nowhere clear of the others.
    """
    chosen: list[int] = [start, *[-1] * (len(members) - 1)]
    for k in [*range(1, len(members)), *range(len(members)), *range(len(members))]:
        own, others = members[k], [(members[j], at) for j, at in enumerate(chosen) if j != k and at >= 0]
        gain = (own.reaches & ~_covered(others)).sum(1)
        shapes = [shape for member, at in others for shape in member.home_at(at)]
        gain[~(own.distances(own.bases, shapes, own.home) >= own.task.settings["clearance"])] = -1
        if gain.max() < 0:
            raise OsikValueError(f"robot {k} stands nowhere clear of the others: give grids that are wider apart")
        if gain[chosen[k]] < gain.max() or chosen[k] < 0:
            chosen[k] = int(gain.argmax())
    return chosen


def _covered(stands: Sequence[tuple[Member, int]]) -> np.ndarray:
    """Return whether each pose is reached by a robot on its base."""
    return np.any([member.reaches[at] for member, at in stands], 0)


def _among(members: Sequence[Member], chosen: Sequence[int], k: int) -> Task:
    """Return the poses and the scene of a robot, with the others at home as obstacles."""
    task = members[k].task
    assert task.scene is not None
    others = {f"robot {j}": members[j].home_at(at) for j, at in enumerate(chosen) if j != k}
    return task._replace(scene=with_objects(task.scene, others))

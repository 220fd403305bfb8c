"""Continuous joint paths through poses: branches by dynamic programming, then the smoothest path on the poses."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import solveh_banded

from ..inverse import inverse_kinematics
from ..kinematics import forward_kinematics
from ..numerics._dense import full_precision
from ..robot import Robot
from ._obstacles import Obstacles, line_curves
from ._pose_path import Poses

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_SPINS = 12
_STATIONS = 24
_ROUNDS, _ITERATIONS = 12, 12
_POSE_WEIGHT, _RANGE_WEIGHT = 1e6, 1e3
_BEND_WEIGHT, _STEP_WEIGHT, _STAY_WEIGHT = 10.0, 1.0, 1e-4
"""Weights of squared errors: poses [m, rad], ranges of joints, second and first differences, the branch found [rad]."""
_JUMP = 0.5
"""Two neighbours that are farther apart are no continuous path [rad or m]."""

Free = Mapping[str, str]
"""Axis of each frame about which it may turn, by the frame's name."""


@partial(jax.jit, static_argnames=("names", "axes"))
@full_precision
def pose_errors(
    robot: Robot, q: Float[Array, "S n"], goals: Any, *, names: tuple[str, ...], axes: tuple[str | None, ...]
) -> tuple[Float[Array, "S m"], Float[Array, "S m n"]]:
    """Return the errors of all frames in world axes [m, rad] and their Jacobians, at each configuration."""

    def errors(q: Array, goals: Any) -> Array:
        kinematics = forward_kinematics(robot, q)
        rows = []
        for name, axis, (position, rotation) in zip(names, axes, goals, strict=True):
            at, turned = kinematics.frame_pose(robot, name)
            rows.append(at - position)
            if rotation is not None and axis is None:
                rows.append(jaxlie.SO3.from_matrix(turned @ rotation.T).log())
            elif rotation is not None:
                own = jnp.array(_AXES[str(axis)], q.dtype)
                rows.append(jnp.cross(rotation @ own, turned @ own))
        return jnp.concatenate(rows)

    return jax.vmap(lambda q, goal: (errors(q, goal), jax.jacfwd(errors)(q, goal)))(q, goals)


class PathSearch:
    """Search for a joint path through poses of frames.

    Args:
        robot: the robot; hinges and slides alone.
        free: free axes, by frame.
        lower, upper: ranges of the joints. (n,)
        q0: configuration to begin near, or None.
        key: of the searches.
        obstacles: what the path keeps clear of, or None.
    """

    def __init__(
        self,
        robot: Robot,
        free: Free,
        lower: np.ndarray,
        upper: np.ndarray,
        q0: Any,
        key: Any,
        obstacles: Obstacles | None = None,
    ):
        self.robot, self.free, self.lower, self.upper, self.q0, self.key = robot, free, lower, upper, q0, key
        self.obstacles, self.around = obstacles, {} if obstacles is None else obstacles.given

    def errors(self, q: np.ndarray, poses: Mapping[str, Poses]) -> tuple[np.ndarray, np.ndarray]:
        """Return the errors (S, m) and Jacobians (S, m, n) at configurations; few numbers of them are compiled."""
        count = 1 << (len(q) - 1).bit_length()
        padded = [[None if a is None else _padded(a, count) for a in one] for one in poses.values()]
        axes = tuple(self.free.get(name) for name in poses)
        given = self.robot, _padded(q, count), padded
        found = pose_errors(*given, names=tuple(poses), axes=axes)
        return np.asarray(found[0])[: len(q)], np.asarray(found[1])[: len(q)]

    def targets(self, poses: Mapping[str, Poses]) -> list[dict[str, Any]]:
        """Return poses as targets, once for each turn about free axes."""
        spinning = [name for name in poses if self.free.get(name) and poses[name].rotation is not None]
        spins = range(_SPINS if spinning else 1)
        return [{name: _spun(one, self.free.get(name), spin) for name, one in poses.items()} for spin in spins]

    def branches(self, poses: Mapping[str, Poses]) -> list[np.ndarray]:
        """Return all configurations found for each of some poses, (k, n) each."""
        found: list[list[np.ndarray]] = [[] for _ in next(iter(poses.values())).position]
        for targets in self.targets(poses):
            answer = inverse_kinematics(self.robot, targets, all=True, q0=self.q0, key=self.key, **self.around)
            for own, q, count in zip(found, *map(np.asarray, (answer.solutions, answer.count)), strict=True):
                own.append(q[:count])
        return [np.concatenate(own) for own in found]

    def path(self, poses: Mapping[str, Poses], along: np.ndarray) -> np.ndarray | None:
        """Return a continuous path (S, n) through poses at lengths ``along`` of the path, or None if none is found."""
        count = len(along)
        stations = np.unique(np.round(np.linspace(0, count - 1, min(count, _STATIONS))).astype(int))
        nodes = self.branches({name: one.part(stations) for name, one in poses.items()})  # pyright: ignore
        if min(map(len, nodes)) == 0:
            return None
        costs = [self._costs(a, b) for a, b in itertools.pairwise(nodes)]
        for _ in range(_ROUNDS):
            chosen, cost = _cheapest(self._starts(nodes[0]), costs)
            if not np.isfinite(cost):
                return None
            corners = np.stack([own[i] for own, i in zip(nodes, chosen, strict=True)])
            start = np.stack([np.interp(along, along[stations], row) for row in corners.T], axis=1)
            path = self.refined(start, poses)
            broken = self.broken(path, poses)
            if broken is None:
                return path
            edge = int(np.clip(np.searchsorted(stations, broken) - 1, 0, len(costs) - 1))
            costs[edge][chosen[edge], chosen[edge + 1]] = np.inf
        return None

    def _starts(self, first: np.ndarray) -> np.ndarray:
        """Return the cost of each branch of the first pose: how far it is from ``q0``."""
        return np.zeros(len(first)) if self.q0 is None else ((first - np.asarray(self.q0)) ** 2).sum(axis=1)

    def _costs(self, here: np.ndarray, there: np.ndarray) -> np.ndarray:
        """Return the costs of moves between branches: squared steps, and how near joints are to limits."""
        steps = ((here[:, None] - there) ** 2).sum(axis=-1)
        half = 0.5 * (self.upper - self.lower)
        scale = np.where(np.isfinite(half), half, np.inf)
        off = (there - np.where(np.isfinite(half), 0.5 * (self.upper + self.lower), 0.0)) / scale
        return steps + 0.01 * (off**8).sum(axis=-1)

    def refined(self, path: np.ndarray, poses: Mapping[str, Poses]) -> np.ndarray:
        """Return the smoothest path on the poses near a path, by Gauss-Newton steps of the whole path."""
        start = path
        for _ in range(_ITERATIONS):
            move = self._smoothing_move(path, start, poses)
            path = np.clip(path + move * min(1.0, 0.5 / np.abs(move).max()), self.lower, self.upper)
            if np.abs(move).max() < 1e-4:
                break
        for _ in range(4):
            error, jacobian = self.errors(path, poses)
            path = path - np.einsum("kij,kj->ki", np.linalg.pinv(jacobian, rcond=1e-6), error)
            path = np.clip(path, self.lower, self.upper)
        return path

    def _smoothing_move(self, path: np.ndarray, start: np.ndarray, poses: Mapping[str, Poses]) -> np.ndarray:
        """Return the step of the whole path that minimises errors and differences of neighbours."""
        error, jacobian = self.errors(path, poses)
        count, n = path.shape
        blocks = _POSE_WEIGHT * np.einsum("kmi,kmj->kij", jacobian, jacobian) + _STAY_WEIGHT * np.eye(n)
        margin = 0.02 * np.where(np.isfinite(self.upper - self.lower), self.upper - self.lower, 0.0)
        beyond = path - np.clip(path, self.lower + margin, self.upper - margin)
        blocks += _RANGE_WEIGHT * (beyond != 0.0)[:, :, None] * np.eye(n)
        right = _POSE_WEIGHT * np.einsum("kmi,km->ki", jacobian, error) + _RANGE_WEIGHT * beyond
        right += _STAY_WEIGHT * (path - start)
        band = np.zeros((2 * n + 1, count * n))
        for low in range(n):
            for row in range(low, n):
                band[row - low, low::n] = blocks[:, row, low]
        for order, weight in ((1, _STEP_WEIGHT), (2, _BEND_WEIGHT)):
            right += weight * _add_differences(band, path, order, weight)
        return solveh_banded(band, -right.ravel(), lower=True).reshape(count, n)

    def broken(self, path: np.ndarray, poses: Mapping[str, Poses]) -> int | None:
        """Return the number of the first pose where the path is off the poses, jumps or touches something, or None."""
        error = np.abs(self.errors(path, poses)[0]).max(axis=1)
        jumps = np.append(0.0, np.abs(np.diff(path, axis=0)).max(axis=1))
        wrong = (error > 1e-6) | (jumps > _JUMP)
        if self.obstacles is not None and not wrong.any():
            wrong[1:] = ~self.obstacles.are_clear(self.robot, line_curves(path))
        return int(wrong.argmax()) if wrong.any() else None


def _add_differences(band: np.ndarray, path: np.ndarray, order: int, weight: float) -> np.ndarray:
    """Add the Hessian of squared differences of neighbours to a band matrix; return their gradient without weight."""
    count, n = path.shape
    signs = np.diff(np.eye(order + 1), n=order, axis=0)[0]
    gradient = np.zeros_like(path)
    values = np.diff(path, n=order, axis=0)
    for i, own in enumerate(signs):
        gradient[i : count - order + i] += own * values
        for j in range(i, order + 1):
            band[(j - i) * n, i * n : (count - order + i) * n] += weight * own * signs[j]
    return gradient


def _padded(values: np.ndarray, count: int) -> np.ndarray:
    return np.concatenate([values, np.repeat(values[-1:], count - len(values), axis=0)])


def _spun(poses: Poses, axis: str | None, spin: int) -> Any:
    """Return poses as targets, turned about a free axis by a part of a whole turn."""
    if poses.rotation is None:
        return poses.position
    if axis is None:
        return poses.position, poses.rotation
    turn = jaxlie.SO3.exp(2.0 * np.pi * spin / _SPINS * jnp.array(_AXES[axis])).as_matrix()
    return poses.position, poses.rotation @ np.asarray(turn)


def _cheapest(start: np.ndarray, costs: list[np.ndarray]) -> tuple[list[int], float]:
    """Return the numbers of the branches with the least sum of costs, by dynamic programming."""
    total, came = start, []
    for cost in costs:
        sums = total[:, None] + cost
        came.append(sums.argmin(axis=0))
        total = sums.min(axis=0)
    chosen = [int(total.argmin())]
    for back in reversed(came):
        chosen.append(int(back[chosen[-1]]))
    return chosen[::-1], float(total.min())

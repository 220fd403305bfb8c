"""Frames and balance of a motion over time, from its configurations."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..kinematics import center_of_mass, forward_kinematics
from ..robot import Robot
from ..tasks._polygon import Polygon, hull
from ._motion import Motion


class Observed(NamedTuple):
    """Frames and balance of a motion at every configuration."""

    time: Float[np.ndarray, " T"]  # [s]
    drift: Float[np.ndarray, " T"]  # largest distance of a standing frame from its first place [m]; NaN if none stands
    turn: Float[np.ndarray, " T"]  # the same for the angle of frames that may not rotate [rad]
    com: Float[np.ndarray, "T 3"]  # centre of mass [m]; NaN without a polygon
    # of its ground projection to the nearest edge of the support polygon [m], positive inside; empty without a polygon
    com_inside: Float[np.ndarray, " T"]
    # vertices of the support polygon [m], counter-clockwise; empty without one
    support: list[Float[np.ndarray, "m 2"]]
    moved: dict[str, Float[np.ndarray, "T 3"]]  # displacement of each goal's frame from its first position [m]
    wanted: dict[str, Float[np.ndarray, "T 3"]]  # displacement of its path [m]

    def off_path(self, label: str) -> Float[np.ndarray, " T"]:
        """Return the distance of a goal's frame from its path [m]."""
        return np.linalg.norm(self.moved[label] - self.wanted[label], axis=-1)


def observe(motion: Motion, q: Float[np.ndarray, "T nq"], dt: float) -> Observed:
    """Compare configurations ``dt`` [s] apart with the references of a motion."""
    time, stances = dt * np.arange(len(q)), motion.stances
    frames = tuple(part.frame for part in (*stances, *motion.goals.values()))
    seen = _frames(motion.robot, jnp.asarray(q), frames=frames, balanced=motion.balanced)
    place, rotation, com = (np.asarray(part) for part in seen)
    moved = dict(zip(motion.goals, np.moveaxis(place - place[0], 1, 0)[len(stances) :], strict=True))
    paths = {label: np.asarray(jax.vmap(goal.path.at)(time)[0][0]) for label, goal in motion.goals.items()}
    standing = np.array([s.on_ground(time) for s in stances], bool).reshape(-1, len(q))
    flat = standing & np.array([s.flat for s in stances], bool)[:, None]
    off = np.linalg.norm(place - place[0], axis=-1)[:, : len(stances)].T
    # the chord between two rotations is 2 sqrt(2) sin(angle / 2)
    chord = np.linalg.norm(rotation - rotation[0], axis=(-2, -1))[:, : len(stances)].T
    turned = 2.0 * np.arcsin(np.minimum(chord / 8.0**0.5, 1.0))
    hulls = _hulls(motion, standing, place[0], rotation[0]) if motion.balanced else []
    inside = [np.min(edge - normals @ point) for point, (normals, edge, _) in zip(com[:, :2], hulls, strict=False)]
    return Observed(
        time=time,
        drift=np.fmax.reduce(np.where(standing, off, np.nan), initial=np.nan),
        turn=np.fmax.reduce(np.where(flat, turned, np.nan), initial=np.nan),
        com=com,
        com_inside=np.array(inside),
        support=[vertices for _, _, vertices in hulls],
        moved=moved,
        wanted={label: path - path[0] for label, path in paths.items()},
    )


@partial(jax.jit, static_argnames=("frames", "balanced"))
def _frames(
    robot: Robot, q: Float[Array, "T nq"], *, frames: tuple[str, ...], balanced: bool
) -> tuple[Float[Array, "T k 3"], Float[Array, "T k 3 3"], Float[Array, "T 3"]]:
    """Return places and rotations of frames, and the centre of mass of a robot that balances."""

    def one(q: Array) -> tuple[Array, Array, Array]:
        kinematics = forward_kinematics(robot, q)
        com = center_of_mass(robot, kinematics) if balanced else jnp.full(3, jnp.nan)
        return *kinematics.frame_poses(robot, frames), com

    return jax.lax.map(one, q, batch_size=16)


def _hulls(motion: Motion, standing: np.ndarray, place: np.ndarray, rotation: np.ndarray) -> list[Polygon]:
    """Return the hull of the corners on the ground at each time, at the feet's first poses. standing: (stances, T)."""
    corners = [p + s.corners @ R.T for s, p, R in zip(motion.stances, place, rotation, strict=False)]
    hulls: dict[tuple[bool, ...], Polygon] = {}
    for row in {tuple(row) for row in standing.T}:
        found = hull(np.concatenate([points[:, :2] for points, down in zip(corners, row, strict=True) if down]))
        assert found is not None  # support_polygon has refused corners that span no area
        hulls[row] = found
    return [hulls[tuple(row)] for row in standing.T]

"""Advice on rows to leave out, for arms with fewer joints than their frames have rows."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from ..robot import Robot
from ._chain import chain_kinematics, chain_layout, is_plain, jacobian, make_chain
from ._seeds import shift_of, unit_points

_SAMPLES = 32
"""Configurations at which sets of rows are compared."""
_RANGE = 2.0
"""Ends of the samples of a coordinate [rad or m]: which rows a chain moves does not depend on its limits."""
_SINGULAR = 1e-6


def advice(robot: Robot, rows: Mapping[str, tuple[bool, ...]]) -> tuple[str, ...]:
    """Return a sentence for each frame with more rows than joints, with the rows to leave out.

    Args:
        robot: the robot.
        rows: by the name of a frame, which of x, y, z, rotation about x, y, z are asked for.
    """
    plain = {name: own for name, own in rows.items() if is_plain(robot.tree, (name,))}
    ways = {name: _rank(robot, {name: own}) for name, own in plain.items()}
    short = [name for name, own in plain.items() if sum(own) > ways[name]]
    lines = [_line(robot, name, plain[name], ways[name]) for name in short]
    if not short and len(plain) > 1:
        asked, joints = sum(map(sum, plain.values())), len(chain_layout(robot.tree, tuple(plain)).dofs)
        rank = _rank(robot, plain)
        if asked > rank:
            lines.append(
                f"the frames ask for {asked} rows of {_moved_by(joints, rank)}, so most sets of poses have no "
                "solution: leave out a frame's orientation, by giving its position alone"
            )
    return tuple(lines)


def _moved_by(joints: int, rank: int) -> str:
    shown = f"{joints} joints" if joints > 1 else "1 joint"
    return shown if rank == joints else f"{shown} that move them {rank} ways"


def _rank(robot: Robot, rows: Mapping[str, tuple[bool, ...]]) -> int:
    """Return the number of independent rows at a configuration where it is largest."""
    if not any(map(any, rows.values())):
        return 0
    kept = np.concatenate([np.array(own) for own in rows.values()])
    matrices = [np.asarray(own)[:, kept] for own in _jacobians(robot, tuple(rows))]
    return max(int(np.linalg.matrix_rank(own, tol=_SINGULAR).max()) for own in matrices)


def _line(robot: Robot, frame: str, asked: tuple[bool, ...], ways: int) -> str:
    if not ways:
        return f"no joint moves {frame} along a row that it asks for, so no other target has a solution"
    kept, axes = _rows_to_keep(robot, frame, asked, ways)
    free, joints = sum(asked) - sum(kept), len(chain_layout(robot.tree, (frame,)).dofs)
    carried = f"{joints} joints carry it" if joints > 1 else "1 joint carries it"
    moved = carried if ways == joints else f"its {joints} joints move it {ways} ways"
    return (
        f"{frame} asks for {sum(asked)} rows and {moved}, so most poses have no solution: leave out {free} "
        f"{'rows' if free > 1 else 'row'}, such as FrameTask(robot, {frame!r}, target=..., rows={kept}, axes={axes!r})"
    )


def _rows_to_keep(robot: Robot, frame: str, asked: tuple[bool, ...], ways: int) -> tuple[tuple[bool, ...], str]:
    """Return the rows that the joints move best, as many as they move ways, and their axes.

    All position rows are kept if possible.
    """
    world, own = _jacobians(robot, (frame,))
    matrices = {"world": np.asarray(world), "frame": np.asarray(own)}
    sets = list(combinations(np.flatnonzero(asked).tolist(), ways))

    def worth(choice: tuple[tuple[int, ...], str]) -> tuple[bool, float]:
        rows, axes = choice
        least = float(np.median(np.linalg.svd(matrices[axes][:, list(rows)], compute_uv=False)[:, -1]))
        # sets that keep the whole position come first, then those that the joints move best
        return least > _SINGULAR and set(rows) >= set(range(min(3, ways))), least

    rows, axes = max(((rows, axes) for axes in matrices for rows in sets), key=worth)
    return tuple(at in rows for at in range(6)), axes


@partial(jax.jit, static_argnames="frames")
def _jacobians(
    robot: Robot, frames: tuple[str, ...]
) -> tuple[Float[Array, "samples rows n"], Float[Array, "samples rows n"]]:
    """Return Jacobians at sample configurations, in world and frame axes; lengths relative to the longest lever.

    Six rows for each frame.
    """
    layout = chain_layout(robot.tree, frames)
    chain = make_chain(robot, frames, layout)
    points = unit_points(shift_of(0, len(layout.dofs)), jnp.arange(_SAMPLES), robot.q0.dtype)
    x = _RANGE * (2.0 * points - 1.0)
    kinematics = chain_kinematics(chain, x.T)
    matrix = jnp.moveaxis(jacobian(chain, kinematics), -1, 0)
    # lengths in units of the longest lever make rows of position and orientation comparable
    longest = jnp.max(jnp.abs(matrix[:, :, :3]))
    # levers of a chain without length are rounding, which is not to look like motion
    size = jnp.where(longest > _SINGULAR, longest, 1.0)
    parts = matrix[:, :, :3] / size, matrix[:, :, 3:]
    turn = jnp.moveaxis(kinematics.rotation, -1, 0)
    world = jnp.concatenate(parts, 2)
    own = jnp.concatenate([jnp.einsum("lfij,lfik->lfjk", turn, part) for part in parts], 2)
    return world.reshape(len(world), -1, len(x[0])), own.reshape(len(own), -1, len(x[0]))

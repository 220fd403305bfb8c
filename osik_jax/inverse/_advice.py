"""Advice on rows to leave out, for arms with fewer joints than their frames have rows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from itertools import combinations

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..kinematics import forward_kinematics, frame_jacobian, integrate
from ..robot import Robot
from ..tasks import Task
from ..tasks._rows import rows_of
from ._chain import chain_kinematics, chain_layout, is_plain, jacobian, make_chain
from ._seeds import shift_of, unit_points

_SAMPLES = 32
"""Configurations at which sets of rows are compared."""
_RANGE = 2.0
"""Ends of the samples of a coordinate [rad or m]: which rows a chain moves does not depend on its limits."""
_SINGULAR = 1e-6
_NEARBY, _STEPS, _AWAY = 8, 8, 0.1
"""Configurations that keep the loops, Newton steps that close them, and the distance of their starts from the answer.
"""
_REGULAR = 1e-3
"""Singular values of the loops' rows below this, relative to the largest, take no part in a step that closes them."""

_Jacobians = Callable[[tuple[str, ...]], tuple[np.ndarray, np.ndarray]]
"""Jacobians of frames at some configurations, in world axes and in frame axes: (samples, rows, n) each."""


def advice(
    robot: Robot, rows: Mapping[str, tuple[bool, ...]], held: Mapping[str, Task], q: Float[np.ndarray, "answers nq"]
) -> tuple[str, ...]:
    """Return a sentence for each frame with more rows than ways to move, with the rows to leave out.

    Args:
        robot: the robot.
        rows: by the name of a frame, which of x, y, z, rotation about x, y, z are asked for.
        held: tasks that tie joints together, such as closed loops. Only motions that keep them count.
        q: answers that miss their targets.
    """
    plain = {name: own for name, own in rows.items() if is_plain(robot.tree, (name,))}
    jacobians: _Jacobians = partial(_jacobians, robot)
    if held and plain:
        near = _jacobians_within(robot, dict(held), q, tuple(plain))
        if not len(near[0]):
            return ()  # nothing is known of the frames where the held tasks cannot be met
        jacobians = partial(_of_frames, tuple(plain), near)
    within = f" under {', '.join(map(repr, held))}" if held else ""
    ways = {name: _rank(jacobians, {name: own}) for name, own in plain.items()}
    short = [name for name, own in plain.items() if sum(own) > ways[name]]
    lines = [_line(robot, jacobians, name, plain[name], ways[name], within) for name in short]
    if not short and len(plain) > 1:
        asked, joints = sum(map(sum, plain.values())), len(chain_layout(robot.tree, tuple(plain)).dofs)
        rank = _rank(jacobians, plain)
        if asked > rank:
            lines.append(
                f"the frames ask for {asked} rows of {_moved_by(joints, rank)}{within}, so most sets of poses have no "
                "solution: leave out a frame's orientation, by giving its position alone"
            )
    return tuple(lines)


def _moved_by(joints: int, rank: int) -> str:
    shown = _counted(joints, "joint")
    return shown if rank == joints else f"{shown} that move them {_counted(rank, 'way')}"


def _counted(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def _rank(jacobians: _Jacobians, rows: Mapping[str, tuple[bool, ...]]) -> int:
    """Return the number of independent rows at a configuration where it is largest."""
    if not any(map(any, rows.values())):
        return 0
    kept = np.concatenate([np.array(own) for own in rows.values()])
    matrices = [np.asarray(own)[:, kept] for own in jacobians(tuple(rows))]
    return max(int(np.linalg.matrix_rank(own, tol=_least(own)).max()) for own in matrices)


def _least(matrix: np.ndarray) -> float:
    """Return the least singular value that is not rounding."""
    return max(_SINGULAR, float(np.sqrt(np.finfo(matrix.dtype).eps)))


def _line(robot: Robot, jacobians: _Jacobians, frame: str, asked: tuple[bool, ...], ways: int, within: str) -> str:
    if not ways:
        return f"no joint moves {frame}{within} along a row that it asks for, so no other target has a solution"
    kept, axes = _rows_to_keep(jacobians, frame, asked, ways)
    free, joints = sum(asked) - sum(kept), len(chain_layout(robot.tree, (frame,)).dofs)
    carried = f"{joints} joints carry it" if joints > 1 else "1 joint carries it"
    several = f"its {joints} joints move" if joints > 1 else "its joint moves"
    moved = carried if ways == joints and not within else f"{several} it {_counted(ways, 'way')}{within}"
    return (
        f"{frame} asks for {sum(asked)} rows and {moved}, so most poses have no solution: leave out "
        f"{_counted(free, 'row')}, such as FrameTask(robot, {frame!r}, target=..., rows={kept}, axes={axes!r})"
    )


def _rows_to_keep(
    jacobians: _Jacobians, frame: str, asked: tuple[bool, ...], ways: int
) -> tuple[tuple[bool, ...], str]:
    """Return the rows that the joints move best, as many as they move ways, and their axes.

    All position rows are kept if possible.
    """
    world, own = jacobians((frame,))
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
    return _in_both_axes(matrix, jnp.moveaxis(kinematics.rotation, -1, 0))


def _in_both_axes(
    matrix: Float[Array, "samples frames 6 n"], turn: Float[Array, "samples frames 3 3"]
) -> tuple[Float[Array, "samples rows n"], Float[Array, "samples rows n"]]:
    """Return Jacobians in world and frame axes, lengths relative to the longest lever."""
    # lengths in units of the longest lever make rows of position and orientation comparable
    longest = jnp.max(jnp.abs(matrix[:, :, :3]))
    # levers of a chain without length are rounding, which is not to look like motion
    size = jnp.where(longest > _SINGULAR, longest, 1.0)
    parts = matrix[:, :, :3] / size, matrix[:, :, 3:]
    world = jnp.concatenate(parts, 2)
    own = jnp.concatenate([jnp.einsum("lfij,lfik->lfjk", turn, part) for part in parts], 2)
    shape = len(matrix), -1, matrix.shape[-1]
    return world.reshape(shape), own.reshape(shape)


def _of_frames(
    every: tuple[str, ...], matrices: tuple[np.ndarray, np.ndarray], frames: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return the six rows of each of some frames."""
    kept = np.concatenate([np.arange(6) + 6 * every.index(name) for name in frames])
    world, own = (matrix[:, kept] for matrix in matrices)
    return world, own


def _jacobians_within(
    robot: Robot, held: dict[str, Task], q: Float[np.ndarray, "answers nq"], frames: tuple[str, ...]
) -> tuple[np.ndarray, np.ndarray]:
    """Return Jacobians of motions that keep the held tasks, near the answers, as ``_jacobians`` does.

    Configurations where the tasks are not met, or are singular, are left out.
    """
    *matrices, gap, rank = jax.device_get(_held(robot, held, np.resize(q, (_NEARBY, robot.nq)), frames=frames))
    closed = gap <= np.sqrt(np.finfo(gap.dtype).eps)
    kept = closed & (rank == rank[closed].max(initial=0))
    world, own = (matrix[kept] for matrix in matrices)
    return world, own


@partial(jax.jit, static_argnames="frames")
def _held(
    robot: Robot, held: dict[str, Task], q: Float[Array, "samples nq"], *, frames: tuple[str, ...]
) -> tuple[Array, Array, Float[Array, " samples"], Int[Array, " samples"]]:
    """Return Jacobians of the frames at configurations near q, the held tasks' errors there, and their rows' rank.

    The Jacobians' rows are projected into the null space of the held tasks' rows: their rank is then the number of
    ways in which the joints move the frames.
    """
    least = float(np.sqrt(jnp.finfo(q.dtype).eps))

    def rows(q: Array) -> tuple[Array, Array]:
        found = rows_of(robot, forward_kinematics(robot, q), q, {name: task.during(1.0) for name, task in held.items()})
        used = [own.weight > 0.0 for own in found.values()]
        errors = [jnp.where(use, own.pull, 0.0) for use, own in zip(used, found.values(), strict=True)]
        parts = [jnp.where(use[:, None], own.jacobian, 0.0) for use, own in zip(used, found.values(), strict=True)]
        return jnp.concatenate(errors), jnp.concatenate(parts)

    def one(q: Array, away: Array) -> tuple[Array, ...]:
        def closer(at: Array, q: Array) -> Array:
            error, matrix = rows(q)
            inverse = jnp.linalg.pinv(matrix, rtol=_REGULAR)
            aside = away - inverse @ (matrix @ away)
            return integrate(robot, q, jnp.where(at == 0, aside, 0.0) - inverse @ error)

        q = jax.lax.fori_loop(0, _STEPS, closer, q)
        error, matrix = rows(q)
        free = jnp.eye(robot.nv, dtype=q.dtype) - jnp.linalg.pinv(matrix, rtol=least) @ matrix
        kinematics = forward_kinematics(robot, q)
        turns = jnp.stack([kinematics.frame_pose(robot, name)[1] for name in frames])
        moved = frame_jacobian(robot, kinematics, frames) @ free
        return moved, turns, jnp.max(jnp.abs(error)), jnp.linalg.matrix_rank(matrix, rtol=least)

    aside = unit_points(shift_of(0, robot.nv), jnp.arange(len(q)), q.dtype)
    moved, turns, gap, rank = jax.vmap(one)(q, _AWAY * (2.0 * aside - 1.0))
    return *_in_both_axes(moved, turns), gap, rank

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
    counts = {name: len(chain_layout(robot.tree, (name,)).dofs) for name in plain}
    short = [name for name, own in plain.items() if sum(own) > counts[name]]
    lines = [_line(robot, name, plain[name], counts[name]) for name in short]
    if not short and len(plain) > 1:
        asked, joints = sum(map(sum, plain.values())), len(chain_layout(robot.tree, tuple(plain)).dofs)
        if asked > joints:
            lines.append(
                f"the frames ask for {asked} rows of {joints} joints, so most sets of poses have no solution: "
                "leave out a frame's orientation, by giving its position alone"
            )
    return tuple(lines)


def _line(robot: Robot, frame: str, asked: tuple[bool, ...], joints: int) -> str:
    kept, axes = _rows_to_keep(robot, frame, asked, joints)
    free = sum(asked) - sum(kept)
    carried = f"{joints} joints carry" if joints > 1 else "1 joint carries"
    return (
        f"{frame} asks for {sum(asked)} rows and {carried} it, so most poses have no solution: leave out {free} "
        f"{'rows' if free > 1 else 'row'}, such as FrameTask(robot, {frame!r}, target=..., rows={kept}, axes={axes!r})"
    )


def _rows_to_keep(robot: Robot, frame: str, asked: tuple[bool, ...], joints: int) -> tuple[tuple[bool, ...], str]:
    """Return the rows that the joints move best, and their axes; all position rows are kept if possible."""
    matrices = {axes: np.asarray(own) for axes, own in zip(("world", "frame"), _jacobians(robot, frame), strict=True)}
    sets = list(combinations(np.flatnonzero(asked).tolist(), joints))

    def worth(choice: tuple[tuple[int, ...], str]) -> tuple[bool, float]:
        rows, axes = choice
        least = float(np.median(np.linalg.svd(matrices[axes][:, list(rows)], compute_uv=False)[:, -1]))
        # sets that keep the whole position come first, then those that the joints move best
        return least > _SINGULAR and set(rows) >= set(range(min(3, joints))), least

    rows, axes = max(((rows, axes) for axes in matrices for rows in sets), key=worth)
    return tuple(at in rows for at in range(6)), axes


@partial(jax.jit, static_argnames="frame")
def _jacobians(robot: Robot, frame: str) -> tuple[Float[Array, "samples 6 n"], Float[Array, "samples 6 n"]]:
    """Return Jacobians at sample configurations, in world and frame axes; lengths relative to the longest lever."""
    layout = chain_layout(robot.tree, (frame,))
    chain = make_chain(robot, (frame,), layout)
    points = unit_points(shift_of(0, len(layout.dofs)), jnp.arange(_SAMPLES), robot.q0.dtype)
    x = _RANGE * (2.0 * points - 1.0)
    kinematics = chain_kinematics(chain, x.T)
    matrix = jnp.moveaxis(jacobian(chain, kinematics)[0], -1, 0)
    # lengths in units of the longest lever make rows of position and orientation comparable
    longest = jnp.max(jnp.abs(matrix[:, :3]))
    # levers of a chain without length are rounding, which is not to look like motion
    size = jnp.where(longest > _SINGULAR, longest, 1.0)
    world = jnp.concatenate([matrix[:, :3] / size, matrix[:, 3:]], 1)
    turn = jnp.moveaxis(kinematics.rotation[0], -1, 0)
    own = jnp.concatenate([jnp.einsum("lij,lik->ljk", turn, part) for part in (world[:, :3], world[:, 3:])], 1)
    return world, own

"""Plans computed on a CPU by the compiled core (``core/clip_plan.hpp``) through XLA's FFI.

The result is that of ``_plan.py``, which is the definition, in double precision.
"""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from ..execution._computed import side_by_side
from ..kinematics._kernels import Call, dof_columns
from ..kinematics._manifold import layout
from ..numerics._dense import product
from ..robot._joint_selection import scalar_layout
from ._balance import mass_fractions
from ._goals import Goals, Weights
from ._terms import CLEARANCE, PAIRS, SHORTEST, SWINGING, Body, Bounds


def descended(
    call: Call,
    clip: tuple[Body, Goals, Weights, Bounds, Float[Array, "_ F"]],
    q: Float[Array, "_ F nq"],
    rules: tuple[float, ...],
    damping: Float[Array, " _"],
    most: Int[Array, " _"],
    endings: tuple[float, float],
) -> tuple[Array, Array, Array]:
    """Return configurations, costs and iteration counts of a batch of clips.

    ``clip`` ends with 1 for each frame that may move, and 0 for past frames. ``rules`` are the constants of the method
    in the order of ``_plan.py``. ``endings`` says whether it ends when bounds are ready to get stiffer, and when steps
    gain little (0 or 1 each).
    """
    (body, goals, weights, bounds, free), (frames, nq) = clip, q.shape[1:]
    integers = _structure(body)
    wishes = goals.directions, goals.pelvis, goals.torso, goals.root, goals.feet, goals.contact
    wishes += goals.held, goals.present
    method = side_by_side(np.array([rules]), damping, most.astype(q.dtype), np.array([endings]))
    given = [q, *wishes, free, _numbers(body, weights, bounds), method]
    lanes = max(len(a) for a in given)
    found, cost, count = call(
        "clip_plan",
        [((lanes, frames, nq), float), ((lanes, 2), float), ((lanes,), float)],
        *(jnp.reshape(a, (len(a), -1)) for a in given),
        integers,
    )
    return found, cost, count.astype(most.dtype)


def _structure(body: Body) -> np.ndarray:
    """Return the integer arrays of ``ClipRobot`` in ``core/clip_frames.hpp``."""
    tree = body.robot.tree
    places = np.array([tree.frame_bodies[tree.frame(name)] for name in body.frames])
    columns, _ = dof_columns(tree)
    scalar, index = scalar_layout(body.robot)
    scalar_q, scalar_v, quaternions = layout(body.robot.tree)
    counts = dict(
        bodies=len(tree.body_parents),
        joints=len(tree.joint_types),
        values=len(tree.qpos_source[0]),
        full=len(columns),
        keys=len(body.keys),
        capsules=body.radii.shape[-1],
        above=len(body.above),
        pairs=len(body.pairs),
        turned=sum(1 << i for i in body.turned),
        most_pairs=min(PAIRS, len(body.pairs)),
        root=tree.root,
        places=len(places),
        straight=int(np.array_equal(columns, np.arange(tree.nv))),
        limbs=len(body.limbs),
        reaches=body.lengths.shape[-1],
        roots=len(body.roots),
        corners=body.corners,
        scalars=len(scalar_q),
        turns=len(quaternions),
        dofs=tree.nv,
    )
    parts = [list(counts.values()), tree.body_parents, tree.joint_types, tree.joint_bodies, tree.qpos_source[0]]
    parts += [columns, places, np.where(scalar, index, -1), body.limbs, body.roots]
    parts += [body.above, body.pairs, tree.moves]
    parts += [scalar_q, scalar_v, np.array(quaternions).T]
    return np.concatenate([np.asarray(part, np.int32).ravel() for part in parts])


def _numbers(body: Body, weights: Weights, bounds: Bounds) -> Float[Array, "_ k"]:
    """Return the float arrays of ``ClipRobot``: robot, profile and weights; the stiffness entry is 0. (_, k)."""
    none, fixed = np.zeros(1), (0.0, CLEARANCE, SWINGING, SHORTEST, 1.0 - body.rolls)
    balance = (none, none) if body.inside is None else (weights.balance, body.inside)
    robot, ids = body.robot, np.array([body.robot.tree.frame(name) for name in body.frames])
    turned, rotations, w = ids[len(body.keys) : len(body.keys) + 4], robot.frame_rotation, weights
    points = robot.frame_position[:, ids] + product(rotations[:, ids], body.offsets[..., None])[..., 0]
    return side_by_side(
        robot.tree.qpos_source[1][None], robot.qpos_offset, robot.joint_reference, robot.body_position,
        robot.body_quaternion, robot.joint_position, robot.joint_axis, dof_columns(robot.tree)[1][None], points,
        rotations[:, turned], body.home, body.lengths, body.rises, body.radii, bounds.lower, bounds.upper,
        robot.q0[:, scalar_layout(robot)[1]], bounds.step, bounds.change, mass_fractions(robot),
        robot.body_com, w.limb, w.pelvis, w.torso, w.root, w.foot,
        w.posture, w.stance, w.apart, w.limit, w.margin, np.array([fixed]), w.smooth, w.smooth_base, w.speed, *balance,
    )  # fmt: skip

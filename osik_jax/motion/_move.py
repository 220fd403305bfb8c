"""Least time from one state of the joints to another, by Ruckig."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from .._errors import OsikTypeError, OsikValueError, missing_extra
from ..inverse._inverse_kinematics import joint_box
from ..numerics._arguments import as_floats, concrete
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names
from ._motion import Motion, at_rest_outside, one_axis, sample_times
from ._retime import Limit, checked_limits
from ._start import State, checked_state, rounding

_SHARES = 0.0, 1e-9, 1e-8, 1e-7
"""Shares by which limits are lowered in turn: at the border between two kinds of profiles Ruckig may find none."""


class Move(eqx.Module):
    """Motion from one state of the joints to another: pieces of constant jerk.

    Attributes:
        duration: of the motion [s], the same for all joints.
        starts: times at which the pieces of each joint begin [s]; pieces may have no length. (K, n)
        states: positions, velocities, accelerations and jerks at the start of each piece. (K, 4, n)
        joints: names of the joints (static).
    """

    duration: Float[Array, ""]
    starts: Float[Array, "K n"]
    states: Float[Array, "K 4 n"]
    joints: tuple[str, ...] = eqx.field(default=(), static=True)

    def at(self, time: Float[ArrayLike, " T"]) -> Float[Array, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s]; at rest outside of the motion."""
        return _at(self, as_floats(one_axis(time)))

    def state(self, time: Float[ArrayLike, ""]) -> tuple[Array, Array, Array]:
        """Return position, velocity and acceleration at one time: the ``start`` of a move that goes on there."""
        q, v, a, _ = self.at(jnp.asarray(time)[None])[:, 0]
        return q, v, a

    def sample(self, dt: float) -> Motion:
        """Return the motion at times ``dt`` apart [s], the last of which is the end or just after it (outside jit)."""
        time = sample_times(float(self.duration), dt)
        q, v, a, _ = self.at(time)
        return Motion(jnp.asarray(time), q, v, a, joints=self.joints)


@jax.jit
def _at(move: Move, time: Float[Array, " T"]) -> Float[Array, "4 T n"]:
    held = jnp.clip(time, 0.0, move.duration)[:, None]
    piece = (move.starts <= held[:, None]).sum(axis=1) - 1
    q, v, a, j = jnp.moveaxis(jnp.take_along_axis(move.states, piece[:, None], axis=0), 1, 0)
    x = held - jnp.take_along_axis(move.starts, piece, axis=0)
    states = jnp.stack([q + x * (v + x * (a / 2.0 + x * j / 6.0)), v + x * (a + x * j / 2.0), a + x * j, j])
    return at_rest_outside(states, time, 0.0, move.duration)


def move(
    robot: Robot,
    start: Float[ArrayLike, " n"] | State,
    goal: Float[ArrayLike, " n"] | tuple[Float[ArrayLike, " n"], Float[ArrayLike, " n"]],
    *,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
) -> Move:
    """Return the least-time motion from one state to another within limits, by Ruckig (outside jit).

    Joints move independently and arrive together; obstacles and the way of the tool are not looked at. Positions are
    numbers: a joint without ends goes from one to the other as they are, so whole turns between them are turned. Mimic
    joints follow their leaders, whose limits count. It needs the extra ``planning``.

    Args:
        robot: the robot; hinges and slides alone.
        start: positions at rest [rad or m]; or positions, velocities and accelerations, such as ``running.state(now)``
            of a move or a chunk. (n,) each
        goal: positions at rest; or positions and velocities, with which the motion ends. (n,) each
        velocity: limits of the joints' speeds, as in ``retime``. Default: the robot's.
        acceleration: limits of accelerations, likewise. They have to exist. Default: the robot's.
        jerk: limits of jerks, likewise. Default: none; accelerations then jump.

    Returns:
        The motion: ``at(time)``, ``state(time)``, ``sample(dt)``. Its duration is Ruckig's.

    Raises:
        KeyError: no such joint.
        TypeError: a call in ``jit``, ``vmap`` or ``grad``.
        ValueError: a start or a goal outside its limits; limits that are not positive; joints that cannot stop before
            the end of their ranges.
        ModuleNotFoundError: the extra ``planning`` is missing.
    """
    check_scalar_joints(robot, "a move")
    limits = checked_limits(robot, velocity, acceleration, jerk)
    rest = np.zeros(robot.nv)
    first = checked_state(robot, start if _is_state(start) else (start, rest, rest), limits)
    last = checked_state(robot, goal if _is_state(goal) else (goal, rest), limits, "goal", kinds=2)
    numbers = [seen for one in (first, last, limits) if (seen := concrete(one)) is not None]
    if len(numbers) < 3:
        raise OsikTypeError("move cannot be traced, since Ruckig is no JAX: call it outside of jit, vmap and grad")
    found = _trajectory(*numbers)
    starts, states = _pieces(found)
    _check_ranges(robot, starts, states, found.duration)
    return Move(
        *(jnp.asarray(a, first.dtype) for a in (found.duration, starts, states)), joints=tuple(dof_names(robot))
    )


def _is_state(given: Any) -> bool:
    return isinstance(given, tuple | list) and len(given) > 0 and np.ndim(given[0]) > 0


def _trajectory(start: np.ndarray, goal: np.ndarray, limits: np.ndarray) -> Any:
    """Return Ruckig's trajectory."""
    try:
        import ruckig  # pyright: ignore[reportMissingImports]
    except ModuleNotFoundError as error:
        raise missing_extra("a move", "ruckig", "planning") from error
    given = ruckig.InputParameter(start.shape[1])
    given.current_position, given.current_velocity, given.current_acceleration = start.astype(float).tolist()
    given.target_position, given.target_velocity = goal.astype(float).tolist()
    # a state beyond a limit by rounding would be refused
    least = np.abs([goal[1], start[2], 0.0 * start[2]])
    failed = None
    for share in _SHARES:
        used = np.maximum(limits * (1.0 - share * np.array([[1.0], [2.0], [3.0]])), least).astype(float)
        given.max_velocity, given.max_acceleration, given.max_jerk = used.tolist()
        found = ruckig.Trajectory(start.shape[1])
        try:
            ruckig.Ruckig(start.shape[1]).calculate(given, found)
            return found
        except ruckig.RuckigError as error:
            failed = error
    raise OsikValueError(f"Ruckig finds no motion: {' '.join(str(failed).split())}") from failed


def _pieces(found: Any) -> tuple[Float[np.ndarray, "K n"], Float[np.ndarray, "K 4 n"]]:
    """Return when the pieces of each joint begin, and the states there; joints with fewer pieces end with inf."""
    most = max(sum(len(one.t) for one in (p.brake, p, p.accel)) for p in found.profiles[0])
    starts = np.full((most, len(found.profiles[0])), np.inf)
    states = np.zeros((most, 4, len(found.profiles[0])))
    for joint, profile in enumerate(found.profiles[0]):
        parts = profile.brake, profile, profile.accel
        times = np.concatenate([one.t for one in parts])
        pieces = np.concatenate([np.array([getattr(one, k)[: len(one.t)] for k in "pvaj"]) for one in parts], axis=1)
        kept = np.flatnonzero(times > 0.0) if times.any() else np.array([len(profile.brake.t)])
        starts[: len(kept), joint] = np.append(0.0, np.cumsum(times[kept]))[:-1]
        states[: len(kept), :, joint] = pieces[:, kept].T
    return starts, states


def _check_ranges(robot: Robot, starts: np.ndarray, states: np.ndarray, duration: float) -> None:
    """Raise if a joint leaves its range: at the start of a piece, or where its velocity changes its sign."""
    length = np.clip(np.append(starts[1:], np.full((1, starts.shape[1]), np.inf), axis=0), 0.0, duration) - starts
    q, v, a, j = states.swapaxes(0, 1)
    root = np.sqrt(np.maximum(a**2 - 2.0 * j * v, 0.0))
    with np.errstate(divide="ignore", invalid="ignore"):
        turns = [2.0 * v / (-a - root), 2.0 * v / (-a + root)]
    turns = [np.where((x > 0.0) & (x < length), x, 0.0) for x in turns]
    reached = np.stack([q + x * (v + x * (a / 2.0 + x * j / 6.0)) for x in (0.0 * q, *turns)])
    for joint, (name, low, high) in enumerate(
        zip(dof_names(robot), *map(np.asarray, joint_box(robot, None)), strict=True)
    ):
        own = reached[:, np.isfinite(starts[:, joint]), joint]
        past = max(low - own.min(), own.max() - high)
        if past > rounding(robot.q0)[0]:
            raise OsikValueError(
                f"{name!r} passes the end of its range by {past:.3g}: start or end slower, or give wider limits of "
                "acceleration and jerk"
            )

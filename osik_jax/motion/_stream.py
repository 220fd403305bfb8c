"""Streams of chunks: one motion out of the chunks that a policy or an operator gives while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float

from .._errors import OsikValueError
from ..control._checks import checked_start
from ..numerics._arguments import as_floats, check_count, concrete
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names
from ._chunk import FEWEST, Chunk, as_smoothing, chunk
from ._motion import one_axis
from ._retime import Limit, checked_limits


class Stream(eqx.Module):
    """One motion out of chunks that arrive while it runs, within limits, without a step where they join.

    A chunk that is pushed at the time ``now`` takes over at ``now + latency``; until then the running one goes on.
    The latency is the whole one: choose it longer than a call of ``push`` takes. A chunk is not taken if it is not
    feasible, if it is late (all its waypoints are before it takes over), or if the last one has not taken over yet.
    Then the running motion goes on, and comes to rest by itself.

    A pure pytree: ``push`` returns another stream, in ``jit`` and ``vmap`` too.

    Args:
        robot: the robot; hinges and slides alone.
        q: configuration at rest in which the stream begins. (n,)
        latency: time from a push until the chunk takes over [s], positive.
        waypoints: number of waypoints of a chunk (static).
        velocity: limits of the joints' speeds, as in ``retime``. Default: the robot's.
        acceleration: limits of accelerations, likewise. Default: the robot's.
        jerk: limits of jerks, likewise. Default: none.
        smoothing: as of ``chunk``.

    Raises:
        KeyError: no such joint.
        ValueError: a latency, limits or a smoothing that are not positive, a configuration that is none.

    Attributes:
        running: the motion until ``after`` begins.
        after: the chunk that was taken last.
        taken: whether the last push was taken.
    """

    robot: Robot
    running: Chunk
    after: Chunk
    taken: Bool[Array, ""]
    latency: Float[Array, ""]
    limits: Float[Array, "3 n"]
    smoothing: Float[Array, ""]

    def __init__(
        self,
        robot: Robot,
        q: Float[ArrayLike, " n"],
        *,
        latency: Float[ArrayLike, ""],
        waypoints: int,
        velocity: Limit = None,
        acceleration: Limit = None,
        jerk: Limit = None,
        smoothing: Float[ArrayLike, ""] = 1e-3,
    ):
        check_scalar_joints(robot, "a stream")
        self.robot, self.limits = robot, checked_limits(robot, velocity, acceleration, jerk, least_time=False)
        self.latency, self.smoothing = as_floats(latency), as_smoothing(smoothing)
        if (seen := concrete(self.latency)) is not None and not (seen.shape == () and seen > 0.0):
            raise OsikValueError(f"latency is {latency!r}; it is the positive time until a chunk takes over [s]")
        check_count("waypoints", waypoints, least=2)
        start = jnp.asarray(checked_start(robot, q))
        rest = jnp.tile(start, (max(FEWEST, waypoints) + 3, 1))
        begin, miss = jnp.asarray(jnp.finfo(start.dtype).min), jnp.zeros((waypoints, robot.nv), start.dtype)
        feasible = jnp.ones(robot.nv, bool)
        self.running = Chunk(begin, jnp.ones_like(begin), rest, miss, feasible, tuple(dof_names(robot)))
        self.after, self.taken = self.running, jnp.ones((), bool)

    def push(
        self,
        waypoints: Float[ArrayLike, "N n"] | Mapping[str, Any],
        times: Float[ArrayLike, " N"],
        now: Float[ArrayLike, ""],
    ) -> Stream:
        """Return the stream in which a chunk takes over at ``now + latency``, if it can be taken.

        Args:
            waypoints: positions of the joints (N, n) [rad or m]; or poses by frame as in ``follow`` (outside jit).
            times: increasing times of the waypoints [s]. (N,)
            now: time [s].

        Raises:
            KeyError: no such frame.
            ValueError: another number of waypoints; times that do not increase; poses that cannot be reached.
        """
        time, now = as_floats(times), as_floats(now)
        if time.shape != (len(self.after.miss),):
            raise OsikValueError(f"times have shape {time.shape}; the stream takes {len(self.after.miss)} waypoints")
        begin = now + self.latency
        is_ready = (now >= self.after.begin) & (begin < time[-1])
        if (seen := concrete(is_ready)) is not None and not seen:
            return eqx.tree_at(lambda own: own.taken, self, jnp.zeros((), bool))
        running = _chosen(now >= self.after.begin, self.after, self.running)
        kinds = dict(zip(("velocity", "acceleration", "jerk"), self.limits, strict=True))
        given = {"start": running.state(begin), "begin": begin, "smoothing": self.smoothing, **kinds}
        found = chunk(self.robot, waypoints, time, **given)
        taken = is_ready & found.feasible.all()
        chosen = _chosen(taken, found, self.after), _chosen(taken, running, self.running)
        return eqx.tree_at(lambda own: (own.after, own.running, own.taken), self, (*chosen, taken))

    def at(self, time: Float[ArrayLike, " T"]) -> Float[Array, "4 T n"]:
        """Return positions, velocities, accelerations and jerks at times [s], from the last push on."""
        return _at(self.running, self.after, as_floats(one_axis(time)))


@jax.jit
def _at(running: Chunk, after: Chunk, time: Float[Array, " T"]) -> Float[Array, "4 T n"]:
    return jnp.where((time >= after.begin)[:, None], after.at(time), running.at(time))


def _chosen(condition: Array, one: Chunk, other: Chunk) -> Chunk:
    return jax.tree.map(partial(jnp.where, condition), one, other)

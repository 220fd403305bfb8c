"""From a person to a robot while the person moves: a plan of a few frames ahead, mended at every frame."""

from __future__ import annotations

import enum
import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from .._errors import OsikValueError
from ..kinematics import difference
from ..limits import Limit
from ..robot import Robot
from ._finish import inside_limits, inside_ranges
from ._goals import Goals, Weights
from ._motion import HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import measure, read_person
from ._plan import make_plan, mend_plan
from ._profile import Profile
from ._skeletons import find_roles
from ._terms import Body, Bounds

_PAST = 2
"""Frames of the plan that are past: what speeds, accelerations and standing feet go on from."""
_HISTORY = 8
"""Frames before the present one that are kept of the person, for contacts and for joints that are missing."""
_FIRST_ITERATIONS = 100
_OFF = 1e-6
"""How far from the plan is held back [rad or m]."""


class LiveStatus(enum.IntEnum):
    """How a frame came about."""

    FOLLOWED = 0
    """As planned."""
    HELD_BACK = 1
    """Limits held the robot back from the plan; it comes back to it."""
    FILLED = 2
    """Joints of the person were missing, and filled in from the frames around."""
    LOST = 3
    """The person is missing in this frame and in all that are known after it; the robot comes to rest."""


class LiveFrame(NamedTuple):
    """A frame of the robot's motion.

    Attributes:
        q: configuration. (nq,)
        contact: whether left heel, left toe, right heel and right toe stand. (4,)
        status: how it came about.
        off_plan: how far the farthest joint is from the plan because a limit held it [rad or m].
        seconds: what it took to compute.
    """

    q: Float[np.ndarray, " nq"]
    contact: Bool[np.ndarray, "4"]
    status: LiveStatus
    off_plan: float
    seconds: float


class _Plan(NamedTuple):
    """The window that is planned, what is past first, and the robot's velocity."""

    q: Float[Array, "W nq"]
    velocity: Float[Array, " nv"]
    off: Float[Array, ""]


class LiveRetargeter(OnRobot):
    """Retargets a stream frame by frame, some frames behind the person: ``look_ahead`` of them are known ahead.

    Limits of position, speed and acceleration hold at every frame, whatever comes in. Feet stay where they stand, and
    the rest is as near to what ``Retargeter`` makes of the whole clip as a few frames of future allow.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        standing: some frames of the person standing, with the joints and the rate of the stream: it is measured there
            how long legs are, how high ankles, and where the floor is.
        profile: how the robot is seen. None: the package's own for NAO, G1 and Talos, or a guess (``find_profile``).
        mapping: role to the stream's name of it, see ``find_roles``. None: by the names that files use.
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        balance: as of ``Retargeter``.
        look_ahead: frames that the robot is behind the person, at least 1.
        iterations: of the plan at each frame, at least 1.

    Raises:
        ValueError: no two legs and two arms are found, joints are missing, or a number is out of range.
        KeyError: the profile, ``mapping`` or ``acceleration`` names something that does not exist.
    """

    def __init__(
        self,
        robot: Robot,
        standing: HumanMotion,
        *,
        profile: Profile | None = None,
        mapping: Mapping[str, str] | None = None,
        acceleration: float | Mapping[str, float] = ACCELERATION,
        balance: float | None = None,
        look_ahead: int = 8,
        iterations: int = 3,
    ):
        for name, value in (("look_ahead", look_ahead), ("iterations", iterations)):
            if not value >= 1:
                raise OsikValueError(f"{name} is {value}; it is 1 at least")
        super().__init__(robot, profile, acceleration, balance)
        self.look_ahead, self.iterations = int(look_ahead), int(iterations)
        self._standing, self.roles = standing, find_roles(standing.joint_names, mapping)
        self._measures = measure(standing, self.roles)
        self._dt = 1.0 / standing.fps
        self._window_bounds = self._bounds(self._dt)
        self.reset()

    @property
    def latency(self) -> float:
        """How far the robot is behind the person, without what it takes to compute (``LiveFrame.seconds``) [s]."""
        return self.look_ahead * self._dt

    def reset(self) -> None:
        """Forgets the person and the robot; the next frame is the first."""
        self._seen: list[np.ndarray] = []
        self._stands: list[np.ndarray | None] = []
        self._known = self._standing.positions[-1]
        self._plan: _Plan | None = None

    def step(
        self, positions: Float[np.ndarray, "J 3"] | None, contact: Bool[np.ndarray, "4"] | None = None
    ) -> LiveFrame | None:
        """Takes a frame of the person, and gives the robot's of ``look_ahead`` frames before.

        Args:
            positions: of the joints, in the order of ``standing`` [m]; NaN where one is not seen. None: no frame came.
            contact: whether left heel, left toe, right heel and right toe stand; None: to be found. All frames have
                it, or none.

        Returns:
            None for the first ``look_ahead`` frames.

        Raises:
            ValueError: another number of joints, or ``contact`` in some frames alone.
        """
        began = time.perf_counter()
        self._take(positions, contact)
        if len(self._seen) <= _HISTORY + self.look_ahead:
            return None
        return self._next(began)

    def finish(self) -> list[LiveFrame]:
        """The robot's last ``look_ahead`` frames, when no more of the person come: they stay as they were seen last."""
        if not self._seen:
            return []
        waiting = min(self.look_ahead, len(self._seen) - _HISTORY)
        frames = [self.step(None) for _ in range(self.look_ahead)]
        return [frame for frame in frames if frame is not None][-waiting:]

    def _take(self, positions: np.ndarray | None, contact: np.ndarray | None) -> None:
        """Puts a frame at the end of what was seen."""
        names = self._standing.joint_names
        seen = np.full((len(names), 3), np.nan) if positions is None else np.asarray(positions, float)
        if seen.shape != (len(names), 3):
            raise OsikValueError(f"a frame has shape {seen.shape}, expected {(len(names), 3)}: {', '.join(names)}")
        stands = None if contact is None else np.asarray(contact, bool)
        if stands is not None and stands.shape != (4,):
            raise OsikValueError(f"contact has shape {stands.shape}, expected (4,)")
        if positions is None and self._stands:
            stands = self._stands[-1]
        if self._stands and (stands is None) != (self._stands[-1] is None):
            raise OsikValueError("contact is given in some frames and not in others")
        seen = np.where(np.isfinite(seen).all(-1, keepdims=True), seen, np.nan)
        self._known = np.where(np.isnan(seen), self._known, seen)
        copies = 1 if self._seen else _HISTORY + 1
        self._seen += [seen] * copies
        self._stands += [stands] * copies
        most = _HISTORY + 1 + self.look_ahead
        self._seen, self._stands = self._seen[-most:], self._stands[-most:]

    def _next(self, began: float) -> LiveFrame:
        seen = np.array(self._seen)
        gone = np.isnan(seen[..., 0])
        contact = None if self._stands[0] is None else np.array(self._stands)
        motion = HumanMotion(
            "stream",
            self._standing.fps,
            self._standing.joint_names,
            _filled(seen, self._known),
            contact=contact,
        )
        person = read_person(motion, self.roles, self._measures)
        goals = jax.tree.map(lambda leaf: leaf[_HISTORY - _PAST :], self._build.goals(person))
        plan = self._advanced(goals)
        off, q = float(plan.off), np.asarray(plan.q[_PAST])
        # what is the present now is past at the next frame
        self._plan = plan
        status = LiveStatus.HELD_BACK if off > _OFF else LiveStatus.FOLLOWED
        if gone[_HISTORY].any():
            status = LiveStatus.LOST if gone[_HISTORY:].all() else LiveStatus.FILLED
        return LiveFrame(q, person.contact[_HISTORY], status, off, time.perf_counter() - began)

    def _advanced(self, goals: Goals) -> _Plan:
        """The window a frame further."""
        weights, bounds, guess = self.profile.weights, self._window_bounds, self._build.first_guess(goals)
        if self._plan is None:
            first = make_plan(self._body, goals, weights, bounds, guess, _FIRST_ITERATIONS).q
            # at rest in the first frame, which is there _PAST times more
            q = np.concatenate([np.repeat(np.asarray(first)[:1], _PAST, 0), np.asarray(first)[_PAST:]])
            q[:_PAST] = inside_ranges(self.robot, jnp.asarray(q[0]))
            velocity: Any = np.zeros(self.robot.nv, q.dtype)
        else:
            before = np.asarray(self._plan.q)
            q = np.concatenate([before[1:], before[-1:]])
            q[-1, :3] += guess[-1, :3] - guess[-2, :3]
            velocity = self._plan.velocity
        return _advance(self._body, goals, weights, bounds, q, velocity, self.limits, self._dt, self.iterations)


@jax.jit
def _advance(
    body: Body,
    goals: Goals,
    weights: Weights,
    bounds: Bounds,
    q: Float[Array, "W nq"],
    velocity: Float[Array, " nv"],
    limits: Sequence[Limit],
    dt: Float[Array, ""] | float,
    iterations: Int[Array, ""] | int,
) -> _Plan:
    """Mends the plan, and goes with it as far as the limits allow; not at all where it is not finite."""
    dt = jnp.asarray(dt, q.dtype)
    plan = mend_plan(body, goals, weights, bounds, q, 1.0 * (jnp.arange(len(q)) >= _PAST), iterations).q
    still = jnp.concatenate([q[:_PAST], jnp.broadcast_to(q[_PAST - 1], q[_PAST:].shape)])
    plan = jnp.where(jnp.isfinite(plan).all(), plan, still)
    goal = plan[_PAST - 1]
    now, velocity = inside_limits(body.robot, goal, velocity, goal, plan[_PAST], limits, dt)
    off = jnp.abs(difference(body.robot, now, plan[_PAST])).max()
    return _Plan(plan.at[_PAST].set(now), velocity, off)


def _filled(seen: Float[np.ndarray, "F J 3"], known: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "F J 3"]:
    """Joints that are missing, on the line from where they were seen before to where they are seen next.

    Those that are missing in all frames are where they were known to be last.
    """
    out, frames = seen.copy(), np.arange(len(seen))
    gone = np.isnan(seen[..., 0])
    for joint in np.flatnonzero(gone.any(0)):
        there = ~gone[:, joint]
        if not there.any():
            out[:, joint] = known[joint]
            continue
        for axis in range(3):
            out[:, joint, axis] = np.interp(frames, frames[there], seen[there, joint, axis])
    return out

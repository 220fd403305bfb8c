"""Retargeting of a live stream: a plan over a short look-ahead, updated at every frame."""

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
from ..numerics._arguments import check_count
from ..robot import Robot
from ._finish import inside_ranges, moved, velocity_inside
from ._goals import Goals, Weights
from ._motion import LARGEST, HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import measure, read_person
from ._plan import make_plan, mend_plan
from ._profile import Profile
from ._stance import Stance, hold_feet
from ._terms import Body, Bounds

_PAST = 2
"""Number of past frames in the plan; speeds, accelerations and contacts continue from them."""
_HISTORY, _LEAST_HISTORY = 0.27, 4
"""History of the person that is kept for contacts and missing joints [s], and the least number of frames."""
_LONGEST = 2.0
"""Longest allowed look-ahead [s]."""
_FIRST_ITERATIONS = 100
_DAMPING, _MOST_DAMPING, _LESS, _MORE = 1.0, 1e6, 0.25, 64.0
"""Least and largest damping of a frame's first iteration, and the factors on it after a frame with and without an
accepted step.
"""
_OFF = 1e-6
"""Distance from the plan above which a frame counts as held back [rad or m]."""
_FEET_OFF = 1e-3
"""Largest error of a standing foot: distance from its landing place or from the floor [m]."""


class LiveStatus(enum.IntEnum):
    """Outcome of one frame of a stream."""

    FOLLOWED = 0
    """The robot follows the plan."""
    HELD_BACK = 1
    """A limit keeps the robot off the plan; it returns to the plan later."""
    FILLED = 2
    """Joints of the person are missing and interpolated from neighbouring frames."""
    LOST = 3
    """The person is missing in this frame and in all known later frames; the robot comes to rest."""
    FEET_OFF = 4
    """Limits do not allow the contacts: a contact point is over 1 mm from its landing place or the floor, or a sole
    is over 1 mm below the floor."""


class LiveFrame(NamedTuple):
    """One frame of the robot's motion; ``LiveRetargeter.step`` says what the fields are."""

    q: Float[np.ndarray, " nq"]
    contact: Bool[np.ndarray, "4"]
    status: LiveStatus
    off_plan: float
    feet_off: float
    iterations: int
    seconds: float


class _Plan(NamedTuple):
    """State of a live plan: configurations (past frames first), velocity, stance, damping and figures."""

    q: Float[Array, "W nq"]
    velocity: Float[Array, " nv"]
    stance: Stance
    damping: Float[Array, ""]
    off: Float[Array, ""]
    feet_off: Float[Array, ""]
    iterations: Int[Array, ""]


class LiveRetargeter(OnRobot):
    """Retargeter for a stream: each call takes a frame of the person and returns the robot's frame ``look_ahead`` ago.

    Limits of position, speed and acceleration hold in every frame for any input. Within them, standing feet stay at
    their landing place to 1 um; the status ``FEET_OFF`` reports frames in which the limits do not allow that. Otherwise
    the motion is as close to that of ``Retargeter`` as the look-ahead allows.

    Args:
        robot: with limbs of a person, see ``guess_profile``; z up at home.
        standing: frames of the person standing, with the joints and the rate of the stream; they give leg length, ankle
            height and floor.
        mapping: role to joint name of the stream. None: by common names.
        profile: as in ``Retargeter``.
        acceleration: as in ``Retargeter``.
        balance: as in ``Retargeter``.
        look_ahead: delay of the robot behind the person, one frame to 2 s [s].
        iterations: largest number of iterations per frame; fewer where the bounds hold and steps gain little.

    Raises:
        ValueError: no limbs are found, nothing holds a free base, joints are missing, or a number is out of range.
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
        look_ahead: float = 0.27,
        iterations: int = 10,
    ):
        if not 0.0 < look_ahead <= _LONGEST:
            raise OsikValueError(f"look_ahead is {look_ahead}; it is a time in seconds, over 0 and up to {_LONGEST:g}")
        check_count("iterations", iterations)
        super().__init__(robot, profile, acceleration, balance)
        self._dt = 1.0 / standing.fps
        self.frames_ahead = max(1, round(look_ahead * standing.fps))
        self.iterations = int(iterations)
        self._history = max(_LEAST_HISTORY, round(_HISTORY * standing.fps))
        self._standing, self.roles = standing, self._roles(standing, mapping)
        self._measures = measure(standing, self.roles, self.profile.standing)
        self._bounds = self._build.bounds(self._acceleration, self._dt)
        self.reset()

    @property
    def latency(self) -> float:
        """Return the delay of the robot behind the person [s], without the computing time (``seconds`` of a frame)."""
        return self.frames_ahead * self._dt

    def reset(self) -> None:
        """Forget the person and the robot, so that the next frame is the first."""
        self._seen: list[np.ndarray] = []
        self._stands: list[np.ndarray | None] = []
        self._known = self._standing.positions[-1]
        self._plan: _Plan | None = None

    def step(
        self, positions: Float[np.ndarray, "J 3"] | None, contact: Bool[np.ndarray, "4"] | None = None
    ) -> LiveFrame | None:
        """Take a frame of the person and return the robot's frame of ``frames_ahead`` frames earlier.

        Args:
            positions: joint positions in the order of ``standing`` [m], NaN for a joint that is not seen. None: the
                frame is lost.
            contact: whether left heel, left toe, right heel and right toe stand; None: detected. All frames must have
                it, or none.

        Returns:
            None for the first ``frames_ahead`` frames, then a frame.

            - ``q``: configuration. (nq,)
            - ``contact``: whether left heel, left toe, right heel and right toe stand. (4,)
            - ``status``: a ``LiveStatus``: ``FOLLOWED``, ``HELD_BACK``, ``FILLED``, ``LOST`` or ``FEET_OFF``.
            - ``off_plan``: largest distance of a joint from the plan because of a limit [rad or m].
            - ``feet_off``: largest distance of a contact point from its landing place or the floor, or of a sole below
                the floor [m].
            - ``iterations``: iterations of the plan.
            - ``seconds``: computing time [s].

        Raises:
            ValueError: another number of joints, or ``contact`` in some frames alone.
        """
        began = time.perf_counter()
        self._take(positions, contact)
        if len(self._seen) <= self._history + self.frames_ahead:
            return None
        return self._next(began)

    def finish(self) -> list[LiveFrame]:
        """Return the robot's last ``frames_ahead`` frames at the end of a stream; the person holds the last pose."""
        if not self._seen:
            return []
        waiting = min(self.frames_ahead, len(self._seen) - self._history)
        frames = [self.step(None) for _ in range(self.frames_ahead)]
        return [frame for frame in frames if frame is not None][-waiting:]

    def _take(self, positions: np.ndarray | None, contact: np.ndarray | None) -> None:
        """Append a frame to the history, with NaN for joints that are not seen."""
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
        with np.errstate(invalid="ignore"):
            seen = np.where((np.abs(seen) <= LARGEST).all(-1, keepdims=True), seen, np.nan)
        self._known = np.where(np.isnan(seen), self._known, seen)
        # the first frame fills the history, as if the person had stood there before
        copies = 1 if self._seen else self._history + 1
        self._seen += [seen] * copies
        self._stands += [stands] * copies
        most = self._history + 1 + self.frames_ahead
        self._seen, self._stands = self._seen[-most:], self._stands[-most:]

    def _next(self, began: float) -> LiveFrame:
        seen = np.array(self._seen)
        gone = np.isnan(seen[..., 0])
        contact = None if self._stands[0] is None else np.array(self._stands)
        names, positions = self._standing.joint_names, _filled(seen, self._known)
        motion = HumanMotion("stream", self._standing.fps, names, positions, contact=contact)
        own = read_person(motion, self.roles, self._measures, self.profile.standing)
        person, now = self._build.seen(own), self._history
        # the last pass holds the feet, so a long contact needs no larger weight, which would take more iterations
        goals = jax.tree.map(lambda leaf: leaf[now - _PAST :], self._build.goals(person, firm=False))
        self._plan = plan = self._advanced(goals, person.contact[now])
        # slicing the array of JAX would be a program of its own
        off, feet_off, q = float(plan.off), float(plan.feet_off), np.asarray(plan.q)[_PAST]
        status = LiveStatus.HELD_BACK if off > _OFF else LiveStatus.FOLLOWED
        status = LiveStatus.FEET_OFF if feet_off > _FEET_OFF else status
        if gone[now].any():
            status = LiveStatus.LOST if gone[now:].all() else LiveStatus.FILLED
        seconds = time.perf_counter() - began
        return LiveFrame(q, person.contact[now], status, off, feet_off, int(plan.iterations), seconds)

    def _advanced(self, goals: Goals, contact: Bool[np.ndarray, "4"]) -> _Plan:
        """Return the plan moved on by one frame."""
        weights, bounds, guess = self.profile.weights, self._bounds, self._build.first_guess(goals)
        if self._plan is None:
            first = make_plan(self._body, goals, weights, bounds, guess, _FIRST_ITERATIONS).q
            # start at rest: the first frame is repeated _PAST times
            q = np.concatenate([np.repeat(np.asarray(first)[:1], _PAST, 0), np.asarray(first)[_PAST:]])
            q[:_PAST] = inside_ranges(self.robot, jnp.asarray(q[0]))
            velocity: Any = np.zeros(self.robot.nv, q.dtype)
            stance: Any = Stance(jnp.zeros((4, 2), q.dtype), jnp.zeros(4, bool))
            damping: Any = np.asarray(_DAMPING, q.dtype)
        else:
            before = np.asarray(self._plan.q)
            q = np.concatenate([before[1:], before[-1:]])
            if (at := self._build.free) is not None:
                q[-1, at : at + 3] += guess[-1, at : at + 3] - guess[-2, at : at + 3]
            velocity, stance, damping = self._plan.velocity, self._plan.stance, self._plan.damping
        before = velocity, stance, damping
        more = contact, self.limits, self._dt, self.iterations
        return _advance(self._body, goals, weights, bounds, q, before, *more)


@jax.jit
def _advance(
    body: Body,
    goals: Goals,
    weights: Weights,
    bounds: Bounds,
    q: Float[Array, "W nq"],
    before: tuple[Float[Array, " nv"], Stance, Float[Array, ""]],
    contact: Bool[Array, "4"],
    limits: Sequence[Limit],
    dt: Float[Array, ""] | float,
    iterations: Int[Array, ""] | int,
) -> _Plan:
    """Update the plan and move one frame along it within limits and contacts; stay if the plan is not finite."""
    (velocity, stance, damping), dt = before, jnp.asarray(dt, q.dtype)
    mended = mend_plan(body, goals, weights, bounds, q, 1.0 * (jnp.arange(len(q)) >= _PAST), iterations, damping)
    # if all steps were refused, the next frame starts with more damping
    taken = jnp.any(mended.q != q)
    # the damping is carried from frame to frame, because a frame has too few iterations to find it anew
    damping = jnp.clip(damping * jnp.where(taken, _LESS, _MORE), _DAMPING, _MOST_DAMPING)
    # a plan that is not finite is replaced by standing still
    still = jnp.concatenate([q[:_PAST], jnp.broadcast_to(q[_PAST - 1], q[_PAST:].shape)])
    plan = jnp.where(jnp.isfinite(mended.q).all(), mended.q, still)
    goal = plan[_PAST - 1]
    velocity, lower, upper = velocity_inside(body.robot, goal, velocity, goal, plan[_PAST], limits, dt)
    held = hold_feet(body, goal, dt * velocity, dt * lower, dt * upper, contact, stance)
    limited, _ = moved(body.robot, goal, velocity, dt)
    q, velocity = moved(body.robot, goal, held.step / dt, dt)
    off = jnp.abs(difference(body.robot, limited, plan[_PAST])).max()
    return _Plan(plan.at[_PAST].set(q), velocity, held.stance, damping, off, held.off, mended.iterations)


def _filled(seen: Float[np.ndarray, "F J 3"], known: Float[np.ndarray, "J 3"]) -> Float[np.ndarray, "F J 3"]:
    """Return positions with missing joints interpolated in time between the frames that show them.

    A joint missing in all frames keeps its last known position.
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

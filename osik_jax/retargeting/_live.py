"""From a person to a robot while the person moves: a plan of a short time ahead, mended at every frame."""

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
from ._finish import inside_ranges, moved, velocity_inside
from ._goals import Goals, Weights
from ._motion import LARGEST, HumanMotion
from ._on_robot import ACCELERATION, OnRobot
from ._person import measure, read_person
from ._plan import make_plan, mend_plan
from ._profile import Profile
from ._skeletons import find_roles
from ._stance import Stance, hold_feet
from ._terms import Body, Bounds

_PAST = 2
"""Frames of the plan that are past: what speeds, accelerations and standing feet go on from."""
_HISTORY, _LEAST_HISTORY = 0.27, 4
"""Time before the present frame that is kept of the person, for contacts and for joints that are missing [s]; frames at
least."""
_LONGEST = 2.0
"""Look-ahead that is allowed [s]."""
_FIRST_ITERATIONS = 100
_SHARE = 0.6
"""Share of a frame's time that computing may take where nothing else is asked for."""
_CALMER = 0.2
"""Weight of the last frame in the mean time of an iteration."""
_LEAST_ITERATIONS = 5
"""Iterations that a frame gets whatever they take: with fewer, plans fall behind the person and feet give way."""
_BROKEN = 0.5
"""Cost of broken bounds from which a plan gets all its iterations whatever they take: feet give way some frames later,
for limits leave them no way back."""
_DAMPING, _MOST_DAMPING, _LESS, _MORE = 1.0, 1e6, 0.25, 64.0
"""Damping of a frame's first iteration, at least and at most, and what it is multiplied with where a step of the frame
before was taken, and where none was."""
_OFF = 1e-6
"""How far from the plan is held back [rad or m]."""
_FEET_OFF = 1e-3
"""How far feet that hold may be from where they landed and from the floor [m]."""


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
    FEET_OFF = 4
    """Limits do not let feet hold: a point that stands is over 1 mm from where it landed or from the floor, or a sole
    is over 1 mm below the floor."""


class LiveFrame(NamedTuple):
    """A frame of the robot's motion.

    Attributes:
        q: configuration. (nq,)
        contact: whether left heel, left toe, right heel and right toe stand. (4,)
        status: how it came about.
        off_plan: how far the farthest joint is from the plan because a limit held it [rad or m].
        feet_off: how far a point that stands is from where it landed or from the floor, or a sole below the floor, at
            most [m].
        iterations: of the plan.
        seconds: what it took to compute.
    """

    q: Float[np.ndarray, " nq"]
    contact: Bool[np.ndarray, "4"]
    status: LiveStatus
    off_plan: float
    feet_off: float
    iterations: int
    seconds: float


class _Plan(NamedTuple):
    """The window that is planned, what is past first, the robot's velocity, where its feet stand, and the damping.

    ``penalty`` is the cost of bounds that the plan breaks: 0.5 for a point that stands and is 1 mm off.
    """

    q: Float[Array, "W nq"]
    velocity: Float[Array, " nv"]
    stance: Stance
    damping: Float[Array, ""]
    off: Float[Array, ""]
    feet_off: Float[Array, ""]
    iterations: Int[Array, ""]
    penalty: Float[Array, ""]


class LiveRetargeter(OnRobot):
    """Retargets a stream frame by frame, some time behind the person: ``look_ahead`` of it is known ahead.

    Limits of position, speed and acceleration hold at every frame, whatever comes in. Inside them feet stay where they
    landed, to a thousandth of a millimetre; ``LiveStatus.FEET_OFF`` says where limits do not allow that. The rest is as
    near to what ``Retargeter`` makes of the whole clip as that much future allows.

    Args:
        robot: with a free base, two legs and two arms; x forward, y left, z up at home.
        standing: some frames of the person standing, with the joints and the rate of the stream: it is measured there
            how long legs are, how high ankles, and where the floor is.
        profile: how the robot is seen. None: the package's own for NAO, G1 and Talos, or a guess (``find_profile``).
        mapping: role to the stream's name of it, see ``find_roles``. None: by the names that files use.
        acceleration: greatest acceleration of all joints, or by joint name or glob [rad/s^2 or m/s^2].
        balance: as of ``Retargeter``.
        look_ahead: time that the robot is behind the person, up to 2 s; a frame at least [s].
        iterations: of the plan at each frame, at most. They end before where the bounds hold and steps gain little.
        budget: time that computing a frame may take [s]: iterations that would take longer are not begun, but for the
            first five and those of a plan that breaks a bound. None: 0.6 of the time from one frame to the next.

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
        look_ahead: float = 0.27,
        iterations: int = 20,
        budget: float | None = None,
    ):
        if not 0.0 < look_ahead <= _LONGEST:
            raise OsikValueError(f"look_ahead is {look_ahead}; it is a time in seconds, over 0 and up to {_LONGEST:g}")
        if not iterations >= 1:
            raise OsikValueError(f"iterations is {iterations}; it is 1 at least")
        if budget is not None and not budget > 0.0:
            raise OsikValueError(f"budget is {budget}; it is a time in seconds, over 0")
        super().__init__(robot, profile, acceleration, balance)
        self._dt = 1.0 / standing.fps
        self.frames_ahead = max(1, round(look_ahead * standing.fps))
        self.iterations, self.budget = int(iterations), _SHARE * self._dt if budget is None else float(budget)
        self._history = max(_LEAST_HISTORY, round(_HISTORY * standing.fps))
        self._standing, self.roles = standing, find_roles(standing.joint_names, mapping)
        self._measures = measure(standing, self.roles)
        self._window_bounds = self._bounds(self._dt)
        self._iteration_seconds = 0.0
        self.reset()

    @property
    def latency(self) -> float:
        """How far the robot is behind the person, without what it takes to compute (``LiveFrame.seconds``) [s]."""
        return self.frames_ahead * self._dt

    def reset(self) -> None:
        """Forgets the person and the robot; the next frame is the first."""
        self._seen: list[np.ndarray] = []
        self._stands: list[np.ndarray | None] = []
        self._known = self._standing.positions[-1]
        self._plan: _Plan | None = None

    def step(
        self, positions: Float[np.ndarray, "J 3"] | None, contact: Bool[np.ndarray, "4"] | None = None
    ) -> LiveFrame | None:
        """Takes a frame of the person, and gives the robot's of ``frames_ahead`` frames before.

        Args:
            positions: of the joints, in the order of ``standing`` [m]; NaN where one is not seen. None: no frame came.
            contact: whether left heel, left toe, right heel and right toe stand; None: to be found. All frames have
                it, or none.

        Returns:
            None for the first ``frames_ahead`` frames.

        Raises:
            ValueError: another number of joints, or ``contact`` in some frames alone.
        """
        began = time.perf_counter()
        self._take(positions, contact)
        if len(self._seen) <= self._history + self.frames_ahead:
            return None
        return self._next(began)

    def finish(self) -> list[LiveFrame]:
        """The robot's last ``frames_ahead`` frames, when no more of the person come, who stays as seen last."""
        if not self._seen:
            return []
        waiting = min(self.frames_ahead, len(self._seen) - self._history)
        frames = [self.step(None) for _ in range(self.frames_ahead)]
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
        with np.errstate(invalid="ignore"):
            seen = np.where((np.abs(seen) <= LARGEST).all(-1, keepdims=True), seen, np.nan)
        self._known = np.where(np.isnan(seen), self._known, seen)
        copies = 1 if self._seen else self._history + 1
        self._seen += [seen] * copies
        self._stands += [stands] * copies
        most = self._history + 1 + self.frames_ahead
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
        person, now = read_person(motion, self.roles, self._measures), self._history
        goals = jax.tree.map(lambda leaf: leaf[now - _PAST :], self._build.goals(person))
        self._plan = plan = self._advanced(goals, person.contact[now], began)
        off, feet_off, q = float(plan.off), float(plan.feet_off), np.asarray(plan.q[_PAST])
        status = LiveStatus.HELD_BACK if off > _OFF else LiveStatus.FOLLOWED
        status = LiveStatus.FEET_OFF if feet_off > _FEET_OFF else status
        if gone[now].any():
            status = LiveStatus.LOST if gone[now:].all() else LiveStatus.FILLED
        seconds = time.perf_counter() - began
        return LiveFrame(q, person.contact[now], status, off, feet_off, int(plan.iterations), seconds)

    def _advanced(self, goals: Goals, contact: Bool[np.ndarray, "4"], began: float) -> _Plan:
        """The window a frame further; ``began`` is when the frame came [s]."""
        weights, bounds, guess = self.profile.weights, self._window_bounds, self._build.first_guess(goals)
        if self._plan is None:
            first = make_plan(self._body, goals, weights, bounds, guess, _FIRST_ITERATIONS).q
            # at rest in the first frame, which is there _PAST times more
            q = np.concatenate([np.repeat(np.asarray(first)[:1], _PAST, 0), np.asarray(first)[_PAST:]])
            q[:_PAST] = inside_ranges(self.robot, jnp.asarray(q[0]))
            velocity: Any = np.zeros(self.robot.nv, q.dtype)
            stance: Any = Stance(jnp.zeros((4, 2), q.dtype), jnp.zeros(4, bool))
            damping: Any = np.asarray(_DAMPING, q.dtype)
        else:
            before = np.asarray(self._plan.q)
            q = np.concatenate([before[1:], before[-1:]])
            q[-1, :3] += guess[-1, :3] - guess[-2, :3]
            velocity, stance, damping = self._plan.velocity, self._plan.stance, self._plan.damping
        start, first = time.perf_counter(), self._plan is None
        left = self.budget - (start - began)
        most = min(max(int(left // max(self._iteration_seconds, 1e-9)) - 1, _LEAST_ITERATIONS), self.iterations)
        known = self._body, goals, weights, bounds
        plan = _advance(*known, q, (velocity, stance, damping), contact, self.limits, self._dt, most)
        more = self.iterations - int(plan.iterations)
        if float(plan.penalty) > _BROKEN and more > 0:
            before = velocity, stance, plan.damping
            plan = _advance(*known, plan.q, before, contact, self.limits, self._dt, more)
            plan = plan._replace(iterations=plan.iterations + self.iterations - more)
        spent = (time.perf_counter() - start) / (int(plan.iterations) + 1)
        mean = self._iteration_seconds
        if not first:  # which may have been compiled
            self._iteration_seconds = spent if mean == 0.0 else mean + _CALMER * (min(spent, 2.0 * mean) - mean)
        return plan


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
    """Mends the plan, and goes with it as far as the limits and the feet allow; not at all where it is not finite."""
    (velocity, stance, damping), dt = before, jnp.asarray(dt, q.dtype)
    mended = mend_plan(body, goals, weights, bounds, q, 1.0 * (jnp.arange(len(q)) >= _PAST), iterations, damping)
    # steps that were all refused need more damping from the start
    taken = jnp.any(mended.q != q)
    damping = jnp.clip(damping * jnp.where(taken, _LESS, _MORE), _DAMPING, _MOST_DAMPING)
    still = jnp.concatenate([q[:_PAST], jnp.broadcast_to(q[_PAST - 1], q[_PAST:].shape)])
    plan = jnp.where(jnp.isfinite(mended.q).all(), mended.q, still)
    goal = plan[_PAST - 1]
    velocity, lower, upper = velocity_inside(body.robot, goal, velocity, goal, plan[_PAST], limits, dt)
    held = hold_feet(body, goal, dt * velocity, dt * lower, dt * upper, contact, stance)
    limited, _ = moved(body.robot, goal, velocity, dt)
    q, velocity = moved(body.robot, goal, held.step / dt, dt)
    off = jnp.abs(difference(body.robot, limited, plan[_PAST])).max()
    return _Plan(
        plan.at[_PAST].set(q), velocity, held.stance, damping, off, held.off, mended.iterations, mended.cost[1]
    )


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

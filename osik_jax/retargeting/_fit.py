"""A robot's scale, keypoints and weights, found by the gradient of a stated loss on some clips."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError
from ..kinematics import difference, forward_kinematics
from ..kinematics._rigid import rotate
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._body import Build
from ._goals import Goals, Weights
from ._lanes import padded
from ._motion import HumanMotion
from ._on_robot import ACCELERATION
from ._plan import at_solution, make_plan, mend_plan
from ._profile import Profile
from ._retarget import Retargeter, checked_by_name
from ._roles import LIMBS
from ._terms import Body, Bounds, frame_rows

TUNED = ("pelvis", "torso", "root", "foot", "posture", "smooth", "smooth_base")
"""The weights that are tuned; that of limbs is the unit, and those of bounds are none of taste."""
_RATE = 0.05
"""Of Adam: about what each parameter changes in a step, in its unit."""
_WEIGHT, _SCALE, _PLACE = 1.0, 0.1, 1e-3
"""Units: of the logarithm of a weight, of that of the scale, of a keypoint's place [m]."""
_MOST_WEIGHT, _MOST_SCALE, _MOST_PLACE = 3.0, 0.1, 0.02
"""How far they may go."""
_SETTLING, _FOLLOWING = 150, 40
"""Iterations of a plan beyond where ``retarget`` ends: before the first step, and in each, from the plan before."""


@dataclasses.dataclass(frozen=True)
class FitLoss:
    """What is minimised: of each clip a sum of means over its frames, each with a weight.

    Attributes:
        tracking: of the squared angles between the person's limbs and the robot's [1/rad^2]. The robot's limbs are
            between the places that the profile had before the fit: what is tuned cannot move the measure.
        turning: of the squared angles by which pelvis, chest and feet are turned off the person's [1/rad^2].
        slip: of the squared distance that standing points move in a frame [1/m^2].
        bounds: of what is left of the plan's bounds, squares with the profile's weights: the height of standing points,
            depth in the floor and in other shapes, and what is beyond ranges.
        acceleration: of the squared acceleration of the joints [1/(rad/s^2)^2].
    """

    tracking: float = 1.0
    turning: float = 0.01
    slip: float = 1e4
    bounds: float = 1e-2
    acceleration: float = 2e-8


@dataclasses.dataclass(frozen=True)
class Fit:
    """What came of ``fit``.

    Attributes:
        profile: with the scale, keypoints and weights of the best step.
        step: which one that was; 0: the profile that was given.
        losses: of each step, relative to step 0, means over the clips that are learned from. (steps + 1,)
        held_out: the same of those that are held out; empty where there are none. (steps + 1,)
    """

    profile: Profile
    step: int
    losses: Float[np.ndarray, " steps"]
    held_out: Float[np.ndarray, " steps"]


class _Parameters(NamedTuple):
    """What is tuned; all 0 is the profile as it was."""

    weights: Mapping[str, Array]
    scale: Float[Array, ""]
    offsets: Float[Array, "keys 3"]


class _Problem(NamedTuple):
    """A clip in the form that is computed with; the hips' path is not scaled yet."""

    goals: Goals
    path: Float[Array, "F 3"]
    bounds: Bounds
    start: Float[Array, "F nq"]
    rate: Float[Array, ""]


class _Given(NamedTuple):
    """What a clip's loss depends on beside the parameters and the plan."""

    body: Body
    problem: _Problem
    weights: Weights
    lift: float | Array  # of the hips' path, by the height of the ankles [m]


def fit(
    robot: Robot,
    motions: Sequence[HumanMotion],
    *,
    held_out: Sequence[HumanMotion] = (),
    profile: Profile | None = None,
    mapping: Mapping[str, str] | None = None,
    loss: FitLoss | None = None,
    acceleration: float | Mapping[str, float] = ACCELERATION,
    steps: int = 20,
    max_iterations: int = 40,
) -> Fit:
    """Tunes a profile's scale, keypoints (by up to 2 cm) and weights on some clips.

    The gradient is that of the plan's solution: where a sum of squares is least, a change of what it depends on moves
    the solution by one step of Gauss and Newton, which is differentiated. For that a plan goes on far beyond where
    ``retarget`` ends, and each step's begins with the one before: so the loss is that of the same minimum throughout,
    and has no jumps. Adam goes down the mean of the clips' losses, each relative to what it was at first. Of the clips
    that are held out the loss is that of what ``retarget`` gives, and the step where it is least is taken: few clips
    are soon learned by heart. Where none is better than the profile that was given, that comes back.

    Args:
        robot: as of ``retarget``.
        motions: the clips that are learned from.
        held_out: clips that choose the step; without any, those that are learned from do.
        profile: where to start. None: as of ``retarget``.
        mapping: as of ``retarget``, the same for all.
        loss: None: ``FitLoss()``.
        acceleration: as of ``retarget``.
        steps: of Adam.
        max_iterations: of each plan that ``retarget`` would make.

    Raises:
        ImportError: optax is not installed (the extra ``tuning``).
        ValueError: no clips, no steps; else as of ``retarget``.
    """
    try:
        import optax
    except ImportError as missing:
        raise ImportError("osik_jax.retargeting.fit needs optax: pip install 'osik-jax[tuning]'") from missing
    if not motions:
        raise OsikValueError("there are no clips to learn from")
    if not steps > 0:
        raise OsikValueError(f"steps is {steps}; it has to be more than 0")
    own = Retargeter(robot, profile=profile, acceleration=acceleration, max_iterations=max_iterations)
    setting = _Setting(own, FitLoss() if loss is None else loss)
    train, others = setting.problems(motions, held_out, mapping)
    now = setting.origin()
    optimiser = optax.adam(_RATE)
    state = optimiser.init(now)
    seen: list[_Parameters] = []
    learned: list[list[float]] = []
    judged: list[list[float]] = []
    plans = [setting.plan(now, problem) for problem in train]
    for step in range(steps + 1):
        found = [setting.slope(now, problem, plan) for problem, plan in zip(train, plans, strict=True)]
        seen.append(now)
        learned.append([value for value, _, _ in found])
        plans = [plan for _, _, plan in found]
        judged.append([setting.loss(now, problem) for problem in others])
        scaled = [_over(slope, unit) for (_, slope, _), unit in zip(found, learned[0], strict=True)]
        slopes: Any = jax.tree.map(lambda *leaves: sum(leaves) / len(leaves), *scaled)
        if step == steps or not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes)):
            break
        change, state = optimiser.update(slopes, state)
        now = optax.apply_updates(now, change)
    losses, held = _relative(learned), _relative(judged) if others else np.zeros(0)
    best = int(np.nanargmin(held if others else losses))  # the last may be no number
    chosen = own.profile if best == 0 else setting.profile(seen[best])
    return Fit(chosen, best, losses, held)


def _over(slope: Any, unit: float) -> Any:
    return jax.tree.map(lambda leaf: leaf / unit, slope)


def _relative(losses: Sequence[Sequence[float]]) -> Float[np.ndarray, " steps"]:
    """Of each step the mean over clips, each relative to its first."""
    values = np.array(losses)
    return np.mean(values / values[0], 1)


class _Setting:
    """What all clips share."""

    def __init__(self, own: Retargeter, terms: FitLoss):
        self.own, self.terms = own, dataclasses.astuple(terms)
        self.body, self.build, self.weights = own._body, own._build, own.profile.weights

    def origin(self) -> _Parameters:
        """The profile as it is."""
        weights = {name: jnp.zeros_like(getattr(self.weights, name)) for name in TUNED}
        return _Parameters(weights, jnp.zeros(()), jnp.zeros((len(self.body.keys), 3)))

    def problems(
        self, motions: Sequence[HumanMotion], held_out: Sequence[HumanMotion], mapping: Mapping[str, str] | None
    ) -> tuple[list[_Problem], list[_Problem]]:
        """The clips, padded to one length, so that they share a program.

        The path of the hips is as the profile's scale has it, from the height of the ankles up.
        """
        clips = [self.own._read(*checked_by_name(motion, mapping, None)) for motion in (*motions, *held_out)]
        length = max(len(clip.start) for clip in clips)
        lift = np.array([0.0, 0.0, self.build.ankle])
        found = []
        for clip in clips:
            goals, start = jax.tree.map(jnp.asarray, padded(clip.goals, clip.start, length - len(clip.start)))
            found.append(_Problem(goals, goals.root - lift, clip.bounds, start, jnp.asarray(1.0 / clip.dt)))
        return found[: len(motions)], found[len(motions) :]

    def loss(self, at: _Parameters, problem: _Problem) -> float:
        """Of what ``retarget`` gives for a clip."""
        most = jnp.asarray(self.own.max_iterations)
        return float(_value(at, self._given(problem), self.terms, most))

    def plan(self, at: _Parameters, problem: _Problem) -> Array:
        """A clip's plan, at its minimum but for little: (F, nq)."""
        given = self._given(problem)
        return _settled(at, given, _planned(at, given, jnp.asarray(self.own.max_iterations)), _SETTLING)

    def slope(self, at: _Parameters, problem: _Problem, plan: Array) -> tuple[float, Any, Array]:
        """The loss at the minimum that is near a plan, its gradient, and the plan there."""
        given = self._given(problem)
        plan = _settled(at, given, plan, _FOLLOWING)
        value, slope = _value_and_slope(at, given, self.terms, plan)
        return float(value), slope, plan

    def _given(self, problem: _Problem) -> _Given:
        return _Given(self.body, problem, self.weights, self.build.ankle)

    def profile(self, at: _Parameters) -> Profile:
        """The profile with what was tuned, in four digits."""

        def rounded(value: Array) -> Any:
            return np.vectorize(lambda x: float(f"{x:.4g}"))(np.asarray(value, float))

        own = self.own.profile
        weights = {name: rounded(value) for name, value in _tuned_weights(self.weights, at).items()}
        moves = np.round(np.asarray(_moves(at)), 4)
        keypoints = {
            role: (frame, (float(p[0] + m[0]), float(p[1] + m[1]), float(p[2] + m[2])))
            for (role, (frame, p)), m in zip(own.keypoints.items(), moves, strict=True)
        }
        factor = float(_factor(at.scale))
        moved = dataclasses.replace(own, keypoints=keypoints, weights=dataclasses.replace(own.weights, **weights))
        if own.scale is not None:
            return dataclasses.replace(moved, scale=round(own.scale * factor, 4))
        # legs that were measured between other places are of another length
        longer = Build.of(self.own.robot, moved).leg / self.build.leg
        return dataclasses.replace(moved, stretch=round(own.stretch * factor / longer, 4))


def _bounded(parameter: Array, unit: float, most: float) -> Array:
    """So many units, and never more than the most."""
    return most * jnp.tanh(unit * parameter / most)


def _factor(scale: Float[Array, ""]) -> Float[Array, ""]:
    """Of the path."""
    return jnp.exp(_bounded(scale, _SCALE, _MOST_SCALE))


def _moves(at: _Parameters) -> Float[Array, "keys 3"]:
    """Of the keypoints, each in its frame [m]."""
    return _bounded(at.offsets, _PLACE, _MOST_PLACE)


def _tuned_weights(weights: Weights, at: _Parameters) -> dict[str, Array]:
    """Weights by name, at most 20 times what they were or a twentieth."""
    return {
        name: getattr(weights, name) * jnp.exp(_bounded(change, _WEIGHT, _MOST_WEIGHT))
        for name, change in at.weights.items()
    }


def _asked(at: _Parameters, given: _Given) -> tuple[Body, Goals, Weights, Bounds]:
    """What a plan is made for."""
    body, problem = given.body, given.problem
    moved = eqx.tree_at(lambda b: b.offsets, body, body.offsets.at[: len(body.keys)].add(_moves(at)))
    tuned = dataclasses.replace(given.weights, **_tuned_weights(given.weights, at))
    up = jnp.array([0.0, 0.0, 1.0], problem.path.dtype)
    goals = dataclasses.replace(problem.goals, root=_factor(at.scale) * problem.path + given.lift * up)
    return moved, goals, tuned, problem.bounds


@jax.jit
def _planned(at: _Parameters, given: _Given, most: Array) -> Array:
    """As ``retarget`` plans: (F, nq)."""
    return make_plan(*_asked(at, given), given.problem.start, most).q


@jax.jit
def _settled(at: _Parameters, given: _Given, plan: Array, more: int) -> Array:
    """A plan after so many more iterations: (F, nq)."""
    return mend_plan(*_asked(at, given), plan, jnp.ones(len(plan), plan.dtype), more, until="spent").q


@jax.jit
def _value(at: _Parameters, given: _Given, terms: tuple[float, ...], most: Array) -> Float[Array, ""]:
    """The loss of a clip as ``retarget`` plans it."""
    plan = _planned(at, given, most)
    return jnp.dot(jnp.array(terms, plan.dtype), _measured(given, plan))


def _loss(at: _Parameters, given: _Given, terms: tuple[float, ...], plan: Array) -> Float[Array, ""]:
    """The loss of a clip whose plan is at its minimum."""
    q = at_solution(*_asked(at, given), jax.lax.stop_gradient(plan))
    return jnp.dot(jnp.array(terms, q.dtype), _measured(given, q))


_value_and_slope = jax.jit(jax.value_and_grad(_loss))


def _measured(given: _Given, q: Float[Array, "F nq"]) -> Float[Array, "5"]:
    """What ``FitLoss`` weighs, in its order."""
    body, problem, weights, _ = given
    robot, keys, goals = body.robot, len(body.keys), problem.goals
    names = tuple(dict.fromkeys(body.frames))
    index = np.array([names.index(name) for name in body.frames])

    def placed(x: Array) -> tuple[Array, Array]:
        positions, turns = (part[index] for part in forward_kinematics(robot, x).frame_poses(robot, names))
        return positions + rotate(turns, body.offsets), turns[keys : keys + 4]

    points, turns = jax.vmap(placed)(q)
    first, second = (np.array([body.keys.index(limb[i]) for limb in LIMBS]) for i in range(2))
    across = points[:, second] - points[:, first]
    direction = across / jnp.linalg.norm(across, axis=-1, keepdims=True)
    tracking = jnp.sum((direction - goals.directions) ** 2, -1).mean(-1)
    wanted = jnp.stack([goals.pelvis, goals.torso, goals.feet[:, 0], goals.feet[:, 1]], 1) @ body.home
    # |R - W|^2 / 2 = 2 - 2 cos of the angle between R and W: its square, up to the fourth power
    turning = 0.5 * jnp.sum((turns - wanted) ** 2, (-1, -2)).mean(-1)
    soles = points[:, keys + 4 : keys + 12].reshape(len(q), 4, 2, 3).mean(2)
    both = goals.contact[1:] * goals.contact[:-1]
    slip = _weighted_mean(both, jnp.sum((soles[1:] - soles[:-1])[..., :2] ** 2, -1))
    rows = jax.vmap(lambda x, goal: frame_rows(body, x, goal, weights, problem.bounds))(q, goals)
    left = jnp.sum(rows.stiff * rows.residual**2, -1) + jnp.sum(rows.joints.stiff_weight * rows.joints.stiff**2, -1)
    move = jax.vmap(lambda a, b: difference(robot, a, b))(q[:-1], q[1:])[:, scalar_layout(robot)[0]]
    bend = (problem.rate**2 * (move[1:] - move[:-1])) ** 2
    there = goals.present
    means = [_weighted_mean(there, part) for part in (tracking, turning, left)]
    return jnp.stack([*means[:2], slip, means[2], _weighted_mean(there[2:], bend.mean(-1))])


def _weighted_mean(weight: Array, value: Array) -> Float[Array, ""]:
    """0 where nothing has weight."""
    return jnp.sum(weight * value) / jnp.maximum(weight.sum(), 1.0)

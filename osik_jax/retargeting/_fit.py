"""Fit of a profile's scale, keypoints and weights to clips, by the gradient of a loss through the plan."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError, missing_extra, unknown_name
from ..kinematics import difference
from ..robot import Robot
from ..robot._joint_selection import scalar_layout
from ._body import Build
from ._goals import Goals, Weights
from ._lanes import padded
from ._motion import HumanMotion
from ._on_robot import ACCELERATION
from ._plan import at_solution, make_plan, mend_plan
from ._profile import Profile
from ._retarget import Retargeter
from ._terms import Body, Bounds, frame_rows

TUNED = ("pelvis", "torso", "root", "foot", "posture", "smooth", "smooth_base")
"""Names of the tuned weights. The weight of limbs is the unit; the weights of bounds are not a matter of preference."""
_RATE = 0.05
"""Learning rate of Adam: the approximate change of each parameter per step, in its unit."""
_WEIGHT, _SCALE, _PLACE = 1.0, 0.1, 1e-3
"""Parameter units: logarithm of a weight, logarithm of the scale, displacement of a keypoint [m]."""
_MOST_WEIGHT, _MOST_SCALE, _MOST_PLACE = 3.0, 0.1, 0.02
"""Largest absolute change of each parameter, in the same quantities as the units."""
LOSS = {"tracking": 1.0, "turning": 0.01, "slip": 1e4, "bounds": 1e-2, "acceleration": 2e-8}
"""Weights of the loss, a sum of means over a clip's frames; ``fit`` says what they weigh."""
_SETTLING, _FOLLOWING = 150, 40
"""Extra plan iterations after ``retarget``'s stop: before the first step, and in each later step from the plan before.
"""


@dataclasses.dataclass(frozen=True)
class Fit:
    """Result of ``fit``, whose docstring describes the fields."""

    profile: Profile
    step: int
    losses: Float[np.ndarray, " steps"]
    held_out: Float[np.ndarray, " steps"]


class _Parameters(NamedTuple):
    """Parameters of the fit; all zeros is the given profile."""

    weights: Mapping[str, Array]
    scale: Float[Array, ""]
    offsets: Float[Array, "keys 3"]


class _Problem(NamedTuple):
    """One clip as arrays for planning; ``path`` is the hip path before scaling [m]."""

    goals: Goals
    path: Float[Array, "F 3"]
    bounds: Bounds
    start: Float[Array, "F nq"]
    rate: Float[Array, ""]


class _Given(NamedTuple):
    """Inputs of a clip's loss other than the parameters and the plan."""

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
    loss: Mapping[str, float] | None = None,
    acceleration: float | Mapping[str, float] = ACCELERATION,
    steps: int = 20,
    max_iterations: int = 40,
) -> Fit:
    """Tune a profile's scale, keypoints (by up to 2 cm) and weights on some clips.

    The gradient is taken through the plan at its minimum, by one differentiated Gauss-Newton step (implicit function
    theorem). Each plan therefore iterates far beyond ``retarget``'s stop and starts from the plan of the step before,
    so that the loss follows one minimum without jumps. Adam descends the mean of the clips' losses, each relative to
    its first value. The step with the smallest loss on the held-out clips is kept, because few clips are overfitted
    quickly. If no step improves on the given profile, that profile is returned.

    Args:
        robot: as of ``retarget``.
        motions: the training clips.
        held_out: clips that select the best step; if empty, the training clips do.
        profile: the profile to start from. None: as of ``retarget``.
        mapping: as of ``retarget``, the same for all clips.
        loss: weights of some terms of the loss, in place of their defaults.

            - ``tracking`` (1): squared angles between the person's and the robot's limbs [1/rad^2]. The robot's limbs
              connect the keypoints of the given profile, so that tuning keypoints cannot change the measure itself.
            - ``turning`` (0.01): squared orientation errors of pelvis, chest and feet [1/rad^2].
            - ``slip`` (1e4): squared distance that contact points move per frame [1/m^2].
            - ``bounds`` (0.01): the plan's violated bounds, squares with the profile's weights: height of contact
              points, depth in the floor and in other shapes, and excess beyond joint ranges.
            - ``acceleration`` (2e-8): squared joint accelerations [1/(rad/s^2)^2].
        acceleration: as of ``retarget``.
        steps: number of steps of Adam.
        max_iterations: iterations of each plan as ``retarget`` computes it.

    Returns:
        The result.

        - ``profile``: the profile with scale, keypoints and weights of the best step.
        - ``step``: index of the best step; 0 is the given profile.
        - ``losses``: loss of each step relative to step 0, mean over the training clips. (steps + 1,)
        - ``held_out``: the same for the held-out clips; empty without any. (steps + 1,)

    Raises:
        ImportError: optax is not installed (the extra ``tuning``).
        KeyError: ``loss`` names another term.
        ValueError: no clips, no steps; else as of ``retarget``.
    """
    try:
        import optax
    except ImportError as missing:
        raise missing_extra("osik_jax.retargeting.fit", "optax", "tuning") from missing
    if not motions:
        raise OsikValueError("there are no clips to learn from")
    if not steps > 0:
        raise OsikValueError(f"steps is {steps}; it has to be more than 0")
    for term in loss or ():
        if term not in LOSS:
            raise unknown_name("loss term", term, tuple(LOSS))
    own = Retargeter(robot, profile=profile, acceleration=acceleration, max_iterations=max_iterations)
    setting = _Setting(own, LOSS | dict(loss or {}))
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
        scaled = [
            jax.tree.map(lambda leaf, unit=unit: leaf / unit, slope)
            for (_, slope, _), unit in zip(found, learned[0], strict=True)
        ]
        slopes: Any = jax.tree.map(lambda *leaves: sum(leaves) / len(leaves), *scaled)
        if step == steps or not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes)):
            break
        change, state = optimiser.update(slopes, state)
        now = optax.apply_updates(now, change)
    losses, held = _relative(learned), _relative(judged) if others else np.zeros(0)
    best = int(np.nanargmin(held if others else losses))  # the last loss may be NaN
    chosen = own.profile if best == 0 else setting.profile(seen[best])
    return Fit(chosen, best, losses, held)


def _relative(losses: Sequence[Sequence[float]]) -> Float[np.ndarray, " steps"]:
    """Return the mean over clips of each step's loss, relative to each clip's first loss. (steps,)."""
    values = np.array(losses)
    return np.mean(values / values[0], 1)


class _Setting:
    """Robot, profile and loss shared by all clips of a fit."""

    def __init__(self, own: Retargeter, terms: Mapping[str, float]):
        self.own, self.terms = own, tuple(terms.values())
        self.body, self.build, self.weights = own._body, own._build, own.profile.weights

    def origin(self) -> _Parameters:
        """Return the parameters of the given profile."""
        weights = {name: jnp.zeros_like(getattr(self.weights, name)) for name in TUNED}
        return _Parameters(weights, jnp.zeros(()), jnp.zeros((len(self.body.keys), 3)))

    def problems(
        self, motions: Sequence[HumanMotion], held_out: Sequence[HumanMotion], mapping: Mapping[str, str] | None
    ) -> tuple[list[_Problem], list[_Problem]]:
        """Return the clips for training and for selection, padded to one length so that they share a compiled program.

        The hip path is scaled by the profile's scale and counted from ankle height.
        """
        clips = [self.own._read(*self.own._checked_by_name(motion, mapping, None)) for motion in (*motions, *held_out)]
        length = max(len(clip.start) for clip in clips)
        lift = np.array([0.0, 0.0, self.build.ankle])
        found = []
        for clip in clips:
            goals, start = jax.tree.map(jnp.asarray, padded(clip.goals, clip.start, length - len(clip.start)))
            found.append(_Problem(goals, goals.root - lift, clip.bounds, start, jnp.asarray(1.0 / clip.dt)))
        return found[: len(motions)], found[len(motions) :]

    def loss(self, at: _Parameters, problem: _Problem) -> float:
        """Return the loss of a clip as ``retarget`` plans it."""
        most = jnp.asarray(self.own.max_iterations)
        return float(_value(at, self._given(problem), self.terms, most))

    def plan(self, at: _Parameters, problem: _Problem) -> Array:
        """Return a clip's plan close to its minimum. (F, nq)."""
        given = self._given(problem)
        return _settled(at, given, _planned(at, given, jnp.asarray(self.own.max_iterations)), _SETTLING)

    def slope(self, at: _Parameters, problem: _Problem, plan: Array) -> tuple[float, Any, Array]:
        """Return the loss at the minimum near a plan, its gradient, and the plan at that minimum."""
        given = self._given(problem)
        plan = _settled(at, given, plan, _FOLLOWING)
        value, slope = _value_and_slope(at, given, self.terms, plan)
        return float(value), slope, plan

    def _given(self, problem: _Problem) -> _Given:
        return _Given(self.body, problem, self.weights, self.build.ankle)

    def profile(self, at: _Parameters) -> Profile:
        """Return the profile with the tuned values, rounded to four digits."""

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
        # moved keypoints change the measured limb length, which the stretch compensates
        longer = Build.of(self.own.robot, moved).size / self.build.size
        return dataclasses.replace(moved, stretch=round(own.stretch * factor / longer, 4))


def _bounded(parameter: Array, unit: float, most: float) -> Array:
    """Return ``unit * parameter``, limited smoothly to ``most`` in absolute value."""
    return most * jnp.tanh(unit * parameter / most)


def _factor(scale: Float[Array, ""]) -> Float[Array, ""]:
    """Return the factor on the hip path's scale."""
    return jnp.exp(_bounded(scale, _SCALE, _MOST_SCALE))


def _moves(at: _Parameters) -> Float[Array, "keys 3"]:
    """Return the displacement of each keypoint in its frame [m]."""
    return _bounded(at.offsets, _PLACE, _MOST_PLACE)


def _tuned_weights(weights: Weights, at: _Parameters) -> dict[str, Array]:
    """Return the tuned weights by name; each changes by a factor of at most 20 up or down."""
    return {
        name: getattr(weights, name) * jnp.exp(_bounded(change, _WEIGHT, _MOST_WEIGHT))
        for name, change in at.weights.items()
    }


def _asked(at: _Parameters, given: _Given) -> tuple[Body, Goals, Weights, Bounds]:
    """Return the inputs of ``make_plan`` for some parameters."""
    body, problem = given.body, given.problem
    moved = eqx.tree_at(lambda b: b.offsets, body, body.offsets.at[: len(body.keys)].add(_moves(at)))
    tuned = dataclasses.replace(given.weights, **_tuned_weights(given.weights, at))
    up = jnp.array([0.0, 0.0, 1.0], problem.path.dtype)
    goals = dataclasses.replace(problem.goals, root=_factor(at.scale) * problem.path + given.lift * up)
    return moved, goals, tuned, problem.bounds


@jax.jit
def _planned(at: _Parameters, given: _Given, most: Array) -> Array:
    """Return the plan that ``retarget`` computes for some parameters. (F, nq)."""
    return make_plan(*_asked(at, given), given.problem.start, most).q


@jax.jit
def _settled(at: _Parameters, given: _Given, plan: Array, more: int) -> Array:
    """Return a plan after ``more`` further iterations. (F, nq)."""
    return mend_plan(*_asked(at, given), plan, jnp.ones(len(plan), plan.dtype), more, until="spent").q


@jax.jit
def _value(at: _Parameters, given: _Given, terms: tuple[float, ...], most: Array) -> Float[Array, ""]:
    """Return the loss of a clip as ``retarget`` plans it."""
    plan = _planned(at, given, most)
    return jnp.dot(jnp.array(terms, plan.dtype), _measured(given, plan))


def _loss(at: _Parameters, given: _Given, terms: tuple[float, ...], plan: Array) -> Float[Array, ""]:
    """Return the loss of a clip at the minimum near ``plan``; differentiable by the parameters."""
    q = at_solution(*_asked(at, given), jax.lax.stop_gradient(plan))
    return jnp.dot(jnp.array(terms, q.dtype), _measured(given, q))


_value_and_slope = jax.jit(jax.value_and_grad(_loss))


def _measured(given: _Given, q: Float[Array, "F nq"]) -> Float[Array, "5"]:
    """Return the five terms that ``LOSS`` weighs, in its order."""
    body, problem, weights, _ = given
    robot, goals = body.robot, problem.goals
    rows = jax.vmap(lambda x, goal: frame_rows(body, x, goal, weights, problem.bounds))(q, goals)
    # in the order of ``frame_rows``: limbs, the root, turned frames
    limbs, turned = 3 * len(body.limbs), 3 * len(body.turned)
    first = limbs + (3 if body.roots else 0)
    tracking = jnp.sum(rows.residual[:, :limbs] ** 2, -1) / len(body.limbs)
    turning = jnp.sum(rows.residual[:, first : first + turned] ** 2, -1) / max(len(body.turned), 1)
    stance, both = rows.stance.reshape(len(q), 4, 2), goals.contact[1:] * goals.contact[:-1]
    slip = _weighted_mean(both, jnp.sum((stance[1:] - stance[:-1]) ** 2, -1))
    left = jnp.sum(rows.stiff * rows.residual**2, -1) + jnp.sum(rows.joints.stiff_weight * rows.joints.stiff**2, -1)
    move = jax.vmap(lambda a, b: difference(robot, a, b))(q[:-1], q[1:])[:, scalar_layout(robot)[0]]
    bend = (problem.rate**2 * (move[1:] - move[:-1])) ** 2
    there = goals.present
    means = [_weighted_mean(there, part) for part in (tracking, turning, left)]
    return jnp.stack([*means[:2], slip, means[2], _weighted_mean(there[2:], bend.mean(-1))])


def _weighted_mean(weight: Array, value: Array) -> Float[Array, ""]:
    """Return the weighted mean, or 0 if all weights are 0."""
    return jnp.sum(weight * value) / jnp.maximum(weight.sum(), 1.0)

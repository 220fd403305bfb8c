"""A robot's scale, offsets and weights, found by the gradient of a stated loss on a few clips."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._joint_selection import scalar_layout
from ..kinematics import difference, forward_kinematics, integrate
from ..kinematics._rigid import rotate
from ..robot import Robot
from ._banded import solve_banded
from ._body import Build
from ._goals import Goals, Weights
from ._motion import HumanMotion
from ._person import LIMBS
from ._plan import _LEAST_DAMPING, _linearised, make_plan
from ._profile import Profile
from ._retarget import ACCELERATION, Retargeter
from ._terms import Body, Bounds

TUNED = ("pelvis", "torso", "root", "foot", "posture", "smooth", "smooth_base")
"""The weights that are tuned; that of limbs is the unit, and those of bounds are none of taste."""
_RATE, _REACH = 0.03, 0.03
_MOST_WEIGHT, _MOST_SCALE = 3.0, 0.2


@dataclasses.dataclass(frozen=True)
class FitLoss:
    """What is minimised: a sum of means over frames, each with a weight.

    Attributes:
        tracking: of the squared angle between the person's limbs and the robot's [1/rad^2]. The robot's limbs are
            between the places that the profile had before the fit: what is tuned cannot move the measure.
        slip: of the squared distance that standing points move in a frame [1/m^2].
        height: of the squared height of standing points above or below the floor [1/m^2].
        acceleration: of the squared acceleration of the joints [1/(rad/s^2)^2].
    """

    tracking: float = 1.0
    slip: float = 1e4
    height: float = 1e4
    acceleration: float = 1e-7


@dataclasses.dataclass(frozen=True)
class Fit:
    """What came of ``fit``.

    Attributes:
        profile: with the scale, offsets and weights that had the least loss on the training clips.
        losses: on the training clips, of each step. (steps + 1,)
        before: parts of the loss, already weighted, and ``total``, of the given profile; ``train`` and, where there are
            clips for it, ``held_out``.
        after: the same of ``profile``.
    """

    profile: Profile
    losses: Float[np.ndarray, " steps"]
    before: Mapping[str, Mapping[str, float]]
    after: Mapping[str, Mapping[str, float]]


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


def fit(
    robot: Robot,
    motions: Sequence[HumanMotion],
    *,
    profile: Profile | None = None,
    held_out: Sequence[HumanMotion] = (),
    mapping: Mapping[str, str] | None = None,
    loss: FitLoss | None = None,
    acceleration: float | Mapping[str, float] = ACCELERATION,
    steps: int = 20,
    max_iterations: int = 40,
) -> Fit:
    """Tunes a profile's scale, keypoint offsets (by up to 3 cm) and weights on some clips.

    The gradient is that of the plan's solution: where a sum of squares is least, a change of what it depends on moves
    the solution by one step of Gauss and Newton, which is differentiated. Adam goes down it, and the best step is kept.

    Args:
        robot: as of ``retarget``.
        motions: the clips that are learned from.
        profile: where to start. None: as of ``retarget``.
        held_out: clips that have no say; the result tells the loss on them.
        mapping: as of ``retarget``, the same for all.
        loss: None: ``FitLoss()``.
        acceleration: as of ``retarget``.
        steps: of Adam.
        max_iterations: of each plan.

    Raises:
        ImportError: optax is not installed (the extra ``tuning``).
        ValueError: no clips, no steps; else as of ``retarget``.
    """
    try:
        import optax
    except ImportError as missing:
        raise ImportError("osik_jax.retargeting.fit needs optax: pip install 'osik-jax[tuning]'") from missing
    if not motions:
        raise ValueError("there are no clips to learn from")
    if not steps > 0:
        raise ValueError(f"steps is {steps}; it has to be more than 0")
    own = Retargeter(robot, profile=profile, acceleration=acceleration, max_iterations=max_iterations)
    setting = _Setting(own, FitLoss() if loss is None else loss)
    train = [setting.problem(motion, mapping) for motion in motions]
    weights = {name: jnp.zeros_like(getattr(own.profile.weights, name)) for name in TUNED}
    now = _Parameters(weights, jnp.zeros(()), jnp.zeros((len(own.profile.keypoints), 3)))
    optimiser = optax.adam(_RATE)
    state = optimiser.init(now)
    best, losses = now, []
    for step in range(steps + 1):
        found = [setting.slope(now, problem) for problem in train]
        losses.append(float(np.mean([value for value, _ in found])))
        if losses[-1] <= min(losses):
            best = now
        slopes: Any = jax.tree.map(lambda *leaves: sum(leaves) / len(leaves), *(slope for _, slope in found))
        if step == steps or not all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes)):
            break
        change, state = optimiser.update(slopes, state)
        now = optax.apply_updates(now, change)
    found = setting.profile(best)
    sets = {name: clips for name, clips in (("train", motions), ("held_out", held_out)) if clips}
    fitted = Retargeter(robot, profile=found, acceleration=acceleration, max_iterations=max_iterations)
    before, after = (
        {name: setting.parts(retargeter, clips, mapping) for name, clips in sets.items()}
        for retargeter in (own, fitted)
    )
    return Fit(found, np.array(losses), before, after)


class _Setting:
    """What all clips share."""

    def __init__(self, own: Retargeter, loss: FitLoss):
        self.own, self.loss = own, loss
        self.body, self.build, self.weights = own._body, own._build, own.profile.weights

    def problem(self, motion: HumanMotion, mapping: Mapping[str, str] | None) -> _Problem:
        """A clip; its path is that of a person whose legs are as long as the robot's, where no scale is given."""
        clip = self.own._prepared_by_name(motion, mapping, None)
        lift = np.array([0.0, 0.0, self.build.ankle])
        goals, start = jax.tree.map(jnp.asarray, (clip.goals, clip.start))
        return _Problem(goals, goals.root - lift, clip.bounds, start, jnp.asarray(1.0 / clip.dt))

    def slope(self, now: _Parameters, problem: _Problem) -> tuple[Array, Any]:
        """The loss of one clip and its gradient."""
        loss, most = dataclasses.astuple(self.loss), self.own.max_iterations
        (value, _), slope = _value_and_slope(now, self.body, problem, self.weights, self.build.ankle, loss, most)
        return value, slope

    def parts(
        self, retargeter: Retargeter, motions: Sequence[HumanMotion], mapping: Mapping[str, str] | None
    ) -> dict[str, float]:
        """The parts of the loss of finished motions, limits held, means over clips; and their total."""
        found = []
        for motion in motions:
            problem, q = self.problem(motion, mapping), jnp.asarray(retargeter.retarget(motion, mapping=mapping).q)
            q = jnp.concatenate([q, jnp.repeat(q[-1:], len(problem.start) - len(q), 0)])
            found.append(np.array(dataclasses.astuple(self.loss)) * np.asarray(_measured_alone(self.body, q, problem)))
        names = [field.name for field in dataclasses.fields(FitLoss)]
        values = np.mean(found, 0)
        return {**{name: float(v) for name, v in zip(names, values, strict=True)}, "total": float(values.sum())}

    def profile(self, at: _Parameters) -> Profile:
        """The profile with what was tuned, in four digits."""

        def rounded(value: Array) -> Any:
            return np.vectorize(lambda x: float(f"{x:.4g}"))(np.asarray(value, float))

        own = self.own.profile
        weights = {name: rounded(value) for name, value in _tuned_weights(self.weights, at).items()}
        moves = np.round(np.asarray(_REACH * jnp.tanh(at.offsets)), 4)
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


def _factor(scale: Float[Array, ""]) -> Float[Array, ""]:
    """Of the path: at most a fifth more or less."""
    return jnp.exp(_MOST_SCALE * jnp.tanh(scale))


def _tuned_weights(weights: Weights, at: _Parameters) -> dict[str, Array]:
    """Weights by name, at most 20 times what they were or a twentieth."""
    return {
        name: getattr(weights, name) * jnp.exp(_MOST_WEIGHT * jnp.tanh(change / _MOST_WEIGHT))
        for name, change in at.weights.items()
    }


def _loss(
    at: _Parameters,
    body: Body,
    problem: _Problem,
    weights: Weights,
    lift: float,
    terms: tuple[float, ...],
    most: int,
) -> tuple[Array, Array]:
    """The loss of a clip, and its parts."""
    keys = len(body.keys)
    moved = eqx.tree_at(lambda b: b.offsets, body, body.offsets.at[:keys].add(_REACH * jnp.tanh(at.offsets)))
    tuned = dataclasses.replace(weights, **_tuned_weights(weights, at))
    up = jnp.array([0.0, 0.0, 1.0], problem.path.dtype)
    goals = dataclasses.replace(problem.goals, root=_factor(at.scale) * problem.path + lift * up)
    fixed = jax.lax.stop_gradient((moved, goals, tuned, problem.bounds))
    q = jax.lax.stop_gradient(make_plan(*fixed, problem.start, most).q)
    # at the solution a step of Gauss-Newton is 0; its derivative is that of the solution
    full = jnp.ones((), q.dtype)
    here = _linearised(moved, q, goals, tuned, problem.bounds, full)
    system = jax.lax.stop_gradient(here.system)
    damped = system._replace(diagonal=system.diagonal + _LEAST_DAMPING * jnp.eye(body.robot.nv, dtype=q.dtype))
    step = -solve_banded(damped, here.gradient)
    step = step - jax.lax.stop_gradient(step)
    q = jax.vmap(lambda a, b: integrate(body.robot, a, b))(q, step)
    parts = jnp.array(terms, q.dtype) * _measured(body, q, problem)
    return parts.sum(), parts


_value_and_slope = jax.jit(jax.value_and_grad(_loss, has_aux=True))


def _measured(body: Body, q: Float[Array, "F nq"], problem: _Problem) -> Float[Array, "4"]:
    """Tracking, slip, height and acceleration, means of squares."""
    robot, keys, goals = body.robot, len(body.keys), problem.goals
    there = goals.present
    names = tuple(dict.fromkeys(body.frames))
    index = np.array([names.index(name) for name in body.frames])

    def points(x: Array) -> Array:
        positions, rotations = forward_kinematics(robot, x).frame_poses(robot, names)
        return positions[index] + rotate(rotations[index], body.offsets)

    placed = jax.vmap(points)(q)
    first, second = (np.array([body.keys.index(limb[i]) for limb in LIMBS]) for i in range(2))
    across = placed[:, second] - placed[:, first]
    direction = across / jnp.linalg.norm(across, axis=-1, keepdims=True)
    # |d - u|^2 = 2 - 2 cos is the squared angle up to its fourth power
    tracking = jnp.sum((direction - goals.directions) ** 2, -1).mean(-1)
    soles = placed[:, keys + 4 : keys + 12].reshape(len(q), 4, 2, 3).mean(2)
    both = goals.contact[1:] * goals.contact[:-1]
    slip = jnp.sum(both * jnp.sum((soles[1:] - soles[:-1])[..., :2] ** 2, -1)) / jnp.maximum(both.sum(), 1.0)
    stands = goals.contact
    height = jnp.sum(stands * soles[..., 2] ** 2) / jnp.maximum(stands.sum(), 1.0)
    joints = scalar_layout(robot)[0]
    move = jax.vmap(lambda a, b: difference(robot, a, b))(q[:-1], q[1:])[:, joints]
    bend = (move[1:] - move[:-1]) * problem.rate**2 * there[2:, None]
    acceleration = jnp.sum(bend**2) / (jnp.maximum(there[2:].sum(), 1.0) * bend.shape[1])
    return jnp.stack([jnp.sum(there * tracking) / there.sum(), slip, height, acceleration])


_measured_alone = jax.jit(_measured)

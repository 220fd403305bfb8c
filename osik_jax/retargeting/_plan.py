"""The plan: configurations of a whole clip at once, by Gauss-Newton.

What each frame asks for and what ties frames together (standing points that do not move, smooth joints, limits of speed
and acceleration) is one sum of squares over all frames. Limits are met by leading, for every frame knows what comes.
"""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from ..execution._backends import takes
from ..execution._computed import by_kernel
from ..kinematics import difference, integrate
from ..numerics._dense import product
from ..robot._joint_selection import scalar_layout
from . import _plan_kernel
from ._banded import BandedSystem, solve_banded
from ._goals import Goals, Weights
from ._terms import Body, Bounds, frame_rows

_LARGEST_STEP = 0.5
"""Of any dof in an iteration [rad or m]: what the linear model is good for."""

_SOFTEST, _SOFT, _STIFFENING, _SLOWING = 1e-4, 1e-3, 10.0, 0.5
"""Stiffness of the bounds at first, in a part of the frames and in all, its growth, and the share of the cost below
which a step's gain lets it grow."""

_FIXED = 1e15
"""Damping of frames that do not move."""

_FIRST_DAMPING, _LEAST_DAMPING, _STIFF_DAMPING, _MOST_DAMPING = 1e-2, 1e-3, 1.0, 1e8
_CALMER, _CAREFUL = 0.3, 4.0
"""Factors of the damping after a step that was good, and after one that was not; the latter doubles each time.

With bounds at their full stiffness, and after a step that was refused, it is ``_STIFF_DAMPING`` at least: less lets
stretched legs swing from one end of what the bounds leave them to the other.
"""

_LITTLE, _SETTLED = 2e-3, 2
"""A gain that is little, as a share of what the wishes cost, and what makes an end: a step that gains so little counts
as two, a refused one as one. Where bounds are broken by more than that share, a step counts as one and a refused one
not at all: what gains little there may be damped and not done."""

_Ending = Literal["ready", "settled", "mended", "spent"]
_START = {
    "ready": (_SOFTEST, _FIRST_DAMPING, _LITTLE),
    "settled": (_SOFT, _FIRST_DAMPING, _LITTLE),
    "mended": (1.0, _STIFF_DAMPING, 0.1 * _LITTLE),
    "spent": (1.0, _STIFF_DAMPING, _LITTLE),
}
"""What ends iterations but for their number; stiffness and damping with which they begin, and what gain is little: less
in a stream, where the newest frame alone has much to gain."""

_SMOOTHNESS = ("smooth", "smooth_base")
_STRIDE, _COARSE_ITERATIONS = 4, 8
"""The frames that are worked on first, one in so many, and for how long at most."""


class Plan(NamedTuple):
    """A plan.

    Attributes:
        q: configurations. (F, nq)
        cost: what is left of the wishes, and of the bounds that have to hold. (2,)
        iterations: systems solved.
    """

    q: Float[Array, "F nq"]
    cost: Float[Array, "2"]
    iterations: Int[Array, ""]


class _Linearised(NamedTuple):
    """Gauss-Newton's system at some configurations, with its gradient and what each frame costs."""

    system: BandedSystem
    gradient: Float[Array, "F nv"]
    soft: Float[Array, " F"]
    stiff: Float[Array, " F"]

    @property
    def costs(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """What the wishes cost, and the bounds."""
        return self.soft.sum(), self.stiff.sum()


class _Clip(NamedTuple):
    """What a plan is made for; ``free`` is 1 for frames that may move, 0 for those that are past."""

    body: Body
    goals: Goals
    weights: Weights
    bounds: Bounds
    free: Float[Array, " F"]


class _State(NamedTuple):
    """What an iteration leaves to the next."""

    q: Float[Array, "F nq"]
    here: _Linearised
    stiffness: Float[Array, ""]
    ready: Bool[Array, ""]
    damping: Float[Array, ""]
    growth: Float[Array, ""]
    settled: Int[Array, ""]
    iterations: Int[Array, ""]

    @classmethod
    def at(cls, clip: _Clip, q: Float[Array, "F nq"], stiffness: float, damping: Float[Array, ""] | float) -> _State:
        """Before the first iteration."""
        hard, damped, growth = (jnp.asarray(x, q.dtype) for x in (stiffness, damping, _CAREFUL))
        here, none = _linearised(clip, q, hard), jnp.array(0)
        return cls(q, here, hard, jnp.array(False), damped, growth, none, none)


@jax.jit
def make_plan(
    body: Body,
    goals: Goals,
    weights: Weights,
    bounds: Bounds,
    start: Float[Array, "F nq"],
    max_iterations: Int[Array, ""] | int,
) -> Plan:
    """The configurations that serve a clip's goals best, from a first guess.

    Levenberg and Marquardt's method. Bounds that have to hold begin soft and get stiffer with each step that is
    taken, so that limbs find their way before feet and limits pin them down; they do so on a part of the frames first,
    which is a quarter of the work. It ends when a step gains less than a small part of what the wishes cost, with all
    bounds at their full stiffness, or when two are refused where the bounds are kept; where they are not, it takes two
    steps of little gain with no better one between them.
    """
    clip = _Clip(body, goals, weights, bounds, jnp.ones(len(start), start.dtype))
    return _descended(clip, _from_a_part(clip, start), max_iterations, until="settled")


@partial(jax.jit, static_argnames="until")
def mend_plan(
    body: Body,
    goals: Goals,
    weights: Weights,
    bounds: Bounds,
    q: Float[Array, "F nq"],
    free: Float[Array, " F"],
    iterations: Int[Array, ""] | int,
    damping: Float[Array, ""] | float = _STIFF_DAMPING,
    *,
    until: Literal["mended", "spent"] = "mended",
) -> Plan:
    """A plan that is nearly good, made better until steps gain little, with bounds at their full stiffness.

    Args:
        body: the robot.
        goals: of the frames.
        weights: of the goals.
        bounds: of the joints.
        q: the plan. (F, nq)
        free: 1 for frames that may move, 0 for those that are past. (F,)
        iterations: how many, at most.
        damping: with which they begin, at least ``_STIFF_DAMPING``.
        until: "spent" for all iterations, whatever they gain (static).
    """
    return _descended(_Clip(body, goals, weights, bounds, free), q, iterations, damping, until=until)


def at_solution(
    body: Body, goals: Goals, weights: Weights, bounds: Bounds, q: Float[Array, "F nq"]
) -> Float[Array, "F nq"]:
    """A plan as a function of what it was made for: its value is q, its derivative that of the solution.

    At the solution a step of Gauss and Newton is 0, and its derivative, with the system held fixed, is how the solution
    moves, but for second derivatives of residuals that are small (implicit function theorem).
    """
    clip = _Clip(body, goals, weights, bounds, jnp.ones(len(q), q.dtype))
    here = _linearised(clip, q, jnp.ones((), q.dtype))
    system = jax.lax.stop_gradient(here.system)
    step = -solve_banded(system._replace(alone=system.alone + _LEAST_DAMPING), here.gradient)
    return jax.vmap(lambda a, b: integrate(body.robot, a, b))(q, step - jax.lax.stop_gradient(step))


def _from_a_part(clip: _Clip, start: Float[Array, "F nq"]) -> Float[Array, "F nq"]:
    """A better first guess: one frame in four is worked on with soft bounds, and what it moves the others move too.

    Feet are turned as the person's at the weight of limbs here: one that lands on its back has its corners on the floor
    too, and stays so once the bounds are stiff.
    """
    robot, frames = clip.body.robot, len(start)
    if frames <= _STRIDE:  # one frame would be the part
        return start
    part = slice(None, None, _STRIDE)
    wide = dataclasses.replace(
        clip.weights,
        foot=jnp.maximum(clip.weights.foot, clip.weights.limb),
        **{name: getattr(clip.weights, name) / _STRIDE**3 for name in _SMOOTHNESS},
    )
    less = clip._replace(
        goals=jax.tree.map(lambda leaf: leaf[part], clip.goals),
        free=clip.free[part],
        weights=wide,
        bounds=clip.bounds._replace(step=_STRIDE * clip.bounds.step, change=_STRIDE**2 * clip.bounds.change),
    )
    found = _descended(less, start[part], _COARSE_ITERATIONS, until="ready").q
    move = jax.vmap(lambda a, b: difference(robot, a, b))(start[part], found)
    at = np.arange(frames) / _STRIDE
    before = np.minimum(at.astype(int), len(move) - 1)
    share = (at - before)[:, None]
    move = (1.0 - share) * move[before] + share * move[np.minimum(before + 1, len(move) - 1)]
    return jax.vmap(lambda a, b: integrate(robot, a, b))(start, move)


def _descended(
    clip: _Clip,
    q: Float[Array, "F nq"],
    most: Int[Array, ""] | int,
    damping: Float[Array, ""] | float | None = None,
    *,
    until: _Ending,
) -> Plan:
    """Iterations from some configurations on: on CPUs by the compiled core, where it is installed.

    Args:
        clip: what for.
        q: where they begin; with soft bounds and little damping, or stiff and damped for those that are ``mended``.
        most: iterations, at most.
        damping: with which they begin; None: what goes with their ending.
        until: what ends them before: bounds that are ready to get stiffer, or steps that gain little (static).
    """
    descended = _by_kernel if takes("auto", "core", fits=True) else _descended_plain
    damping = _START[until][1] if damping is None else damping
    return descended(clip, q, jnp.asarray(most), jnp.asarray(damping, q.dtype), until=until)


def _descended_plain(
    clip: _Clip,
    q: Float[Array, "F nq"],
    most: Int[Array, ""],
    damping: Float[Array, ""] | float | None = None,
    *,
    until: _Ending,
) -> Plan:
    """The same in plain JAX."""
    stiffness, usual, little = _START[until]

    def goes_on(state: _State) -> Bool[Array, ""]:
        over = state.ready if until == "ready" else (state.settled >= _SETTLED) & (until != "spent")
        return ~over & (state.iterations < most)

    first = _State.at(clip, q, stiffness, usual if damping is None else damping)
    last = jax.lax.while_loop(goes_on, partial(_improved, clip, little=little), first)
    return Plan(last.q, jnp.stack(last.here.costs), last.iterations)


def _descended_by_core(
    clip: _Clip,
    q: Float[Array, "lanes F nq"],
    most: Int[Array, " lanes"],
    damping: Float[Array, " lanes"],
    *,
    until: _Ending,
) -> Plan:
    """The same of a batch, on a CPU and in double precision; what all lanes share has an axis of length 1."""
    endings = float(until == "ready"), float(until in ("settled", "mended"))
    stiffness, _, little = _START[until]
    rules = (_LARGEST_STEP, _STIFFENING, _SLOWING, _FIXED, _LEAST_DAMPING, _STIFF_DAMPING, _MOST_DAMPING, _CALMER)
    rules += (_CAREFUL, little, float(_SETTLED), stiffness)
    return Plan(*_plan_kernel.descended(*clip, q, rules, damping, most, endings))


_by_kernel = by_kernel(_descended_plain, _descended_by_core)


def _improved(clip: _Clip, state: _State, little: float = _LITTLE) -> _State:
    """One system solved, and its step taken if it makes things better."""
    robot, here = clip.body.robot, state.here
    free = clip.free[:, None]
    held = jnp.where(free == 1.0, state.damping, _FIXED)
    damped = here.system._replace(alone=here.system.alone + held)
    move = -free * solve_banded(damped, free * here.gradient)
    longest = jnp.abs(move).max(-1, keepdims=True)
    move = move * jnp.minimum(1.0, _LARGEST_STEP / jnp.maximum(longest, _LARGEST_STEP))
    candidate = jax.vmap(lambda a, b: integrate(robot, a, b))(state.q, move)
    stiffer = jnp.where(state.ready, jnp.minimum(state.stiffness * _STIFFENING, 1.0), state.stiffness)
    there = _linearised(clip, candidate, stiffer)
    (soft, stiff), (soft_there, stiff_there) = here.costs, there.costs
    before, after = soft + state.stiffness * stiff, soft_there + state.stiffness * stiff_there
    better = after < before
    least = jnp.where(~better | (stiffer >= 1.0), _STIFF_DAMPING, _LEAST_DAMPING)
    damping = jnp.clip(state.damping * jnp.where(better, _CALMER, state.growth), least, _MOST_DAMPING)
    growth = jnp.where(better, _CAREFUL, 2.0 * state.growth)
    gains_little, kept = (state.stiffness >= 1.0) & (before - after < little * soft), stiff < little * soft
    counted = better.astype(int) + kept.astype(int)
    settled = jnp.where(gains_little, state.settled + counted, jnp.where(better, 0, state.settled))
    settled = jnp.where(~better & (state.damping >= _MOST_DAMPING), _SETTLED, settled)
    ready = jnp.where(better, before - after < _SLOWING * before, state.ready)
    old, new = (state.q, here, state.stiffness), (candidate, there, stiffer)
    q, here, stiffness = jax.tree.map(lambda a, b: jnp.where(better, b, a), old, new)
    return _State(q, here, stiffness, ready, damping, growth, settled, state.iterations + 1)


def _weights_between(goals: Goals, weights: Weights) -> Float[Array, "F 4"]:
    """Of each frame's standing points, what their motion since the frame before weighs; 0 in the first."""
    both = goals.contact[1:] * goals.contact[:-1]
    return weights.stance * jnp.concatenate([jnp.zeros_like(both[:1]), both])


class _Hinge(NamedTuple):
    """Weight and gradient of what a quantity costs: smooth, and stiff beyond a bound."""

    weight: Float[Array, "F nv"]
    gradient: Float[Array, "F nv"]
    soft: Float[Array, " F"]
    stiff: Float[Array, " F"]


def _hinge(
    value: Float[Array, "F nv"],
    bound: Float[Array, " nv"],
    smooth: Float[Array, "F nv"] | Float[Array, " nv"],
    limit: Float[Array, ""],
    stiffness: Float[Array, ""],
) -> _Hinge:
    """What is beyond a bound counts as a share of it: limits are kept as well at any rate of frames."""
    over = value - jnp.clip(value, -bound, bound)
    beyond = jnp.where(over != 0.0, limit / bound**2, 0.0)
    pull = smooth * value + stiffness * beyond * over
    return _Hinge(smooth + stiffness * beyond, pull, _halves(smooth, value), _halves(beyond, over))


def _halves(weight: Float[Array, "F n"] | Float[Array, " n"], residual: Float[Array, "F n"]) -> Float[Array, " F"]:
    """Of each frame, half the weighted sum of squares."""
    return 0.5 * jnp.sum(weight * residual**2, -1)


def _between(body: Body, q, goals: Goals, weights: Weights, bounds: Bounds, stiffness):
    """Steps from frame to frame, and their changes."""
    robot = body.robot
    joints = scalar_layout(robot)[0]
    smooth = jnp.where(joints, weights.smooth, weights.smooth_base)
    step = jax.vmap(lambda a, b: difference(robot, a, b))(q[:-1], q[1:])
    there = goals.present[1:, None]
    steps = _hinge(step * there, bounds.step, 0.0 * smooth, weights.speed, stiffness)
    there = goals.present[2:, None]
    changes = _hinge((step[1:] - step[:-1]) * there, bounds.change, smooth * there, weights.speed, stiffness)
    return steps, changes


def _linearised(clip: _Clip, q: Float[Array, "F nq"], stiffness: Float[Array, ""]) -> _Linearised:
    body, goals, weights, bounds, _ = clip
    rows = jax.vmap(lambda x, g: frame_rows(body, x, g, weights, bounds))(q, goals)
    there, own = goals.present[:, None], rows.joints
    weight = there * (rows.soft + stiffness * rows.stiff)
    # standing points do not move from one frame to the next: p_t - p_t-1, with derivatives in both frames
    point, moving = rows.stance, rows.stance_jacobian
    move = point - jnp.roll(point, 1, 0)
    held = jnp.repeat(_weights_between(goals, weights), 2, axis=-1)
    soft = _halves(there * rows.soft, rows.residual) + _halves(there * own.soft_weight, own.soft)
    stiff = _halves(there * rows.stiff, rows.residual) + _halves(there * own.stiff_weight, own.stiff)
    stiff += _halves(held, move)
    held = stiffness * held
    jacobian = jnp.concatenate([rows.jacobian, moving], 1)
    square = jnp.concatenate([weight, held + jnp.roll(held, -1, 0)], 1)
    pull = jnp.concatenate([weight * rows.residual, held * move - jnp.roll(held * move, -1, 0)], 1)
    # one product for both: on a GPU, sums over rows take as long as all of it
    weighted = jnp.concatenate([jacobian * square[..., None], pull[..., None]], -1)
    both = product(jnp.swapaxes(jacobian, 1, 2), weighted)
    blocks, gradient = both[..., :-1], both[..., -1]
    gradient += there * (own.soft_weight * own.soft + stiffness * own.stiff_weight * own.stiff)
    alone = there * (own.soft_weight + stiffness * own.stiff_weight)
    none = jnp.zeros_like(gradient)
    here = _Linearised(BandedSystem(blocks, alone, moving, held, none, none), gradient, soft, stiff)
    return _with_steps(here, *_between(body, q, goals, weights, bounds, stiffness))


def _with_steps(here: _Linearised, steps: _Hinge, changes: _Hinge) -> _Linearised:
    """With what the dofs' speeds and accelerations cost.

    ``step_t = q_t+1 - q_t`` has derivatives (-1, 1), ``change_t = q_t+2 - 2 q_t+1 + q_t`` has (1, -2, 1).
    """
    w, c = steps.weight, changes.weight
    main = here.system.alone.at[:-1].add(w).at[1:].add(w)
    main = main.at[:-2].add(c).at[1:-1].add(4.0 * c).at[2:].add(c)
    near = jnp.zeros_like(main).at[1:].add(-w).at[1:-1].add(-2.0 * c).at[2:].add(-2.0 * c)
    far = here.system.second.at[2:].add(c)
    g, a = steps.gradient, changes.gradient
    gradient = here.gradient.at[:-1].add(-g).at[1:].add(g)
    gradient = gradient.at[:-2].add(a).at[1:-1].add(-2.0 * a).at[2:].add(a)
    system = here.system._replace(alone=main, first=near, second=far)
    soft, stiff = (
        own.at[1:].add(step).at[2:].add(change)
        for own, step, change in ((here.soft, steps.soft, changes.soft), (here.stiff, steps.stiff, changes.stiff))
    )
    return _Linearised(system, gradient, soft, stiff)

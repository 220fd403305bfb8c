"""Plan of a whole clip at once, by a damped Gauss-Newton method.

Goals of each frame and terms between frames (contacts that do not move, smoothness, limits of speed and acceleration)
form one sum of squares over all frames. The plan can meet a limit by moving early, because each frame depends on the
later ones.
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
from ..kinematics._kernels import Call
from ..numerics._dense import product
from ..robot._joint_selection import scalar_layout
from . import _plan_kernel
from ._banded import BandedSystem, solve_banded
from ._goals import Goals, Weights
from ._terms import Body, Bounds, frame_rows

_LARGEST_STEP = 0.5
"""Largest change of a dof in one iteration [rad or m]; the linear model is not accurate beyond it."""

_SOFTEST, _SOFT, _STIFFENING, _SLOWING = 1e-4, 1e-3, 10.0, 0.5
"""Initial stiffness of the bounds (on a part of the frames, and on all), the factor by which it grows, and the relative
gain of a step below which it grows.
"""

_FIXED = 1e15
"""Damping of frames that must not move."""

_FIRST_DAMPING, _LEAST_DAMPING, _STIFF_DAMPING, _MOST_DAMPING = 1e-2, 1e-3, 1.0, 1e8
_CALMER, _CAREFUL = 0.3, 4.0
"""Factors on the damping after an accepted and after a refused step; the second doubles with each refusal.

With bounds at full stiffness, and after a refused step, the damping is at least ``_STIFF_DAMPING``. With less,
stretched legs swing between the ends of their bounds.
"""

_LITTLE, _SETTLED = 2e-3, 2
"""Relative gain below which a step counts as small, and the count that ends the iterations. A small step counts two, a
refused step one. While bounds are violated by more than that share, a small step counts one and a refused step
nothing, because a small gain may come from damping.
"""

_Ending = Literal["ready", "settled", "mended"]
_START = {
    "ready": (_SOFTEST, _FIRST_DAMPING, _LITTLE),
    "settled": (_SOFT, _FIRST_DAMPING, _LITTLE),
    "mended": (1.0, _STIFF_DAMPING, 0.1 * _LITTLE),
}
"""Per ending: initial stiffness, initial damping, and relative gain that counts as small. A stream uses a smaller gain,
because only its newest frame has much to gain.
"""

_SMOOTHNESS = ("smooth", "smooth_base")
_STRIDE, _COARSE_ITERATIONS = 4, 8
"""Stride of the frames that are solved first, and the largest number of iterations on them."""


class Plan(NamedTuple):
    """Plan of a clip."""

    q: Float[Array, "F nq"]  # configurations
    cost: Float[Array, "2"]  # final cost of the goals, and of the violated bounds
    iterations: Int[Array, ""]  # number of systems solved


class _Linearised(NamedTuple):
    """Gauss-Newton system at some configurations, with gradient and cost of each frame."""

    system: BandedSystem
    gradient: Float[Array, "F nv"]
    soft: Float[Array, " F"]
    stiff: Float[Array, " F"]

    @property
    def costs(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Return the cost of the goals and the cost of the violated bounds."""
        return self.soft.sum(), self.stiff.sum()


class _Clip(NamedTuple):
    """Inputs of a plan; ``free`` is 1 for frames that may move, 0 for past frames."""

    body: Body
    goals: Goals
    weights: Weights
    bounds: Bounds
    free: Float[Array, " F"]


class _State(NamedTuple):
    """State passed from one iteration to the next."""

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
        """Return the state before the first iteration."""
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
    """Return the configurations that minimise a clip's cost, starting from a first guess.

    Levenberg-Marquardt iterations. The bounds start soft and get stiffer with each accepted step, so that limbs take
    their posture before contacts and limits fix them. This is done first on every fourth frame, at a quarter of the
    cost. With all bounds stiff, the iterations end after a step of little gain or two refused steps; while bounds are
    violated, after two consecutive steps of little gain.
    """
    clip = _Clip(body, goals, weights, bounds, jnp.ones(len(start), start.dtype))
    return _descended(clip, _from_a_part(clip, start), max_iterations, until="settled")


@jax.jit
def mend_plan(
    body: Body,
    goals: Goals,
    weights: Weights,
    bounds: Bounds,
    q: Float[Array, "F nq"],
    free: Float[Array, " F"],
    iterations: Int[Array, ""] | int,
    damping: Float[Array, ""] | float,
) -> Plan:
    """Improve a nearly optimal plan until steps gain little, with bounds at full stiffness.

    Frames where ``free`` is 0 are past and do not move. ``damping`` is at least ``_STIFF_DAMPING``.
    """
    return _descended(_Clip(body, goals, weights, bounds, free), q, iterations, damping, until="mended")


def _from_a_part(clip: _Clip, start: Float[Array, "F nq"]) -> Float[Array, "F nq"]:
    """Return a better first guess: solve every fourth frame with soft bounds and interpolate its changes. (F, nq).

    Foot orientations have the weight of limbs here. Otherwise a foot may land upside down with its corners on the
    floor, and stay so once the bounds are stiff.
    """
    robot, frames = clip.body.robot, len(start)
    if frames <= _STRIDE:  # the coarse problem would have a single frame
        return start
    part = slice(None, None, _STRIDE)
    wide = dataclasses.replace(
        clip.weights,
        foot=jnp.maximum(clip.weights.foot, clip.weights.limb),
        # second differences over 4 frames are 4^2 as large, squared 4^4; a quarter as many of them are summed
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
    """Run the iterations of a plan: in the compiled core on CPUs if installed, else in plain JAX.

    ``until`` says what ends them early: bounds ready to get stiffer, or steps of little gain. Without a damping it is
    that of ``_START[until]``.
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
    """Run the iterations of a plan in plain JAX."""
    stiffness, usual, little = _START[until]

    def goes_on(state: _State) -> Bool[Array, ""]:
        over = state.ready if until == "ready" else state.settled >= _SETTLED
        return ~over & (state.iterations < most)

    first = _State.at(clip, q, stiffness, usual if damping is None else damping)
    last = jax.lax.while_loop(goes_on, partial(_improved, clip, little=little), first)
    return Plan(last.q, jnp.stack(last.here.costs), last.iterations)


def _descended_by_core(
    call: Call,
    clip: _Clip,
    q: Float[Array, "#lanes F nq"],
    most: Int[Array, " #lanes"],
    damping: Float[Array, " #lanes"],
    *,
    until: _Ending,
) -> Plan:
    """Run the iterations of a batch of plans in the core, on a CPU in double precision.

    Arrays that all lanes share have an axis of length 1.
    """
    endings = float(until == "ready"), float(until != "ready")
    stiffness, _, little = _START[until]
    rules = (_LARGEST_STEP, _STIFFENING, _SLOWING, _FIXED, _LEAST_DAMPING, _STIFF_DAMPING, _MOST_DAMPING, _CALMER)
    rules += (_CAREFUL, little, float(_SETTLED), stiffness)
    return Plan(*_plan_kernel.descended(call, clip, q, rules, damping, most, endings))


_by_kernel = by_kernel(_descended_plain, _descended_by_core, on_gpu=False)


def _improved(clip: _Clip, state: _State, little: float = _LITTLE) -> _State:
    """Solve one damped system and take its step if it reduces the cost."""
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


class _Hinge(NamedTuple):
    """Weight, gradient and cost of a quantity with a quadratic cost and a stiff penalty beyond a bound."""

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
    """Return the cost terms of a quantity.

    The excess counts relative to its bound, which makes it independent of the rate.
    """
    over = value - jnp.clip(value, -bound, bound)
    beyond = jnp.where(over != 0.0, limit / bound**2, 0.0)
    pull = smooth * value + stiffness * beyond * over
    return _Hinge(smooth + stiffness * beyond, pull, _halves(smooth, value), _halves(beyond, over))


def _halves(weight: Float[Array, "F n"] | Float[Array, " n"], residual: Float[Array, "F n"]) -> Float[Array, " F"]:
    """Return half the weighted sum of squares of each frame. (F,)."""
    return 0.5 * jnp.sum(weight * residual**2, -1)


def _between(body: Body, q, goals: Goals, weights: Weights, bounds: Bounds, stiffness):
    """Return the cost terms of the steps between frames and of the changes of these steps."""
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
    both = jnp.concatenate([jnp.zeros_like(goals.contact[:1]), goals.contact[1:] * goals.contact[:-1]])
    held = jnp.repeat((0.0 if body.rolls else weights.stance) * both, 2, axis=-1)
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
    """Add the cost terms of the dofs' speeds and accelerations to the system.

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

"""Derivatives of a function of many cases at once, against central differences of its own values."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree

_STEPS = (2e-4, 1e-4, 5e-5)
_SETTLED = 1e-7
"""Extrapolations that differ by less than this share have no kink and no pole nearby, and are that exact."""
_NOTHING = 1e-13
"""A step over which a derivative changes by its rounding alone, which is much where a problem is near to singular."""


class Checked(NamedTuple):
    """One number a case."""

    forward_error: np.ndarray  # of the jvp, relative to the difference quotient (2-norms of the whole answer)
    duality_error: np.ndarray  # between <c, jvp> and <vjp(c), direction>, relative to |c| |jvp|
    rounding: np.ndarray  # of the jvp, relative to it: what a change of the case of one rounding makes of it
    smooth: np.ndarray  # whether the quotient is one
    size: np.ndarray  # 2-norm of the derivative
    finite: np.ndarray  # both modes
    label: np.ndarray  # the integers of the function


def check(function: Callable[[Any], Any], path: Callable[[Any, Any], Any], cases: Any) -> Checked:
    """Compares both modes with central differences, all cases in one compiled program.

    Args:
        function: from a pytree of floats to a pair: a pytree of floats, and integers that have to be constant over the
            differences (a status, an active set).
        path: from a case and t to what ``function`` takes: a curve, smooth in t; the derivative is along it at t = 0.
        cases: pytree with a leading axis.
    """
    run = jax.jit(jax.vmap(lambda case, key: _one(function, path, case, key)))
    keys = jax.random.split(jax.random.key(7), jax.tree.leaves(cases)[0].shape[0])
    return Checked(*(np.asarray(a) for a in run(cases, keys)))


def _one(function: Callable, path: Callable, case: Any, key: Any) -> tuple:
    def flat(point):
        floats, integers = function(point)
        return ravel_pytree(floats)[0], ravel_pytree(integers)[0]

    def change(t):
        point, direction = jax.jvp(lambda t: path(case, t), (t,), (1.0,))
        return point, direction, *jax.jvp(flat, (point,), (direction,), has_aux=True)[1:]

    both = jax.vmap(change)(jnp.array([0.0, _NOTHING]))
    point, direction, forward, label = jax.tree.map(lambda a: a[0], both)
    nearby = both[2][1]
    cotangent = jax.random.normal(key, forward.shape)
    (pulled,) = jax.vjp(flat, point, has_aux=True)[1](cotangent)
    backward = sum(jnp.vdot(a, b) for a, b in zip(jax.tree.leaves(pulled), jax.tree.leaves(direction), strict=True))
    steps = jnp.array([sign * h for h in _STEPS for sign in (1.0, -1.0)])
    values, labels = jax.vmap(lambda t: flat(path(case, t)))(steps)
    coarse, middle, fine = ((values[2 * k] - values[2 * k + 1]) / (2.0 * h) for k, h in enumerate(_STEPS))
    rough, good = (4.0 * middle - coarse) / 3.0, (4.0 * fine - middle) / 3.0
    expected = (16.0 * good - rough) / 15.0
    size = jnp.linalg.norm(expected)
    leaves = [*jax.tree.leaves(pulled), forward]
    return (
        jnp.linalg.norm(forward - expected) / size,
        jnp.abs(backward - cotangent @ forward) / (jnp.linalg.norm(cotangent) * jnp.linalg.norm(forward)),
        jnp.linalg.norm(nearby - forward) / jnp.linalg.norm(forward),
        (jnp.linalg.norm(expected - good) <= _SETTLED * size) & jnp.all(labels == label),
        size,
        jnp.stack([jnp.isfinite(a).all() for a in leaves]).all(),
        label,
    )


def nearest_side(
    function: Callable[[Any], Any], path: Callable[[Any, Any], Any], cases: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Where the two one-sided derivatives differ: of the jvp, the relative distance to each, and where both settled."""

    def one(case):
        def value(t):
            return ravel_pytree(function(path(case, t)))[0]

        forward = jax.jvp(value, (0.0,), (1.0,))[1]
        steps = jnp.array([[0.0, *(sign * h for h in _STEPS)] for sign in (1.0, -1.0)])
        errors, settled = [], []
        for values, t in zip(jax.vmap(jax.vmap(value))(steps), steps, strict=True):
            coarse, middle, fine = (values[1:] - values[0]) / t[1:, None]
            rough, good = 2.0 * middle - coarse, 2.0 * fine - middle
            expected = (4.0 * good - rough) / 3.0
            size = jnp.linalg.norm(expected)
            errors.append(jnp.linalg.norm(forward - expected) / size)
            settled.append(jnp.linalg.norm(expected - good) <= 10.0 * _SETTLED * size)
        return jnp.stack(errors), jnp.stack(settled).all()

    errors, settled = jax.jit(jax.vmap(one))(cases)
    return np.asarray(errors), np.asarray(settled)


def assert_exact(checked: Checked, *, most: float, forward: float = 1e-6, duality: float = 1e-9) -> None:
    """Every smooth case within tolerance, at least a share ``most`` of them smooth, every derivative finite.

    The modes agree within the tolerance, or ten times the rounding of one of them where that is more.
    """
    assert checked.finite.all(), f"not finite: {np.flatnonzero(~checked.finite)[:10]}"
    assert checked.smooth.mean() >= most, f"{checked.smooth.mean():.3f} of the cases are smooth"
    off = np.flatnonzero(checked.smooth & ~(checked.forward_error <= forward))
    assert len(off) == 0, f"{len(off)} cases are off by up to {checked.forward_error[off].max():.1e}: {off[:10]}"
    apart = np.flatnonzero(~(checked.duality_error <= np.maximum(duality, 10.0 * checked.rounding)))
    assert len(apart) == 0, f"the modes differ by {checked.duality_error[apart].max():.1e} in cases {apart[:10]}"


def assert_hessian(loss: Callable[[Any], Any], x: Any, condition: Callable[[Any], Any]) -> None:
    """Forward over reverse against central differences of the gradient; symmetric.

    Args:
        loss: from x (n,) to a pair: a number, and the active set, which has to be the same at all points.
        x: the point.
        condition: of an active set; has to hold at x.
    """
    hessian = np.asarray(jax.jit(jax.hessian(lambda x: loss(x)[0]))(x))
    gradient = jax.jit(jax.vmap(jax.grad(loss, has_aux=True)))
    h = 1e-4 * np.eye(len(x))
    slopes, active = gradient(np.concatenate([x + h, x - h, x + 2 * h, x - 2 * h]))
    assert all((a == a[0]).all() for a in map(np.asarray, jax.tree.leaves(active)))
    assert condition(jax.tree.map(lambda a: np.asarray(a)[0], active))
    one, back, two, far = np.split(np.asarray(slopes), 4)
    expected = (8.0 * (one - back) - (two - far)) / 12e-4
    assert np.abs(hessian - expected).max() < 1e-6 * np.abs(expected).max()
    assert np.abs(hessian - hessian.T).max() < 1e-9 * np.abs(hessian).max()

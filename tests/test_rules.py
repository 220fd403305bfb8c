"""Functions with rules of their own: derivatives at any depth, batches of any length and nesting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from osik_jax._rules import blocked, custom_jvp

X = np.linspace(-1.0, 1.0, 23 * 3 * 2).reshape(23, 3, 2)


def plain(x, y):
    return {"wave": jnp.sin(x) * y.sum(), "count": jnp.sum(x > y).astype(jnp.int32)}


piecewise = blocked(4)(plain)


@pytest.mark.parametrize("lanes", [1, 4, 5, 8, 23])
def test_a_batch_in_blocks_is_the_batch(lanes):
    x, y = X[:lanes, 0], X[:lanes, 1]
    ours, plainly = (jax.jit(jax.vmap(f))(x, y) for f in (piecewise, plain))
    np.testing.assert_array_equal(ours["wave"], plainly["wave"])
    np.testing.assert_array_equal(ours["count"], plainly["count"])


def test_blocks_are_what_runs():
    """Nine lanes by four are three runs of the body, of four lanes each."""
    program = str(jax.make_jaxpr(jax.vmap(piecewise))(X[:9, 0], X[:9, 1]))
    assert "length=3" in program
    assert "f64[4,2]" in program
    assert "length" not in str(jax.make_jaxpr(jax.vmap(piecewise))(X[:4, 0], X[:4, 1]))


@pytest.mark.parametrize("axes", [(0, None), (None, 0), (2, 0), (1, 1)])
def test_lanes_along_any_axis(axes):
    x = np.moveaxis(X[:9, :2, 0], 0, axes[0]) if axes[0] in (0, 1) else np.ones((2, 2, 9)) * np.arange(9.0)
    y = np.moveaxis(X[:9, :2, 1], 0, axes[1]) if axes[1] is not None else X[0, :2, 1]
    x = X[0, :2, 0] if axes[0] is None else x
    ours, plainly = (jax.vmap(f, in_axes=axes)(x, y)["wave"] for f in (piecewise, plain))
    np.testing.assert_array_equal(ours, plainly)


def test_batches_of_batches():
    x, y = X[:, :, 0], X[:, :, 1]
    ours, plainly = (jax.jit(jax.vmap(jax.vmap(f)))(x, y)["wave"] for f in (piecewise, plain))
    np.testing.assert_array_equal(ours, plainly)


def test_derivatives_of_a_batch_in_blocks():
    def total(f):
        return lambda x, y: jnp.sum(jax.vmap(f)(x, y)["wave"] ** 2)

    at = X[:9, 0], X[:9, 1]
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        ours, plainly = (jax.jit(derivative(total(f), argnums=1))(*at) for f in (piecewise, plain))
        np.testing.assert_allclose(ours, plainly, rtol=1e-13)


def test_a_rule_holds_in_a_loop_to_second_order():
    """The rule is deliberately wrong by a factor, so that it shows whether it is used."""

    @custom_jvp
    def cube(x):
        return x**3

    @cube.defjvp
    def _(primals, rates):
        (x,), (rate,) = primals, rates
        return cube(x), 6.0 * x**2 * rate

    def chain(x):
        return jax.lax.scan(lambda carry, _: (cube(carry) + x, None), x, None, length=1)[0]

    assert jax.grad(chain)(2.0) == pytest.approx(25.0)
    assert jax.grad(jax.grad(chain))(2.0) == pytest.approx(24.0)

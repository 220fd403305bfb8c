"""Functions with rules of their own: derivatives at any depth, batches of any length and nesting."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from osik_jax.execution._rules import blocked, by_platform, custom_jvp, when_lowered

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


@custom_jvp
def cube(x):
    """Its rule is wrong by a factor of 2 on purpose, so that it shows where the rule is used."""
    return x**3


@cube.defjvp
def _(primals, rates):
    (x,), (rate,) = primals, rates
    return cube(x), 6.0 * x**2 * rate


def chain(x):
    """Two steps, for only from the second one on does a result of the first go into what is differentiated twice."""
    return jax.lax.scan(lambda carry, _: (cube(carry) + x, None), x, None, length=2)[0]


def chain_with_checkpoints(x):
    step = jax.checkpoint(lambda carry, _: (cube(carry) + x, None))
    return jax.lax.scan(step, x, None, length=2)[0]


LOOPS = {
    "unrolled": lambda x: cube(cube(x) + x) + x,
    "scan": chain,
    "jit": jax.jit(chain),
    "checkpoint": jax.checkpoint(chain),
    "checkpoints": chain_with_checkpoints,
    "vmap": lambda x: jax.vmap(chain)(jnp.stack([x, 2.0 * x]))[0],
    "cond": lambda x: jax.lax.cond(x > 0.0, chain, lambda x: x, x),
}
SECOND = {
    "reverse over forward": lambda f: jax.grad(lambda x: jax.jvp(f, (x,), (1.0,))[1]),
    "forward over reverse": lambda f: lambda x: jax.jvp(jax.grad(f), (x,), (1.0,))[1],
    "forward over forward": lambda f: lambda x: jax.jvp(lambda y: jax.jvp(f, (y,), (1.0,))[1], (x,), (1.0,))[1],
    "reverse over reverse": lambda f: jax.grad(jax.grad(f)),
}


@pytest.mark.parametrize("loop", LOOPS)
def test_a_rule_holds_in_a_loop_to_second_order(loop):
    """Against the chain rule written out, with the cube's derivative replaced by 6 x^2."""
    x, f = 1.1, LOOPS[loop]
    y = x**3 + x
    dy, ddy = 6 * x**2 + 1, 12 * x
    assert float(f(x)) == pytest.approx(y**3 + x, rel=1e-12)
    first = 6 * y**2 * dy + 1
    assert float(jax.grad(f)(x)) == pytest.approx(first, rel=1e-12)
    assert float(jax.jvp(f, (x,), (1.0,))[1]) == pytest.approx(first, rel=1e-12)
    for name, derivative in SECOND.items():
        assert float(derivative(f)(x)) == pytest.approx(12 * y * dy**2 + 6 * y**2 * ddy, rel=1e-12), name


def stepwise(gains, x):
    """A body with operations of jax that have rules of their own, and some that jax 0.12 expands when it compiles."""
    index = jnp.searchsorted(jnp.asarray([0.0, 1.0]), x)
    (first,) = jnp.nonzero(jnp.arange(3) == index, size=1)
    return gains[first[0]] * jax.nn.relu(x) + cube(x)


piecewise_gain = custom_jvp(stepwise)
piecewise_gain.defjvp(lambda primals, rates: jax.jvp(stepwise, primals, rates))
GAINS = jnp.asarray([2.0, 3.0, 5.0])
SLOPES = {-0.5: 0.0, 0.7: 3.0, 1.5: 5.0}


@pytest.mark.parametrize("transformed", [lambda f: f, jax.jit])
def test_a_body_may_have_rules_of_jax(transformed):
    for x, slope in SLOPES.items():
        value, (by_gains, by_x) = transformed(jax.value_and_grad(piecewise_gain, argnums=(0, 1)))(GAINS, x)
        assert float(value) == pytest.approx(slope * x + x**3, rel=1e-12)
        np.testing.assert_array_equal(by_gains, np.where(slope == GAINS, x, 0.0))
        assert float(by_x) == pytest.approx(slope + 6 * x**2, rel=1e-12)


@pytest.mark.parametrize("transformed", [lambda f: f, jax.jit])
def test_such_a_body_in_a_batch_and_in_a_loop(transformed):
    x, slopes = np.array(list(SLOPES)), np.array(list(SLOPES.values()))
    wide = jax.vmap(piecewise_gain, in_axes=(None, 0))
    np.testing.assert_allclose(transformed(wide)(GAINS, x), slopes * x + x**3, rtol=1e-12)

    def in_turn(x):
        return jax.lax.map(jax.checkpoint(lambda x: piecewise_gain(GAINS, x)), x)

    np.testing.assert_allclose(transformed(in_turn)(x), slopes * x + x**3, rtol=1e-12)
    rates = transformed(jax.jacrev(in_turn))(x)
    np.testing.assert_allclose(rates, np.diag(slopes + 6 * x**2), rtol=1e-12)


def test_linear_maps_of_a_rule_are_each_others_transposes():
    _, forward = jax.linearize(piecewise_gain, GAINS, 0.7)
    _, backward = jax.vjp(piecewise_gain, GAINS, 0.7)
    row = [forward(gains, rate) for gains, rate in zip(np.eye(4, 3), np.eye(4)[3], strict=True)]
    np.testing.assert_allclose(row, [0.0, 0.7, 0.0, 3.0 + 6 * 0.7**2], rtol=1e-12)
    np.testing.assert_allclose(jnp.append(*backward(1.0)), row, rtol=1e-12)


def test_shapes_are_known_without_running():
    out = jax.eval_shape(jax.vmap(piecewise), X[:9, 0], X[:9, 1])
    assert (out["wave"].shape, out["wave"].dtype) == ((9, 2), jnp.float64)
    assert (out["count"].shape, out["count"].dtype) == ((9,), jnp.int32)
    assert jax.eval_shape(jax.hessian(chain), 1.0).shape == ()


@custom_jvp
def scaled(x, *, by):
    return by * jnp.sin(x)


@scaled.defjvp
def _scaled_jvp(primals, tangents, *, by):
    return scaled(*primals, by=by), by * jnp.cos(primals[0]) * tangents[0]


def test_what_is_given_by_keyword_is_static():
    ours, plainly = (
        jax.vmap(jax.jit(jax.grad(jax.grad(f))))(X[:, 0, 0])
        for f in (lambda x: scaled(x, by=3.0), lambda x: 3.0 * jnp.sin(x))
    )
    np.testing.assert_allclose(ours, plainly, rtol=1e-14)


def test_what_is_for_other_platforms_is_traced_only_for_them():
    traced = []

    def otherwise(x):
        traced.append(x.dtype)
        return jnp.cos(x)

    def function(x):
        return by_platform({"cpu": jnp.sin}, otherwise, x)

    x = X[:, 0, 0]
    for way in (function, jax.jit(function), jax.jit(jax.vmap(function))):
        np.testing.assert_array_equal(way(x), jnp.sin(x))
    programs = [jax.jit(way).trace(x) for way in (function, jax.vmap(function))]
    assert traced == []
    with jax.enable_x64(False):
        texts = [program.lower(lowering_platforms=("cuda",)).as_text() for program in programs]
    assert traced == [np.float64] * 2
    assert all("stablehlo.cosine" in text and "sine %" not in text.replace("cosine", "") for text in texts)


def test_what_is_traced_when_it_is_lowered_is_traced_once():
    traced = []

    def function(x):
        traced.append(x.shape)
        return {"sine": jnp.sin(x)}

    def shifted(x):
        return 2.0 * when_lowered(function, {"sine": x}, x)["sine"]

    x = X[:, 0, 0]
    for way in (shifted, jax.jit(shifted), jax.jit(jax.vmap(shifted)), lambda x: jax.lax.map(shifted, x)):
        np.testing.assert_array_equal(way(x), 2.0 * jnp.sin(x))
    assert traced == [x.shape, x.shape, (), ()]
    assert jax.eval_shape(jax.vmap(shifted), x).shape == x.shape and len(traced) == 4
    with pytest.raises(TypeError, match="a function traced late returns"):
        jax.jit(lambda x: when_lowered(lambda x: x[0], x, x))(x)

"""The CUDA kernels on a CPU, thread by thread: certified answers, no races, and nothing left to XLA."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from emulated_warp import emulated, needs_compiler
from hierarchy_families import SMALL
from lexicographic import certificate
from recorded import QP_DAMPING, recorded_hierarchies, recorded_qps

from osik_jax.execution import _backends
from osik_jax.solvers import Level, Status, solve_hqp, solve_least_squares_qp
from osik_jax.solvers.hqp import _dispatch as hqp_dispatch
from osik_jax.solvers.hqp import _warp as hqp_kernel
from osik_jax.solvers.qp import _dispatch as qp_dispatch
from osik_jax.solvers.qp import _warp as qp_kernel

pytestmark = [needs_compiler, pytest.mark.slow]
COUNT = 16


def nothing_for_the_rest(end, done, again, block):
    """What a kernel leaves over is lost: numbers that are NaN."""

    def spoiled(a):
        missing = jnp.nan if jnp.issubdtype(a.dtype, jnp.floating) else a
        return jnp.where(done.reshape(-1, *[1] * (a.ndim - 1)), a, missing)

    return jax.tree.map(spoiled, end)


@pytest.fixture(scope="module", params=["forwards", "backwards"])
def on_emulated_gpu(request, tmp_path_factory):
    """Programs for CUDA run here, with the kernels emulated."""

    def fake(module):
        @cache
        def kernel(shape):
            folder = tmp_path_factory.mktemp("kernel")
            backwards = request.param == "backwards"
            return emulated(module.source(shape), module._INPUTS, module._OUTPUTS, folder, backwards=backwards)

        return kernel

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(_backends, "cuda_is_default", lambda: True)
        patch.setattr(_backends, "installed", lambda name: name == "warp")
        patch.setattr(jax.lax, "platform_dependent", lambda *args, cuda, default: cuda(*args))
        for module in (hqp_kernel, qp_kernel):
            patch.setattr(module, "_kernel", fake(module))
        for module in (hqp_dispatch, qp_dispatch):
            patch.setattr(module, "with_the_rest", nothing_for_the_rest)
        hqp_dispatch.hierarchy_solver.cache_clear()
        qp_dispatch.qp_solver.cache_clear()
        jax.clear_caches()
        yield
    hqp_dispatch.hierarchy_solver.cache_clear()
    qp_dispatch.qp_solver.cache_clear()
    jax.clear_caches()


@jax.jit
@jax.vmap
def solved(levels, lower, upper, warm_start=None):
    return solve_hqp([Level(*level) for level in levels], lower, upper, warm_start=warm_start)


@pytest.mark.parametrize("family", SMALL)
def test_every_level_of_a_hierarchy_is_certified(family, on_emulated_gpu):
    p = SMALL[family](np.random.default_rng(5), COUNT)
    levels = [tuple(r) for r in p.levels]
    cold = solved(levels, p.lower, p.upper)
    for s in (cold, solved(levels, p.lower, p.upper, cold.warm_start)):
        np.testing.assert_array_equal(s.status, Status.SOLVED)
        x = np.asarray(s.x)
        assert ((p.lower <= x) & (x <= p.upper)).all()
        assert max(certificate(p, i, x[i]).max() for i in range(COUNT)) < 1e-10


@pytest.mark.variants(release=["backwards-float32", "forwards-float64"])
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_recorded_hierarchies(precision, on_emulated_gpu):
    """Level norms within the precision contract, cold and warm; the near-singular ones are among them."""
    r = recorded_hierarchies(unit_rows=True)
    pick = np.r_[0:256:32, 128, 149, 184, 211]
    data = [level if k == 1 else level[:2] for k, level in enumerate(r.levels)]
    levels, lower, upper = jax.tree.map(lambda a: jnp.asarray(a[pick], precision), (data, r.lower, r.upper))
    cold = solved(levels, lower, upper)
    warm = solved(levels, lower, upper, cold.warm_start)
    for s in (cold, warm):
        np.testing.assert_array_equal(s.status, Status.SOLVED)
        for k, (A, low, high) in enumerate(r.levels):
            value = np.einsum("bmn,bn->bm", A[pick], np.asarray(s.x, float))
            norm = np.linalg.norm(value - np.clip(value, low[pick], high[pick]), axis=1)
            np.testing.assert_allclose(
                norm, r.residual_norm[pick, k], rtol=0, atol=2e-7 if precision == "float32" else 1e-10
            )
    assert np.mean(warm.factorizations) < 0.5 * np.mean(cold.factorizations)


@pytest.mark.parametrize("robot", ["g1", "nao"])
def test_recorded_qps(robot, on_emulated_gpu):
    p = recorded_qps(robot)
    pick = slice(None, None, 32)
    A, b, lower, upper = (jnp.asarray(a[pick], jnp.float32) for a in (p.A, p.b, p.lower, p.upper))
    solve = jax.jit(jax.vmap(lambda *a: solve_least_squares_qp(*a[:5], damping=QP_DAMPING, warm_start=a[5])))
    start = jnp.zeros(lower.shape, jnp.int32)
    for _ in range(2):
        s = solve(A, b, jnp.ones_like(b), lower, upper, start)
        np.testing.assert_array_equal(s.status, Status.SOLVED)
        off = np.einsum("bmn,bn->bm", p.A[pick], np.asarray(s.x, float) - p.solution[pick])
        assert (np.abs(off).max(1) / np.abs(p.b[pick]).max(1)).max() < 1e-5
        start = s.active


@pytest.mark.variants(release=["forwards-3", "forwards-0", "backwards-3"])
@pytest.mark.parametrize("soft", [0, 3])
def test_derivatives_of_recorded_qps(soft, on_emulated_gpu, rng):
    """Those of single precision by the kernel, beside those of double precision by XLA, where the kernel answers.

    With soft rows in single precision it may leave a hard lane to XLA.
    """
    p = recorded_qps("nao")
    pick = slice(None, None, 64)
    A, b, lower, upper = (a[pick] for a in (p.A, p.b, p.lower, p.upper))
    count, _, n = A.shape
    rows, high = rng.normal(size=(count, soft, n)), np.full((count, soft), 0.1)
    rates = tuple(rng.normal(size=a.shape) for a in (A, b, lower))

    def solve(A, b, lower, upper, rows, high):
        given = dict(rows=rows, rows_lower=-high, rows_upper=high, rows_compliance=high) if soft else {}
        return solve_least_squares_qp(A, b, jnp.ones_like(b), lower, upper, damping=1e-3, **given)

    def rate(precision):
        given = [jnp.asarray(a, precision) for a in (A, b, lower, upper, rows, high)]
        move = [jnp.asarray(a, precision) for a in rates]
        forward = jax.jvp(lambda *a: jax.vmap(solve)(*a, *given[3:]).x, given[:3], move)[1]

        def loss(*moving):
            return jnp.sum(jax.vmap(solve)(*moving, *given[3:]).x ** 2)

        return jax.vmap(solve)(*given).status, (forward, *jax.grad(loss, (0, 1))(*given[:3]))

    status, found = jax.jit(rate, static_argnums=0)("float32")
    answered = np.asarray(status) == Status.SOLVED
    assert answered.mean() > 0.9
    for ours, expected in zip(found, rate("float64")[1], strict=True):
        size = np.abs(expected).reshape(count, -1).max(1)
        off = np.abs(np.asarray(ours, float) - expected).reshape(count, -1).max(1)
        assert (off <= 1e-3 * size)[answered].all()

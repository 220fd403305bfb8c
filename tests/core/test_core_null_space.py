"""The core's null space on a CPU: beside the plain method and NumPy, and the derivatives of both."""

from functools import partial
from typing import Any, cast

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from null_space_families import FAMILIES, LANES, Problems, check_active, random_problems
from recorded import SCALED, check_recorded_saturated, check_scales, recorded_saturated, recorded_scales

from osik_jax.core import _library
from osik_jax.execution import _candidates
from osik_jax.execution._backends import Backend
from osik_jax.solvers import Damping, Level, Status, solve_nullspace
from osik_jax.solvers._row_factors import row_factors
from osik_jax.solvers.null_space import _saturation

pytestmark = needs_core
METHODS = {"forward": {}, "saturated": dict(lower=-0.4, upper=0.4)}


@partial(jax.jit, static_argnames=("backend", "method"))
def solved(p: Problems, *, backend: Backend = "core", method="forward"):
    """A batch, by one backend."""

    def one(p: Problems):
        levels, damping = [Level(*level) for level in p.levels], [Damping(*d) for d in p.damping]
        bounds = {name: jnp.full_like(p.secondary, bound) for name, bound in METHODS[method].items()}
        return solve_nullspace(levels, **bounds, secondary=p.secondary, damping=damping, backend=backend)

    return jax.vmap(one)(p)


@pytest.mark.variants(
    slow=["damped", "one variable", "level without rows", "more rows than variables", "as many zero rows as are left"],
    release=["nothing left", "repeated", "independent", "inequalities", "damped, more rows", "a humanoid's"],
)
@pytest.mark.parametrize("p", FAMILIES.values(), ids=FAMILIES)
def test_lane_by_lane_as_the_plain_method(p):
    found, expected = solved(p), solved(p, backend="jax")
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    np.testing.assert_array_equal(expected.status, Status.SOLVED)
    assert np.abs(found.projector - expected.projector).max() < 1e-11
    assert np.abs(found.x - expected.x).max() < 1e-10 * (1.0 + np.abs(expected.x).max())
    P = np.asarray(found.projector)
    np.testing.assert_allclose(P @ P, P, rtol=0, atol=1e-14 * len(P[0]))
    np.testing.assert_array_equal(P, np.swapaxes(P, 1, 2))


def recursion(p: Problems, lane: int) -> np.ndarray:
    """Eq. 7 as printed, of equalities with constant dampings, by NumPy's SVD."""
    x, projector = np.zeros_like(p.secondary[lane]), np.eye(p.secondary.shape[1])
    for (A, wanted, _, weight), (constant, *_) in zip(p.levels, p.damping, strict=True):
        root = np.sqrt(weight[lane])
        rows = root[:, None] * A[lane]
        restricted = rows @ projector
        u, s, vt = np.linalg.svd(restricted, full_matrices=False)
        real = s > 1e-9 * np.linalg.norm(rows)
        damped = (vt.T * np.where(real, s / np.where(real, s**2 + constant[lane], 1.0), 0.0)) @ u.T
        x = x + damped @ (root * wanted[lane] - rows @ x)
        projector = projector - vt[real].T @ vt[real]
    return x + projector @ p.secondary[lane]


AS_NUMPY = ("independent", "damped", "dependent", "repeated", "more rows than variables", "damped, more rows", "zeros")


@pytest.mark.parametrize("name", [*AS_NUMPY, "a humanoid's", "one variable", "level without rows"])
def test_as_numpy(name):
    p = FAMILIES[name]
    p = p._replace(damping=[(constant, 0.0 * unmet, demand, bends) for constant, unmet, demand, bends in p.damping])
    found = np.asarray(solved(p).x)
    for lane in range(LANES):
        expected = recursion(p, lane)
        np.testing.assert_allclose(found[lane], expected, rtol=0, atol=1e-9 * (1.0 + np.abs(expected).max()))


@pytest.mark.variants(slow=["level without rows"], release=["a humanoid's"])
@pytest.mark.parametrize("name", ["damped inequalities", "a humanoid's", "level without rows"])
def test_single_precision_is_double_inside(name):
    """As near to the answer in double precision as rounded data can be, and nearer than single arithmetic."""
    p = FAMILIES[name]
    with jax.enable_x64(False):
        single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), p)
        found = solved(single)
    assert found.x.dtype == found.projector.dtype == jnp.float32
    rounded = jax.tree.map(lambda a: np.asarray(a, np.float64), single)
    expected = solved(rounded, backend="jax")
    assert np.abs(found.x - expected.x).max() < 1e-5 * (1.0 + np.abs(expected.x).max())


BOUNDED = ["damped inequalities", "repeated and damped", "level without rows", "dependent", "more rows than variables"]
BOUNDED += ["tiny", "a humanoid's", "nothing left", "zeros", "huge"]


@pytest.mark.variants(ordinary=[], slow=["damped inequalities", "tiny", "zeros", "huge"])
@pytest.mark.parametrize("name", BOUNDED)
def test_saturation_lane_by_lane_as_the_plain_method(name):
    p = FAMILIES[name]
    found, expected = solved(p, method="saturated"), solved(p, backend="jax", method="saturated")
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    np.testing.assert_array_equal(expected.status, Status.SOLVED)
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-8)
    if "repeated" not in name:  # what a level asks for that has been met is rounding, and has any scale
        np.testing.assert_allclose(found.scales, expected.scales, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-8)
    check_active(found, expected)


def test_saturation_of_recorded_problems_whatever_rounding_does():
    """Without the end of searches that go round, 1 in 20 copies of one of them would not end."""
    copies = 64
    p = recorded_saturated(copies)
    check_recorded_saturated(jax.jit(lambda p: _saturation.by_core(_library.call, p, 330))(p), p, copies)


@pytest.mark.parametrize("kind", SCALED)
def test_saturation_goes_to_the_largest_scale_there_is(kind):
    """Far targets, of which most joints are saturated on the way, and rows that were summed in single precision."""
    p, largest = recorded_scales(kind, 16)
    check_scales(jax.jit(lambda p: _saturation.by_core(_library.call, p, 330))(p), p, largest, kind)


@jax.jit
@partial(jax.vmap, in_axes=(0, None, None))
def factored(A, tolerance, damping):
    return row_factors(A, tolerance, damping, "core")


@pytest.mark.parametrize("damping", [0.0, 1e-4, 1.0])
@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
@pytest.mark.parametrize(("m", "n", "rank"), [(5, 9, 5), (5, 9, 2), (9, 5, 5), (4, 4, 0), (1, 1, 1)])
def test_factors_of_rows(rng, m, n, rank, scale, damping):
    A = scale * rng.normal(size=(LANES, m, rank)) @ rng.normal(size=(LANES, rank, n))
    basis, outer, triangle = map(np.asarray, factored(A, 1e-10 * scale, damping * scale**2))
    some, none = np.eye(m) * (np.arange(m) < rank), np.arange(m) >= rank
    np.testing.assert_allclose(basis @ np.swapaxes(basis, 1, 2), np.broadcast_to(some, (LANES, m, m)), atol=1e-13)
    np.testing.assert_allclose(np.swapaxes(outer, 1, 2) @ outer, np.broadcast_to(some, (LANES, m, m)), atol=1e-13)
    np.testing.assert_allclose(outer[:, :m] @ triangle @ basis, A, rtol=0, atol=1e-13 * scale * n)
    damped = np.sqrt(damping) * scale * some
    np.testing.assert_allclose(
        outer[:, m:] @ triangle * some, np.broadcast_to(damped, (LANES, m, m)), atol=1e-13 * scale
    )
    np.testing.assert_array_equal(triangle[:, none], np.broadcast_to(np.eye(m)[none], (LANES, none.sum(), m)))
    np.testing.assert_array_equal(np.tril(triangle, -1), 0.0)


@pytest.mark.slow
def test_vmap_is_a_loop_however_it_is_nested(rng):
    p = random_problems(20, 8, (3, 4, 2), inequalities=True, damped=True, lanes=40)
    together = solved(p)
    nested = jax.vmap(solved)(jax.tree.map(lambda a: a.reshape(5, 8, *a.shape[1:]), p))
    np.testing.assert_array_equal(nested.x.reshape(40, -1), together.x)
    for lane in (0, 17, 39):
        alone = solved(jax.tree.map(lambda a, lane=lane: a[lane : lane + 1], p))
        np.testing.assert_array_equal(alone.x[0], together.x[lane])
    levels = [Level(*(a[3] for a in level)) for level in p.levels]
    damping = [Damping(*(a[3] for a in each)) for each in p.damping]
    without_batch = solve_nullspace(levels, secondary=p.secondary[3], damping=damping, backend="core")
    np.testing.assert_allclose(without_batch.x, together.x[3], rtol=0, atol=1e-13)
    shared = jax.vmap(lambda s: solve_nullspace(levels, secondary=s, damping=damping, backend="core").x)(p.secondary)
    np.testing.assert_allclose(shared[3], together.x[3], rtol=0, atol=1e-13)


@pytest.mark.variants(release=["saturated", "forward"])
@pytest.mark.parametrize("method", METHODS)
def test_a_bad_lane_harms_none(method):
    p = jax.tree.map(np.copy, FAMILIES["damped inequalities"])
    right = solved(p, method=method)
    p.levels[1][0][3, 0, 0] = np.nan
    p.levels[0][0][5, 0, 0] = np.inf
    found = solved(p, method=method)
    good = ~np.isin(np.arange(LANES), (3, 5))
    assert (np.asarray(found.status)[~good] == Status.NUMERICAL_ERROR).all()
    assert np.isfinite(found.x).all() and np.isfinite(found.projector).all()
    # of saturation, loops go on for a whole block: a lane may be corrected once more beside another one
    atol = 1e-15 if method == "saturated" else 0.0
    np.testing.assert_allclose(np.asarray(found.x)[good], np.asarray(right.x)[good], rtol=0, atol=atol)
    rate = jax.jvp(lambda s: solved(p._replace(secondary=s), method=method).x, (p.secondary,), (p.secondary,))[1]
    assert np.isfinite(rate).all()


def test_numbers_that_overflow_are_an_error_of_their_lane():
    p = jax.tree.map(np.copy, FAMILIES["independent"])
    p.levels[0][0][2] *= 1e200
    for backend in ("core", "jax"):
        found = solved(p, backend=backend)
        assert np.isfinite(found.x).all()
        assert (np.delete(np.asarray(found.status), 2) == Status.SOLVED).all()


@pytest.mark.variants(slow=["float32"], release=["float64"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_beside_a_gpu_too_the_kernel_and_the_search_return_the_same_types(monkeypatch, precision):
    """There both are branches of one program, and with JAX's default precision what is computed in double is a part."""
    monkeypatch.setattr(_candidates, "cpu_is_default", lambda: False)
    solve = partial(cast(Any, solved).__wrapped__, backend="core", method="saturated")
    jax.clear_caches()
    with jax.enable_x64(precision == "float64"):
        given = jax.tree.map(lambda a: jnp.asarray(a, precision), FAMILIES["damped inequalities"])
        for platform in ("cpu", "cuda"):  # each traces what runs there
            jax.jit(solve).trace(given).lower(lowering_platforms=(platform,))
    jax.clear_caches()

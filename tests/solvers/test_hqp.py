"""The array-level hierarchy against certified level norms and answers by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from recorded import recorded_hierarchies

from osik_jax.solvers import Level, Status, Tolerances, solve_hqp, solve_nullspace


@jax.jit
@jax.vmap
def batched_hqp(levels, lower, upper):
    return solve_hqp([Level(*a) for a in levels], lower, upper, backend="jax")


@pytest.mark.variants(slow=["float32"])
@pytest.mark.parametrize("precision", ["float64", "float32"])
def test_recorded_hierarchies_by_plain_jax(precision):
    """Level norms, measured with the data before they were rounded."""
    r = recorded_hierarchies(unit_rows=True)
    with jax.enable_x64(precision == "float64"):
        levels, lower, upper = jax.tree.map(lambda a: jnp.asarray(a, precision), (r.levels, r.lower, r.upper))
        s = jax.device_get(batched_hqp(levels, lower, upper))
    assert s.x.dtype == precision and (s.status == Status.SOLVED).all()
    assert ((lower <= s.x) & (s.x <= upper)).all()
    values = [np.einsum("bmn,bn->bm", A, s.x.astype(float)) for A, _, _ in r.levels]
    misses = [v - np.clip(v, low, high) for v, (_, low, high) in zip(values, r.levels, strict=True)]
    norms = np.stack([np.linalg.norm(w, axis=1) for w in misses], 1)
    assert np.abs(norms - r.residual_norm).max() < (1e-7 if precision == "float64" else 1e-6)


@pytest.mark.slow
def test_inequalities_at_any_level_and_weights_inside_a_level():
    box = jnp.full(2, 5.0)
    inequality_first = [Level([[1.0, 1.0]], [-jnp.inf], [1.0]), Level(jnp.eye(2), [2.0, 2.0], [2.0, 2.0])]
    np.testing.assert_allclose(solve_hqp(inequality_first, -box, box).x, [0.5, 0.5], atol=1e-12)
    inequality_last = [Level([[1.0, 0.0]], [2.0], [2.0]), Level([[1.0, 1.0], [0.0, 1.0]], [-jnp.inf, -1.0], [1.0, 3.0])]
    s = solve_hqp(inequality_last, -box, box)
    np.testing.assert_allclose(s.x, [2.0, -1.0], atol=1e-12)
    np.testing.assert_allclose(s.slacks[1], [0.0, 0.0], atol=1e-12)
    conflict = [Level([[1.0], [1.0]], [0.0, 1.0], [0.0, 1.0], weight=[1.0, 3.0])]
    np.testing.assert_allclose(solve_hqp(conflict, -box[:1], box[:1]).x, [0.75], atol=1e-12)
    off = [Level([[1.0], [1.0]], [0.0, 1.0], [0.0, 1.0], weight=[1.0, 0.0])]
    np.testing.assert_allclose(solve_hqp(off, -box[:1], box[:1]).x, [0.0], atol=1e-12)


@pytest.mark.variants(release=["solve_hqp"])
@pytest.mark.parametrize("solver", [solve_hqp, solve_nullspace])
def test_known_equalities_are_kept_whatever_their_upper_bounds_round_to(rng, solver):
    """A compiler may compute one expression twice: an equality in two roundings still stands before lower levels."""
    n, sizes, apart = 8, (3, 2, 8), np.array([-1e-15, 0.0, 1e-15])
    low, high = -np.full(n, 0.6), np.full(n, 0.6)
    box = (low, high) if solver is solve_hqp else ()

    def solve(levels, upper):
        first, second, last = levels
        known = Level(first[0], first[1], upper, equalities=[True] * 3)
        mixed = Level(second[0], second[1], second[1] + jnp.array([0.0, 0.1]), equalities=[True, False])
        return solver([known, mixed, Level(*last)], *box)

    levels = [(rng.normal(size=(30, m, n)), 0.1 * rng.normal(size=(30, m))) for m in sizes]
    levels[0][1][::2] = 0.0  # holds from the start, with nothing active
    batched = jax.jit(jax.vmap(solve))
    expected = batched(levels, levels[0][1])
    for shift in (apart, -apart):
        s = batched(levels, levels[0][1] + shift)
        np.testing.assert_array_equal(s.status, Status.SOLVED)
        np.testing.assert_allclose(s.slacks[0], 0.0, atol=1e-12)
        np.testing.assert_allclose(s.slacks[1][:, 0], 0.0, atol=1e-12)
        np.testing.assert_allclose(s.x, expected.x, atol=1e-12)
        if solver is solve_hqp:
            np.testing.assert_array_equal(s.warm_start.own[:, 0, :3], 2)


@pytest.mark.slow
def test_residual_tells_what_lower_levels_took():
    """Two rows nearer to parallel than the rank tolerance: the first level is one of them alone, for all below."""
    levels = [Level([[1.0, 0.0], [1.0, 1e-4]], [0.0, 0.0]), Level([[0.0, 1.0]], [1.0])]
    box = jnp.full(2, 5.0)
    kept = solve_hqp(levels, -box, box)
    np.testing.assert_allclose(kept.x, 0.0, atol=1e-12)
    assert kept.kkt_residual < 1e-12
    lost = solve_hqp(levels, -box, box, tolerances=Tolerances(rank=1e-3))
    assert np.linalg.norm(lost.slacks[0]) > 1e-5
    assert lost.kkt_residual >= np.linalg.norm(lost.slacks[0]) - 1e-12


@pytest.mark.slow
def test_level_without_rows_and_pinned_variables():
    levels = [Level(jnp.zeros((0, 3)), jnp.zeros(0), jnp.zeros(0)), Level(jnp.ones((1, 3)), [6.0], [6.0])]
    s = solve_hqp(levels, jnp.array([1.0, -jnp.inf, -10.0]), jnp.array([1.0, jnp.inf, 2.0]))
    np.testing.assert_allclose(s.x, [1.0, 3.0, 2.0], atol=1e-12)
    assert s.x[0] == 1.0 and s.active[0] == 2 and s.active[2] == 1


@pytest.mark.variants(release=["solve_nullspace"])
@pytest.mark.parametrize("solver", [solve_hqp, solve_nullspace])
def test_unordered_bounds_are_infeasible_and_their_middle_stands_for_them(solver):
    def solve(lower, upper, low, high):
        levels = [Level(jnp.array([[1.0, 1.0]]), lower[None], upper[None]), Level(jnp.eye(2), jnp.array([0.5, 0.0]))]
        return solver(levels, low, high)

    lower, upper = np.array([1.0, 0.5, 0.25]), np.array([0.0, 0.5, 0.25])
    low, high = -np.ones((3, 2)), np.ones((3, 2))
    low[2, 1], high[2, 1] = 0.5, -0.5
    s = jax.jit(jax.vmap(solve))(lower, upper, low, high)
    assert s.status.tolist() == [Status.INFEASIBLE, Status.SOLVED, Status.INFEASIBLE]
    np.testing.assert_allclose(s.x[0], s.x[1], atol=1e-12)
    np.testing.assert_allclose(s.slacks[0][:2], 0.0, atol=1e-12)  # of the middle
    assert np.isfinite(s.x).all()


def test_shapes_that_do_not_fit_are_named():
    with pytest.raises(ValueError, match=r"lower has shape \(3,\)"):
        Level(jnp.ones((2, 4)), jnp.zeros(3), jnp.zeros(2))
    with pytest.raises(ValueError, match="equalities has 1 flags; the matrix has 2 rows"):
        Level(jnp.ones((2, 4)), jnp.zeros(2), jnp.zeros(2), equalities=[True])


@pytest.mark.slow
def test_integers_are_floats():
    whole, box = [Level([[1, 1]], [0.5]), Level([[1, -1]], [0], [0], [2])], (np.full(2, -1.0), np.full(2, 1.0))
    assert whole[0].lower[0] == 0.5
    for solution in (solve_hqp(whole, *box), solve_nullspace(whole)):
        np.testing.assert_allclose(solution.x, [0.25, 0.25], atol=1e-9)

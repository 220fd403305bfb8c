"""The array-level hierarchy against certified level norms, quadprog, and its own lexicographic promise."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import quadprog
from recorded import recorded_hierarchies

from osik_jax.solvers import Level, Status, Tolerances, solve_hqp, solve_nullspace


@partial(jax.jit, static_argnames="backend")
def batched_hqp(levels, lower, upper, backend="auto"):
    def solve(levels, lower, upper):
        return solve_hqp([Level(*a) for a in levels], lower, upper, backend=backend)

    return jax.vmap(solve)(levels, lower, upper)


IMPROVED = 239
"""A recorded hierarchy whose second level is not at its optimum; see the last assertion of the test."""


def solved(r, backend="auto"):
    return batched_hqp(r.levels, r.lower, r.upper, backend=backend)


@pytest.fixture(scope="module")
def recorded():
    r = recorded_hierarchies(unit_rows=False)
    return r, solved(r)


@pytest.mark.variants(release=["False-auto", "False-jax"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
@pytest.mark.parametrize("unit_rows", [False, True])
def test_recorded_hierarchies(unit_rows, backend):
    r = recorded_hierarchies(unit_rows)
    s = solved(r, backend)
    assert (s.status == Status.SOLVED).all()
    assert ((r.lower <= s.x) & (s.x <= r.upper)).all()
    norms = np.stack([np.linalg.norm(w, axis=1) for w in s.slacks], 1)
    off = np.abs(norms - r.residual_norm).max(1) > 1e-7
    assert off.sum() == (0 if unit_rows else 1)
    if not unit_rows:
        assert off[IMPROVED]
        assert abs(norms[IMPROVED, 0] - r.residual_norm[IMPROVED, 0]) < 1e-12
        assert norms[IMPROVED, 1] < r.residual_norm[IMPROVED, 1] - 1e-5
        x = np.asarray(s.x)[IMPROVED]
        np.testing.assert_allclose(norms[IMPROVED, 1], second_level_by_quadprog(r, IMPROVED, x), atol=2e-8)


@pytest.mark.variants(release=["False-auto", "False-jax", "True-jax"])
@pytest.mark.parametrize("backend", ["auto", "jax"])
@pytest.mark.parametrize("unit_rows", [False, True])
def test_recorded_hierarchies_in_single_precision(unit_rows, backend):
    """Level norms within 1e-6, measured with the data before they were rounded."""
    r = recorded_hierarchies(unit_rows)
    with jax.enable_x64(False):
        levels, lower, upper = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), (r.levels, r.lower, r.upper))
        s = jax.device_get(batched_hqp(levels, lower, upper, backend=backend))
    assert s.x.dtype == np.float32
    assert (s.status == Status.SOLVED).all()
    assert ((lower <= s.x) & (s.x <= upper)).all()
    values = [np.einsum("bmn,bn->bm", A, s.x.astype(float)) for A, _, _ in r.levels]
    misses = [v - np.clip(v, low, high) for v, (_, low, high) in zip(values, r.levels, strict=True)]
    off = np.abs(np.stack([np.linalg.norm(w, axis=1) for w in misses], 1) - r.residual_norm).max(1)
    others = np.arange(len(off)) != (-1 if unit_rows else IMPROVED)
    assert off[others].max() < 1e-6


def second_level_by_quadprog(r, i, x):
    """Smallest |w_2| over the box and {A_1 y = A_1 x}."""
    (A1, *_), (A2, low, high) = (tuple(a[i] for a in level) for level in r.levels[:2])
    n, m = A1.shape[1], len(A2)
    bounded = np.isfinite(r.lower[i])
    E = np.eye(n)[bounded]
    pad = np.zeros((len(E), m))
    G = np.vstack(
        [
            np.hstack([A1, np.zeros((len(A1), m))]),
            np.hstack([E, pad]),
            np.hstack([-E, pad]),
            np.hstack([A2, np.eye(m)]),
            np.hstack([-A2, -np.eye(m)]),
        ]
    )
    h = np.concatenate([A1 @ x, r.lower[i][bounded] - 1e-12, -r.upper[i][bounded] - 1e-12, low, -high])
    H = np.diag(np.r_[np.full(n, 1e-9), np.ones(m)])
    y = quadprog.solve_qp(H, np.zeros(n + m), G.T, h, len(A1))[0]
    return np.linalg.norm(y[n:])


def pinv_cascade(levels):
    """Eq. 7 in NumPy, for equality levels without bounds."""
    n = levels[0][0].shape[1]
    x, P = np.zeros(n), np.eye(n)
    for A, b in levels:
        inverse = np.linalg.pinv(A @ P, rcond=1e-9)
        x, P = x + inverse @ (b - A @ x), P - inverse @ (A @ P)
    return x


def test_equalities_without_active_bounds_are_the_null_space_cascade(rng):
    n, sizes = 14, (4, 3, 5)
    solve = jax.jit(lambda ls: solve_hqp([Level(A, b, b) for A, b in ls], jnp.full(n, -jnp.inf), jnp.full(n, jnp.inf)))
    for _ in range(30):
        levels = [(rng.normal(size=(m, n)), rng.normal(size=m)) for m in sizes]
        levels[1][0][2] = levels[0][0][0] + levels[0][0][1]  # a row that conflicts with the first level
        s = solve(levels)
        np.testing.assert_allclose(s.x, pinv_cascade(levels), atol=1e-9)
        for (A, b), w in zip(levels, s.slacks, strict=True):
            np.testing.assert_allclose(w, A @ s.x - b, atol=1e-12)


@pytest.mark.slow
def test_no_feasible_step_improves_a_level_without_hurting_a_higher_one(rng, recorded):
    r, s = recorded

    def costs(i, x):
        out = []
        for A, low, high in r.levels:
            value = A[i] @ x
            out.append(np.sum((value - np.clip(value, low[i], high[i])) ** 2))
        return np.array(out)

    for i in range(3, 256, 16):
        x = np.asarray(s.x)[i]
        base = costs(i, x)
        for _ in range(200):
            step = rng.normal(size=32) * 10 ** rng.uniform(-6, -2)
            y = np.clip(x + step, r.lower[i], r.upper[i])
            change = costs(i, y) - base
            worse = np.flatnonzero(np.abs(change) > 1e-13)
            assert len(worse) == 0 or change[worse[0]] > 0


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


def test_level_without_rows_and_pinned_variables():
    levels = [Level(jnp.zeros((0, 3)), jnp.zeros(0), jnp.zeros(0)), Level(jnp.ones((1, 3)), [6.0], [6.0])]
    s = solve_hqp(levels, jnp.array([1.0, -jnp.inf, -10.0]), jnp.array([1.0, jnp.inf, 2.0]))
    np.testing.assert_allclose(s.x, [1.0, 3.0, 2.0], atol=1e-12)
    assert s.x[0] == 1.0 and s.active[0] == 2 and s.active[2] == 1


def test_a_bad_lane_leaves_its_neighbours_alone(recorded):
    r, good = recorded
    levels = [tuple(a.copy() for a in level) for level in r.levels]
    levels[2][1][4, 0] = levels[2][2][4, 0] = np.nan
    s = batched_hqp(levels, r.lower, r.upper)
    assert s.status[4] == Status.NUMERICAL_ERROR
    assert np.isfinite(s.x[4]).all() and ((r.lower[4] <= s.x[4]) & (s.x[4] <= r.upper[4])).all()
    others = np.arange(len(r.lower)) != 4
    np.testing.assert_array_equal(np.asarray(s.x)[others], np.asarray(good.x)[others])


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


@pytest.mark.release
def test_derivatives_are_those_of_the_solution_map(rng, recorded):
    """Along a random change of all data (zeros by structure kept): forward, reverse, central differences."""
    r, _ = recorded
    direction = rng.normal(size=32)

    def loss(data):
        levels, lower, upper = data
        return direction @ solve_hqp([Level(*level) for level in levels], lower, upper).x

    def change(a):
        return np.where(np.isfinite(a) & (a != 0.0), 0.01 * rng.normal(size=a.shape), 0.0)

    data = ([tuple(a[::4] for a in level) for level in r.levels], r.lower[::4], r.upper[::4])
    rates = jax.tree.map(change, data)
    for k, (A, low, high) in enumerate(rates[0]):
        rates[0][k] = (A, low, np.where(data[0][k][1] == data[0][k][2], low, high))  # equalities stay equalities
    value = jax.jit(jax.vmap(loss))
    forward = np.asarray(jax.jit(lambda d, t: jax.jvp(jax.vmap(loss), (d,), (t,))[1])(data, rates))
    gradient = jax.device_get(jax.jit(jax.grad(lambda d: jnp.sum(jax.vmap(loss)(d))))(data))
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))
    products = jax.tree.map(lambda g, t: np.sum(g * t, axis=tuple(range(1, t.ndim))), gradient, rates)
    np.testing.assert_allclose(sum(jax.tree.leaves(products)), forward, rtol=1e-9, atol=1e-11)

    def moved(h):
        return np.asarray(value(jax.tree.map(lambda a, t: np.where(np.isfinite(a), a + h * t, a), data, rates)))

    ahead, here, behind = moved(1e-6), moved(0.0), moved(-1e-6)
    smooth = np.abs(ahead - 2 * here + behind) < 1e-9  # no active set changes on the way
    assert smooth.sum() >= 30
    np.testing.assert_allclose(forward[smooth], (ahead - behind)[smooth] / 2e-6, rtol=1e-6, atol=1e-8)

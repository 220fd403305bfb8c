"""The functions of the CUDA kernels one by one, on a CPU, beside NumPy and what plain JAX computes."""

import tempfile
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from emulated_warp import emulated, needs_compiler

from osik_jax.solvers import Damping, Level
from osik_jax.solvers._damping import level_damping, narrow_box
from osik_jax.solvers.hqp import _warp as hqp
from osik_jax.solvers.qp import _warp as qp

pytestmark = [needs_compiler, pytest.mark.slow]
N, M, BELOW = 34, 7, 3
"""Variables, more than a warp has lanes; rows of a level; rows of the level below it."""
TOLERANCES = np.array([1e-10, 1e-12, 1e-12, 1e-9])  # of rank, step, multipliers, feasibility
BEGIN = "begin(); m = COUNT[0]; B = A; has_inequalities = HAS_INEQUALITIES[0] != 0; load_level();\n"


@pytest.fixture(params=[False, True], ids=["forwards", "backwards"])
def backwards(request):
    """Whether the last lane goes first."""
    return request.param


def run(module, shape, last, statements, data, size, folder, backwards):
    """What statements write to ``result`` after the kernel's files up to one of them."""
    text = module.source(shape, module.PARTS[: module.PARTS.index(last) + 1]) + "\n" + statements
    kinds = module._INPUTS | dict(given="double")
    folder = Path(tempfile.mkdtemp(dir=folder))  # a library that is loaded keeps its place
    kernel = emulated(text, kinds, module._OUTPUTS | dict(result="double"), folder, backwards=backwards)
    unused = {name: (1,) for name in module._OUTPUTS}
    given = [np.asarray(data.get(name, 0.0), float).ravel() for name in kinds]
    return np.asarray(kernel(*given, 100, launch_dims=32, output_dims=unused | dict(result=(size,)))[-1])


@pytest.fixture
def in_hierarchy(rng, tmp_path, backwards):
    """A function that runs statements on two random levels in a box, of which the first is begun, and their data."""
    A, wanted = rng.normal(size=(M + BELOW, N)), rng.normal(size=M + BELOW)
    bounds = np.full(N, 0.3)
    data = dict(matrix=A.T, rows_lower=wanted, rows_upper=wanted, rows_equal=np.ones(M + BELOW), hard_upper=bounds)
    data |= dict(hard_lower=-bounds, hard_equal=np.zeros(N), guess_own=np.zeros(2 * M), guess_hard=np.zeros(2 * N))
    data |= dict(dampings=np.zeros((3, 2)), bends=np.zeros((2, N)), tolerances=TOLERANCES)
    shape = hqp.Shape(N, M, (M, BELOW), (False, False), (), ())

    def run_them(last, statements, size, **changed):
        everything = data | changed
        return run(hqp, shape, last, BEGIN + statements, everything, size, tmp_path, backwards)

    return run_them, data


def matrix_to_result(name, rows, columns, stride):
    """Statements that write a matrix of shared memory."""
    return f"""__syncwarp(); if (lane == 0) for (int i = 0; i < {rows}; ++i) for (int j = 0; j < {columns}; ++j)
      result.data[i * {columns} + j] = {name}[i * {stride} + j];"""


VECTOR_TO_RESULT = "for (int h = 0; h < H; ++h) if (exists[h]) result.data[lane + 32 * h] = d[h];"
SET_X = "for (int h = 0; h < H; ++h) if (exists[h]) x[h] = given.data[lane + 32 * h];\n"


def test_reductions(tmp_path, backwards, rng):
    """The least index among equals wins."""
    given = np.round(rng.normal(size=32), 1)
    given[[7, 23]] = 3.0
    statements = """double a = given.data[lane], most = a; int which = lane;
      double sum = warp_sum(a), largest = warp_max(a); warp_argmax(most, which);
      if (lane == 31) result.data[0] = sum, result.data[1] = largest, result.data[2] = which, result.data[3] = most;"""
    shape = hqp.Shape(N, M, (M,), (False,), (), ())
    found = run(hqp, shape, "reductions", statements, dict(given=given), 4, tmp_path, backwards)
    np.testing.assert_allclose(found, [given.sum(), 3.0, 7.0, 3.0], rtol=1e-14)


def test_a_reflector_takes_a_row_to_one_entry(in_hierarchy):
    """Entries before it stay, and the basis stays orthonormal."""
    run_them, _ = in_hierarchy
    statements = """
      if (lane == 0) for (int j = 0; j < N; ++j) E[j] = given.data[j];
      __syncwarp();
      const double weight = make_reflector(E, 2);
      for (int h = 0; h < H; ++h) if (exists[h]) apply_reflector(Z + (lane + 32 * h) * ZD, 2, weight);
      """
    row = np.arange(1.0, N + 1.0)
    basis = run_them("basis", statements + matrix_to_result("Z", "N", "N", "ZD"), N * N, given=row).reshape(N, N)
    np.testing.assert_allclose(basis.T @ basis, np.eye(N), atol=1e-14)
    turned = row @ basis
    expected = np.array([1.0, 2.0, -np.linalg.norm(row[2:]), *np.zeros(N - 3)])
    np.testing.assert_allclose(turned, expected, atol=1e-12)


@pytest.mark.parametrize("count", [1, M])
def test_cholesky(count, in_hierarchy):
    run_them, data = in_hierarchy
    G = data["matrix"].T[:count] @ data["matrix"][:, :count]
    right = np.arange(1.0, count + 1.0)
    statements = f"""
      for (int e = lane; e < {count * count}; e += 32) gram[e / {count} * VD + e % {count}] = given.data[e];
      __syncwarp();
      cholesky({count}, 0.5);
      double right[G];
      for (int g = 0; g < G; ++g) right[g] = lane + 32 * g < {count} ? lane + 32 * g + 1.0 : 0.0;
      cholesky_solve({count}, right);
      for (int g = 0; g < G; ++g) if (lane + 32 * g < {count}) result.data[lane + 32 * g] = right[g];"""
    found = run_them("cholesky", statements, count, given=G)
    np.testing.assert_allclose(found, np.linalg.solve(G + 0.5 * np.eye(count), right), rtol=1e-10)


def test_active_rows_come_first_in_the_basis(in_hierarchy):
    """And the shortest step brings them to their bounds."""
    run_them, _ = in_hierarchy
    begin = """
      for (int h = 0; h < H; ++h) active[h] = is(h, 3) || is(h, 33) ? 1 : is(h, 8) ? -1 : 0;
      rotate_active_rows();
      """
    basis = run_them("active_rows", begin + matrix_to_result("Z", "N", "N", "ZD"), N * N).reshape(N, N)
    np.testing.assert_allclose(basis.T @ basis, np.eye(N), atol=1e-14)
    np.testing.assert_allclose(np.abs(basis[[3, 8, 33], :3]).sum(0), 1.0, atol=1e-14)
    np.testing.assert_allclose(basis[[3, 8, 33], 3:], 0.0, atol=1e-14)
    step = run_them("active_rows", begin + "double d[H]; restoring_step(d);" + VECTOR_TO_RESULT, N)
    expected = np.zeros(N)
    expected[[3, 33, 8]] = 0.3, 0.3, -0.3
    np.testing.assert_allclose(step, expected, atol=1e-14)


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_the_step_of_least_squares(damping, in_hierarchy, rng):
    """To the only minimiser with damping, to one of them without it; joint 5 stays."""
    run_them, data = in_hierarchy
    at = rng.normal(size=N)
    statements = f"""
      damping = {damping};
      {SET_X}
      for (int h = 0; h < H; ++h) active[h] = is(h, 5);
      for (int g = 0; g < G; ++g) in_cost[g] = in_level[g];
      rotate_active_rows();
      factor_least_squares();
      to_point(x);
      double missed[G], d[H];
      for (int g = 0; g < G; ++g) missed[g] = in_level[g] ? row_times(lane + 32 * g, point) - level_lower[g] : 0.0;
      least_squares_step(missed, d);
      """
    step = run_them("least_squares", statements + VECTOR_TO_RESULT, N, given=at)
    free = np.arange(N) != 5
    A = data["matrix"].T[:M][:, free]
    missed = data["matrix"].T[:M] @ at - data["rows_lower"][:M]
    assert step[5] == 0.0
    if damping:
        H = A.T @ A + damping * np.eye(N - 1)
        expected = -np.linalg.solve(H, A.T @ missed + damping * at[free])
        np.testing.assert_allclose(step[free], expected, atol=1e-11)
    else:
        np.testing.assert_allclose(A @ step[free], -missed, atol=1e-12)


def test_multipliers_of_active_bounds(in_hierarchy, rng):
    """They are the negative gradient there, and the residual is its largest entry elsewhere, in the basis."""
    run_them, data = in_hierarchy
    at = rng.normal(size=N)
    statements = f"""
      {SET_X}
      for (int h = 0; h < H; ++h) active[h] = is(h, 2) || is(h, 32);
      for (int g = 0; g < G; ++g) in_cost[g] = in_level[g];
      rotate_active_rows();
      evaluate();
      compute_multipliers(slack);
      double d[H];
      for (int h = 0; h < H; ++h) d[h] = multiplier[h];
      {VECTOR_TO_RESULT}
      if (lane == 0) result.data[N] = gradient_norm, result.data[N + 1] = slack_norm;"""
    found = run_them("evaluate", statements, N + 2, given=at)
    A = data["matrix"].T[:M]
    missed = A @ at - data["rows_lower"][:M]
    expected = np.zeros(N)
    expected[[2, 32]] = -(A.T @ missed)[[2, 32]]
    np.testing.assert_allclose(found[:N], expected, atol=1e-12)
    np.testing.assert_allclose(found[N:], [np.linalg.norm(A.T @ missed), np.linalg.norm(missed)], rtol=1e-12)


@pytest.mark.parametrize("far", [0.01, 30.0])
def test_the_damping_of_a_level(far, in_hierarchy):
    """As plain JAX: near the demand little of it is left, far beyond the box all."""
    run_them, data = in_hierarchy
    wanted = far * data["rows_lower"]
    terms = Damping(1e-3, 0.8, float(np.linalg.norm(wanted[:M])), 0.0)
    dampings = np.array([terms[:3], (0.0, 0.0, 0.0)]).T
    changed = dict(rows_lower=wanted, rows_upper=wanted, dampings=dampings)
    found = run_them("damping", "compute_damping(); if (lane == 0) result.data[0] = damping;", 1, **changed)
    level = Level(data["matrix"].T[:M], wanted[:M]).scaled()
    box = (jnp.asarray(data[name]) for name in ("hard_lower", "hard_upper"))
    expected = level_damping(Damping(*map(jnp.asarray, terms)), level, jnp.zeros(N), jnp.eye(N), *box)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    assert (expected > 0.5) == (far > 1.0)


def test_the_line_search_ends_where_the_cost_is_least(in_hierarchy, rng):
    """Along a direction on which inequalities enter and leave the cost."""
    run_them, data = in_hierarchy
    at, direction = 0.1 * rng.normal(size=N), rng.normal(size=N)
    lower, upper = data["rows_lower"] - 0.5, data["rows_lower"] + np.where(np.arange(M + BELOW) % 2, 0.5, np.inf)
    statements = f"""
      {SET_X}
      evaluate();
      double d[H], rate[G];
      for (int h = 0; h < H; ++h) d[h] = exists[h] ? given.data[N + lane + 32 * h] : 0.0;
      to_point(d);
      for (int g = 0; g < G; ++g) rate[g] = in_level[g] ? row_times(lane + 32 * g, point) : 0.0;
      const double t = exact_line_search(rate, 0.0, 0.0);
      if (lane == 0) result.data[0] = t;"""
    A = data["matrix"].T[:M]
    if (A @ at - np.clip(A @ at, lower[:M], upper[:M])) @ (A @ direction) > 0.0:
        direction = -direction
    changed = dict(rows_lower=lower, rows_upper=upper, rows_equal=np.zeros(M + BELOW))
    found = run_them("primal_active_set", statements, 1, given=np.concatenate([at, direction]), **changed)[0]

    def slope(t):
        value = A @ (at + t * direction)
        return (value - np.clip(value, lower[:M], upper[:M])) @ (A @ direction)

    assert found > 0.0 and abs(slope(found)) < 1e-10 * abs(slope(0.0))


def test_the_box_of_the_levels_below(in_hierarchy, rng):
    """As plain JAX, where a level is out of reach."""
    run_them, data = in_hierarchy
    wanted, bends = 3.0 * data["rows_lower"], np.stack([rng.uniform(0.5, 2.0, N), np.zeros(N)])
    terms = Damping(0.0, 0.8, float(np.linalg.norm(wanted[:M])), bends[0])
    at = 0.01 * rng.normal(size=N)
    statements = f"""
      {SET_X}
      compute_damping();
      evaluate();
      narrow_box();
      for (int h = 0; h < H; ++h) if (exists[h])
        result.data[lane + 32 * h] = low[h], result.data[N + lane + 32 * h] = high[h];"""
    changed = dict(rows_lower=wanted, rows_upper=wanted, bends=bends, given=at)
    changed["dampings"] = np.array([terms[:3], (0.0, 0.0, 0.0)]).T
    found = run_them("freeze", statements, 2 * N, **changed)
    level = Level(data["matrix"].T[:M], wanted[:M]).scaled()
    before = (jnp.asarray(data[name]) for name in ("hard_lower", "hard_upper"))
    *box, _ = narrow_box(Damping(*map(jnp.asarray, terms)), level, jnp.zeros(N), jnp.asarray(at), *before)
    np.testing.assert_allclose(found, np.concatenate(box), rtol=1e-9)
    assert (found[:N] > data["hard_lower"]).any()


@pytest.fixture
def in_qp(rng, tmp_path, backwards):
    """A function that runs statements on a QP with one soft row whose variables 4 and 33 are guessed at bounds."""
    A, C = rng.normal(size=(M, N)), rng.normal(size=(1, N))
    guess = np.zeros(N + 1)
    guess[[4, 33]] = -1, 1
    lower, upper = np.full(N + 1, -0.2), np.full(N + 1, 0.2)
    data = dict(matrix=A, target=rng.normal(size=M), weight=rng.uniform(1.0, 2.0, M), damping=np.full(N, 0.5))
    data |= dict(center=rng.normal(size=N), lower=lower, upper=upper, rows=C, compliance=[0.3], guess=guess)
    data |= dict(tolerance=[1e-6])
    begin = """if (has_row) row_weights[M + lane] = row_targets[M + lane] = 0.f;
      __syncwarp(); factor(); refine();\n"""

    def run_them(last, statements, size, **changed):
        body = begin + statements
        return run(qp, qp.Shape(N, M, 1), last, body, data | changed, size, tmp_path, backwards)

    return run_them, data


def minimiser(data):
    """On the guessed bounds, without the soft row: x, and the negative gradient there."""
    A, weight, damping = data["matrix"], data["weight"], data["damping"]
    H = A.T @ (weight[:, None] * A) + np.diag(damping)
    right = A.T @ (weight * data["target"]) + damping * data["center"]
    x = np.where(data["guess"][:N] < 0, -0.2, 0.2) * (data["guess"][:N] != 0)
    free = data["guess"][:N] == 0
    x[free] = np.linalg.solve(H[np.ix_(free, free)], right[free] - H[np.ix_(free, ~free)] @ x[~free])
    return x, right - H @ x, H


def test_the_minimiser_on_a_working_set(in_qp):
    run_them, data = in_qp
    statements = """for (int h = 0; h < H; ++h) if (exists[h])
      result.data[index[h]] = x[h], result.data[N + index[h]] = gradient[h];"""
    found = run_them("refine", statements, 2 * N)
    x, downhill, _ = minimiser(data)
    np.testing.assert_allclose(found[:N], x, atol=2e-6)
    np.testing.assert_allclose(found[N:], downhill, atol=2e-5)


def test_labels_that_are_wrong(in_qp):
    run_them, data = in_qp
    statements = """const int wrong = find_wrong_labels();
      for (int h = 0; h < H; ++h) if (exists[h]) result.data[index[h]] = next[h];
      if (has_row) result.data[N] = next_row_label;
      if (lane == 0) result.data[N + 1] = wrong;"""
    found = run_them("labels", statements, N + 2)
    x, downhill, _ = minimiser(data)
    value = data["rows"] @ x
    guess = data["guess"][:N]
    expected = np.where(x < -0.2, -1, np.where(x > 0.2, 1, 0))
    expected[4], expected[33] = -int(downhill[4] <= 0.0), int(downhill[33] >= 0.0)
    np.testing.assert_array_equal(found[:N], expected)
    row = -1 if value < -0.2 else 1 if value > 0.2 else 0
    np.testing.assert_array_equal(found[N:], [row, (expected != guess).sum() + (row != 0)])
    assert found[-1] > 3


def test_the_constraint_that_enters_raises_the_dual_objective_most(in_qp):
    run_them, data = in_qp
    statements = "find_wrong_labels(); choose_entering(); if (lane == 0) result.data[0] = entering;"
    found = run_them("dual_step", statements, 1)
    x, _, H = minimiser(data)
    free = data["guess"][:N] == 0
    gap = np.maximum(np.abs(np.append(x, data["rows"] @ x)) - 0.2, 0.0)
    rate = np.full(N + 1, np.inf)
    rate[:N][free] = np.diag(np.linalg.inv(H[np.ix_(free, free)]))
    # a row's rate by the Hessian's diagonal alone, an upper bound that needs no solve
    rate[N] = data["compliance"][0] + (np.abs(data["rows"]) @ (1.0 / np.sqrt(np.diag(H))))[0] ** 2
    assert found[0] == np.argmax(gap**2 / rate)

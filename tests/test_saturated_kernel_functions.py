"""The functions of the saturated null space's CUDA kernel, one after another on a CPU, beside NumPy and plain JAX."""

import jax.numpy as jnp
import numpy as np
import pytest
from emulated_warp import needs_compiler
from test_kernel_functions import backwards as backwards
from test_kernel_functions import matrix_to_result, run

from osik_jax.solvers import Damping, Level
from osik_jax.solvers._damping import level_damping, narrow_box
from osik_jax.solvers.null_space import _warp

pytestmark = [needs_compiler, pytest.mark.slow]
N, M = 34, 7
"""Joints, more than a warp has lanes; rows of each of two levels."""
PINNED = 5
BEGIN = "A = matrix.data; load_level(); look(); set_beside();\n"
BEGIN_SATURATED = f"""{BEGIN} first += take_row_space(m, MD, 1e-10 * frobenius);
  for (int i = lane; i < N; i += 32) {{
    target_part[i] = 0.0, passed[i] = 0, motion[i] = given.data[i];
  }}
  __syncwarp();
  auto enters = [&](int k, int label) {{ const double s = look_along(k); saturate(k, s, label, 0.0, 0); }};
"""


@pytest.fixture
def in_saturation(rng, tmp_path, backwards):
    """A function that runs statements on two random levels in a box with a pinned joint, and their data."""
    A, wanted = rng.normal(size=(2, M, N)), rng.normal(size=(2, M))
    low, high = np.full(N, -0.3), np.full(N, 0.3)
    low[PINNED] = high[PINNED] = 0.1
    data = dict(rows=A, rows_lower=wanted, rows_upper=wanted, rows_equal=np.ones((2, M)), dampings=np.zeros((3, 2)))
    data |= dict(bends=np.zeros((2, N)), targets=np.zeros((2, N)), lower=low, upper=high, rank_tolerance=1e-10)

    def run_them(last, statements, size, begin=BEGIN, **changed):
        everything = data | changed
        everything["matrix"] = np.swapaxes(everything["rows"], 1, 2)
        return run(_warp, _warp.Shape(N, 2, M), last, begin + statements, everything, size, tmp_path, backwards)

    return run_them, data


def start(data):
    """The point that a problem begins at, and the projector onto the joints that can move."""
    x, free = np.zeros(N), np.arange(N) != PINNED
    x[PINNED] = 0.1
    return x, np.diag(free.astype(float))


def vectors_to_result(*names, at=0):
    """Statements that write vectors of all joints."""
    writes = (f"result.data[{at + k * N} + i] = {name}[i];" for k, name in enumerate(names))
    return f"__syncwarp(); for (int i = lane; i < N; i += 32) {{ {' '.join(writes)} }}"


ALL_COORDINATES = matrix_to_result("turned", "N", "N", "D")


def orthonormal(found):
    """The coordinates that were written, whose rows are orthonormal."""
    turned = found[: N * N].reshape(N, N)
    np.testing.assert_allclose(turned @ turned.T, np.eye(N), atol=1e-13)
    return turned


@pytest.mark.parametrize("rank", [M, M - 2])
def test_the_row_space_comes_first(rank, in_saturation, rng):
    """After the pinned joint; the coordinates that are left have nothing of the rows."""
    run_them, data = in_saturation
    rows = np.array(data["rows"])
    rows[0, rank:] = rng.normal(size=(M - rank, rank)) @ rows[0, :rank]
    statements = "rank = take_row_space(m, MD, 1e-10 * frobenius); if (lane == 7) result.data[N * N] = rank;"
    found = run_them("row_space", statements + ALL_COORDINATES, N * N + 1, rows=rows)
    turned = orthonormal(found)
    assert found[-1] == rank
    np.testing.assert_array_equal(turned[0], np.eye(N)[PINNED])
    np.testing.assert_allclose(turned[1 + rank :] @ rows[0].T, 0.0, atol=1e-13)


@pytest.mark.parametrize("damping", [0.0, 0.7])
def test_the_motion_of_a_level(damping, in_saturation):
    """The damped pseudo-inverse of the rows that take part; a row without bounds does not."""
    run_them, data = in_saturation
    low, high, equal = (np.array(data[name]) for name in ("rows_lower", "rows_upper", "rows_equal"))
    low[0, 2], high[0, 2], equal[0, 2] = -np.inf, np.inf, 0
    statements = f"damping = {damping}; find_motion(); if (lane == 0) result.data[N] = rank;"
    changed = dict(rows_lower=low, rows_upper=high, rows_equal=equal)
    found = run_them("motion", statements + vectors_to_result("motion"), N + 1, **changed)
    x, P = start(data)
    A = data["rows"][0][np.arange(M) != 2]
    missed = low[0][np.arange(M) != 2] - A @ x
    J = A @ P
    np.testing.assert_allclose(found[:N], J.T @ np.linalg.solve(J @ J.T + damping * np.eye(M - 1), missed), atol=1e-12)
    assert found[N] == M - 1


@pytest.mark.parametrize("far", [0.01, 30.0])
def test_the_damping_of_a_level(far, in_saturation):
    """As plain JAX: it falls with what is missed."""
    run_them, data = in_saturation
    wanted = far * data["rows_lower"]
    low, equal = np.array(wanted), np.array(data["rows_equal"])
    low[0, 4], equal[0, 4] = -np.inf, 0
    terms = Damping(1e-3, 0.8, float(np.linalg.norm(wanted[0])), 0.0)
    changed = dict(rows_lower=low, rows_upper=wanted, rows_equal=equal, dampings=np.array([terms[:3], (0.0,) * 3]).T)
    found = run_them("damping", "compute_damping(); if (lane == 0) result.data[0] = damping;", 1, **changed)
    level = Level(data["rows"][0], low[0], wanted[0]).scaled()
    (x, P), far = map(jnp.asarray, start(data)), jnp.full(N, jnp.inf)
    expected = level_damping(Damping(*map(jnp.asarray, terms)), level, x, P, -far, far)
    np.testing.assert_allclose(found, expected, rtol=1e-8)
    assert 1e-3 < expected < 0.801


def test_saturated_joints_have_duals_of_their_own(in_saturation, rng):
    """Before and after one of three is released: 1 along the own joint's column, 0 along the others'."""
    run_them, data = in_saturation
    statements = f"""enters(3, 1); enters(33, -1); enters(8, 1);
      if (given.data[N] > 0.0) release(0, false);
      if (lane == 0) result.data[N * N] = count, result.data[N * N + 1] = first;
      for (int a = lane; a < count; a += 32) {{
        result.data[N * N + 2 + a] = who[a];
        for (int j = first; j < first + count; ++j) result.data[N * N + 5 + a * 3 + j - first] = duals[a * D + j];
      }}
      {ALL_COORDINATES}"""
    for released in (0.0, 1.0):
        found = run_them("saturated", statements, N * N + 14, BEGIN_SATURATED, given=[0.0] * N + [released])
        turned = orthonormal(found)
        count, first = found[N * N : N * N + 2].astype(int)
        who = found[N * N + 2 :][:count].astype(int)
        assert sorted(who) == ([8, 33] if released else [3, 8, 33])
        duals = found[N * N + 5 :].reshape(3, 3)[:count, :count]
        np.testing.assert_allclose(duals @ turned[first : first + count, who], np.eye(count), atol=1e-13)
        left = turned[first + count :]
        np.testing.assert_allclose(left[:, who], 0.0, atol=1e-13)
        np.testing.assert_allclose(turned[first:] @ data["rows"][0].T, 0.0, atol=1e-13)


def test_x_with_saturated_joints_on_their_bounds(in_saturation, rng):
    """The nearest point, and the multipliers."""
    run_them, data = in_saturation
    wish = rng.normal(size=N)
    statements = """enters(3, 1); enters(33, -1); scale = 0.4; settle();
      for (int a = lane; a < count; a += 32) result.data[N + a] = y[a];"""
    found = run_them("saturated", statements + vectors_to_result("now"), N + 2, BEGIN_SATURATED, given=wish)
    x, P = start(data)
    J = data["rows"][0] @ P
    P = P - np.linalg.pinv(J) @ J
    before, which = x + 0.4 * wish, [3, 33]
    y = np.linalg.solve(P[np.ix_(which, which)], np.array([0.3, -0.3]) - before[which])
    np.testing.assert_allclose(found[:N], before + P[:, which] @ y, atol=1e-12)
    np.testing.assert_allclose(found[N:], y, atol=1e-11)


def test_the_scale_that_a_combination_of_joints_allows(in_saturation, rng):
    """A row that keeps x_3 + 2 x_8 - x_33: what they move while all three go to their bounds."""
    run_them, data = in_saturation
    rows, wish = np.array(data["rows"]), rng.normal(size=N)
    rows[0, 0] = 0.0
    rows[0, 0, [3, 8, 33]] = 1.0, 2.0, -1.0
    wish[[3, 8, 33]] = 1.0, 1.0, -0.5
    statements = """enters(3, 1); enters(8, 1);
      const double left = look_along(33); double its_rate;
      const double s = scale_of(33, -1, 1e-9, its_rate);
      if (lane == 3) result.data[0] = s, result.data[1] = its_rate, result.data[2] = left;
      for (int a = lane; a < count; a += 32) result.data[3 + a] = rate[a];"""
    found = run_them("stop", statements, 5, BEGIN_SATURATED, rows=rows, given=wish)
    np.testing.assert_allclose(found[:2], [(0.3 + 2 * 0.3 + 0.3) / 3.5, -3.5], rtol=1e-12)
    np.testing.assert_allclose(found[2:], [0.0, 1.0, 2.0], atol=1e-12)


def test_the_joint_furthest_beyond_its_bound_enters(in_saturation, rng):
    """Not one that is saturated already."""
    run_them, _ = in_saturation
    at = rng.normal(size=N)
    at[[8, 20, PINNED]] = 5.0, 4.0, 0.1
    statements = """enters(8, 1);
      for (int i = lane; i < N; i += 32) now[i] = given.data[i];
      __syncwarp();
      const int found = most_violated(1e-11);
      if (lane == 31) result.data[0] = found;"""
    found = run_them("choices", statements, 1, BEGIN_SATURATED, given=at)
    at[8] = 0.0
    assert found[0] == np.argmax(np.abs(at)) == 20


def test_joints_that_stop_a_level_are_taken_off(in_saturation):
    """The coordinates that are left have nothing of them."""
    run_them, data = in_saturation
    statements = f"""for (int i = lane; i < N; i += 32) blocking[i] = i == 3 ? 1 : i == 33 ? -1 : 0;
      __syncwarp();
      take_off_stops();
      if (lane == 0) result.data[N * N] = first;
      {ALL_COORDINATES}"""
    found = run_them("after", statements, N * N + 1, BEGIN_SATURATED, given=np.zeros(N))
    turned, first = orthonormal(found), int(found[-1])
    assert first == 1 + M + 2
    np.testing.assert_array_equal(turned[first:][:, [3, 33]], 0.0)
    np.testing.assert_allclose(turned[first:] @ data["rows"][0].T, 0.0, atol=1e-13)


def test_the_box_of_the_levels_below(in_saturation, rng):
    """As plain JAX, where a level is out of reach."""
    run_them, data = in_saturation
    wanted, bends = 3.0 * data["rows_lower"], np.stack([rng.uniform(0.5, 2.0, N), np.zeros(N)])
    terms, at = Damping(0.0, 0.8, float(np.linalg.norm(wanted[0])), bends[0]), 0.01 * rng.normal(size=N)
    statements = """for (int i = lane; i < N; i += 32) x[i] = given.data[i];
      narrow_box();"""
    changed = dict(rows_lower=wanted, rows_upper=wanted, bends=bends, dampings=np.array([terms[:3], (0.0,) * 3]).T)
    found = run_them("after", statements + vectors_to_result("low", "high"), 2 * N, given=at, **changed)
    level = Level(data["rows"][0], wanted[0]).scaled()
    before = (jnp.asarray(data[name]) for name in ("lower", "upper"))
    *box, _ = narrow_box(Damping(*map(jnp.asarray, terms)), level, jnp.zeros(N), jnp.asarray(at), *before)
    np.testing.assert_allclose(found, np.concatenate(box), rtol=1e-9)
    assert (found[:N] > data["lower"]).any()

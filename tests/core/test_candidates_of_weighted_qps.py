"""Candidates of the weighted QP are taken only where they are right: by the certificate of the core.

And what is done on a GPU with those that its kernel does not certify, without a GPU."""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from core_checks import needs_core
from recorded import QP_DAMPING, recorded_qps
from weighted_families import contradicting

from osik_jax.core import _cuda as core_cuda
from osik_jax.core import _library
from osik_jax.execution import _backends
from osik_jax.execution._computed import side_by_side
from osik_jax.execution._lanes import FEW_ON_CPU, first_set, with_the_rest
from osik_jax.numerics._constants import KKT_TOLERANCE
from osik_jax.solvers import Status, solve_least_squares_qp
from osik_jax.solvers.qp import _core, _dispatch, _search
from osik_jax.solvers.qp._core import CERTIFIED, LEAST_VIOLATION, Candidate
from osik_jax.solvers.qp._dispatch import kernel_candidates
from osik_jax.solvers.qp._problem import QP, LeastSquares

CAP = 1000
SOFT = 3


class Batch(NamedTuple):
    """Recorded QPs with soft rows on the base, and their answers by the search."""

    qp: QP
    guess: jax.Array
    tolerance: jax.Array
    answers: _search.SearchResult


@pytest.fixture(scope="module")
def batch() -> Batch:
    p = recorded_qps("nao")
    at_bound = (np.minimum(p.solution - p.lower, p.upper - p.solution) < 1e-12).any(1)
    pick = np.flatnonzero(at_bound)[:40]
    A, b, lower, upper = (jnp.asarray(a[pick]) for a in (p.A, p.b, p.lower, p.upper))
    rng = np.random.default_rng(3)
    count, _, n = A.shape
    rows = jnp.asarray(rng.normal(size=(count, SOFT, n)))
    damping = jnp.full((count, n), QP_DAMPING)
    cost = LeastSquares(A, b, jnp.ones_like(b), damping, jnp.zeros_like(damping))
    side = jnp.full((count, SOFT), 0.1)
    low, high = jnp.concatenate([lower, -side], 1), jnp.concatenate([upper, side], 1)
    qp = QP(cost, rows, jnp.full((count, SOFT), 0.1), low, high)
    guess, tolerance = jnp.zeros(low.shape, jnp.int32), jnp.full(count, 1e-12)
    answers = jax.jit(lambda *a: _search.search(*a, max_iterations=CAP))(qp, guess, tolerance)
    assert answers.optimal.all() and (answers.active[:, :n] != 0).any(1).all() and (answers.active[:, n:] != 0).any()
    return Batch(qp, guess, tolerance, answers)


def candidate_of(found: _search.SearchResult) -> Candidate:
    yes = jnp.ones_like(found.iterations)
    certified = jnp.full_like(yes, CERTIFIED)
    return Candidate(found.x, found.row_multipliers, found.active, certified, yes, yes, found.residual)


@functools.partial(jax.jit, static_argnames=("smallest", "block"))
def searched_from(candidate: Candidate, *given: Any, smallest: int, block: int | None) -> _search.SearchResult:
    """One program for all candidates, and another where the blocks are of another size."""
    assert smallest == _dispatch._MIN_BLOCK
    qp, guess, tolerance = given
    as_given = qp, jnp.ones(len(guess), bool)
    return kernel_candidates(CAP, lambda *_: candidate, block).answers(qp, as_given, guess, tolerance)


def completed(
    batch: Batch, candidate: Candidate, block: int | None = FEW_ON_CPU
) -> tuple[_search.SearchResult, np.ndarray]:
    """The end, and the lanes in which the candidate was taken; in NumPy."""
    end = searched_from(candidate, *batch[:3], smallest=_dispatch._MIN_BLOCK, block=block)
    end, p = jax.device_get((end, candidate))
    return end, np.all(end.x == p.x, 1) & (end.factorizations == p.factorizations)


def judged(batch: Batch, c: Candidate) -> np.ndarray:
    """The lanes that the core certifies."""
    matrix, *others = jax.tree.leaves(batch.qp)
    packed = side_by_side(*others)
    tolerances = jnp.stack([batch.tolerance, jnp.full_like(batch.tolerance, KKT_TOLERANCE[np.dtype("float64")])], 1)
    shapes = [((len(c.x),), int), ((len(c.x),), float)]
    holds, _ = _library.call(
        "weighted_qp_certificate", shapes, matrix, packed, c.x, c.row_multipliers, c.active, tolerances
    )
    return np.asarray(holds, bool)


def assert_right(batch: Batch, end: _search.SearchResult) -> None:
    """In the measure of the precision contract: rows of the cost, as a share of the largest that is asked for."""
    cost = batch.qp.cost
    assert isinstance(cost, LeastSquares) and end.optimal.all()
    off = np.einsum("bmn,bn->bm", cost.matrix, end.x - np.asarray(batch.answers.x))
    assert (np.abs(off).max(1) / np.abs(np.asarray(cost.target)).max(1)).max() < 1e-5


@pytest.mark.release
def test_right_candidates_are_taken(batch):
    end, taken = completed(batch, candidate_of(batch.answers))
    assert taken.all() and (end.factorizations == 1).all()
    assert not _library.installed() or judged(batch, candidate_of(batch.answers)).all()
    np.testing.assert_array_equal(end.x, batch.answers.x)
    np.testing.assert_array_equal(end.active, batch.answers.active)
    np.testing.assert_array_equal(end.row_multipliers, batch.answers.row_multipliers)


def unbounded_minimisers(batch: Batch) -> Candidate:
    """Of the cost alone: stationary, but outside the box."""
    x = jax.vmap(lambda c: jnp.linalg.solve(c.hessian(), -c.gradient(jnp.zeros_like(c.damping))))(batch.qp.cost)
    return candidate_of(batch.answers)._replace(
        x=x, active=jnp.zeros_like(batch.guess), row_multipliers=jnp.zeros_like(batch.answers.row_multipliers)
    )


def active_too_much(batch: Batch) -> Candidate:
    """The minimiser with one more variable active at its bound: everything is right but the sign of a multiplier."""
    qp, n = batch.qp, batch.answers.x.shape[1]
    boxed = jnp.isfinite(qp.lower[:, :n]) & (batch.answers.active[:, :n] == 0)
    at = jnp.argmax(jnp.where(boxed, batch.answers.x - qp.lower[:, :n], -1.0), 1)
    active = batch.answers.active.at[jnp.arange(len(at)), at].set(-1)
    factor = jax.vmap(_search.factorize)(qp, jax.vmap(lambda c: c.hessian())(qp.cost), active)
    x, y = _search.solve_on_active_set(qp, factor, active)
    return candidate_of(batch.answers)._replace(x=x, row_multipliers=y, active=active)


def changed(batch: Batch, **how: Any) -> Candidate:
    right = candidate_of(batch.answers)
    return right._replace(**{name: change(getattr(right, name)) for name, change in how.items()})


WRONG = {
    "NaN": lambda b: changed(b, x=lambda x: x.at[:, 3].set(jnp.nan)),
    "NaN multipliers": lambda b: changed(b, row_multipliers=lambda y: y * jnp.nan),
    "infinite": lambda b: changed(b, x=lambda x: x.at[:, 0].set(jnp.inf)),
    "zeros": lambda b: changed(b, x=jnp.zeros_like, active=jnp.zeros_like, row_multipliers=jnp.zeros_like),
    "a little off": lambda b: changed(b, x=lambda x: 1.001 * x),
    "nothing active": lambda b: changed(b, active=jnp.zeros_like),
    "signs turned": lambda b: changed(b, active=lambda a: -a),
    "all equalities": lambda b: changed(b, active=lambda a: jnp.full_like(a, 2)),
    "unknown labels": lambda b: changed(b, active=lambda a: jnp.where(a == 0, 77, a)),
    "unbounded": unbounded_minimisers,
    "active too much": active_too_much,
}


@needs_core
@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_candidates_are_not_certified(batch, wrong):
    assert not judged(batch, jax.jit(WRONG[wrong])(batch)).any()


def test_what_is_not_certified_is_searched(batch):
    candidate = changed(batch, converged=jnp.ones_like, x=lambda x: 1.001 * x)
    end, taken = completed(batch, candidate)
    assert not taken.any()
    assert_right(batch, end)


@pytest.mark.slow
def test_what_is_left_goes_through_in_blocks(batch, monkeypatch):
    """Wrong in 25 of 40 lanes, 4 lanes a block; the others stay as the kernel has them."""
    monkeypatch.setattr(_dispatch, "_MIN_BLOCK", 4)
    lanes = jnp.arange(len(batch.guess))
    spoiled = (lanes * 7) % 8 < 5
    right = candidate_of(batch.answers)
    candidate = right._replace(
        x=jnp.where(spoiled[:, None], 0.0, right.x), converged=jnp.where(spoiled, 1, right.converged)
    )
    end, taken = completed(batch, candidate, None)
    np.testing.assert_array_equal(taken, ~spoiled)
    assert_right(batch, end)
    assert (end.factorizations[spoiled] == 2).all()  # the kernel's, and one from the active set that it left


def test_what_is_not_valid_is_not_searched(batch):
    is_valid = jnp.arange(len(batch.guess)) != 3
    right = candidate_of(batch.answers)
    spoiled = [jnp.where(is_valid[:, None], a, jnp.nan) for a in (right.x, right.row_multipliers)]
    converged = jnp.where(is_valid, right.converged, 1)
    candidate = right._replace(x=spoiled[0], row_multipliers=spoiled[1], converged=converged)
    kernel = kernel_candidates(CAP, lambda *_: candidate)
    end = kernel.certified(batch.qp, (batch.qp, is_valid), batch.guess, batch.tolerance)
    assert end.done.all() and not end.optimal[3]
    assert (end.x[3] == 0.0).all() and (end.row_multipliers[3] == 0.0).all()
    np.testing.assert_array_equal(end.x[is_valid], batch.answers.x[is_valid])


def test_too_many_changes_are_not_taken(batch):
    candidate = candidate_of(batch.answers)._replace(iterations=jnp.full_like(batch.answers.iterations, CAP + 1))
    end, taken = completed(batch, candidate)
    assert not taken.any() and (end.iterations <= CAP).all()


def solved(batch: Batch, **options: Any) -> Any:
    cost, n = batch.qp.cost, batch.answers.x.shape[1]
    assert isinstance(cost, LeastSquares)
    low, high = batch.qp.lower, batch.qp.upper

    def one(cost, rows, low, high, compliance):
        given = (cost.matrix, cost.target, cost.weight, low[:n], high[:n], rows, low[n:], high[n:])
        return solve_least_squares_qp(*given, damping=QP_DAMPING, rows_compliance=compliance, **options)

    return jax.jit(jax.vmap(one))(cost, batch.qp.rows, low, high, batch.qp.compliance)


@pytest.fixture
def beside_a_gpu(monkeypatch):
    """JAX with a CUDA device and NVRTC, as far as the choice can see; returns what the kernel is asked."""
    asked = []

    def solve(qp, guess, tolerance, max_iterations):
        asked.append(qp.cost.matrix.shape[1:])
        nothing = jnp.zeros(len(guess), jnp.int32)
        x = jnp.full_like(qp.cost.damping, jnp.nan)
        return Candidate(x, jnp.zeros_like(qp.compliance), guess, nothing, nothing, nothing, x[:, 0])

    monkeypatch.setattr(_backends, "cuda_is_default", lambda: True)
    monkeypatch.setattr(core_cuda, "nvrtc", lambda: "libnvrtc.so")
    monkeypatch.setattr(_core, "solve_on_gpu", solve)
    jax.clear_caches()
    yield asked
    jax.clear_caches()


@pytest.mark.release
def test_a_cpu_beside_a_gpu_keeps_to_xla(batch, beside_a_gpu):
    """Where a program runs decides, not what the machine has."""
    answer = solved(batch)
    assert set(beside_a_gpu) == {batch.qp.cost.matrix.shape[1:]}  # traced, but not what is compiled
    assert (answer.status == Status.SOLVED).all()
    np.testing.assert_allclose(answer.x, batch.answers.x, atol=1e-6)


@pytest.mark.variants(release=["switched off"])
@pytest.mark.parametrize("why", ["switched off", "no NVRTC", "no core", "many rows"])
def test_when_the_kernel_is_not_asked(beside_a_gpu, monkeypatch, why):
    A, n, options = np.ones((4, 5), np.float32), 5, {}
    if why == "switched off":
        options = dict(backend="jax")
    if why == "no NVRTC":
        monkeypatch.setattr(core_cuda, "nvrtc", lambda: None)
    if why == "no core":
        monkeypatch.setattr(_library, "core", lambda: _library.Core(None, None, "none"))
    if why == "many rows":
        A = np.ones((20_000, 5), np.float32)
    bound = np.ones(n, A.dtype)
    jax.jit(lambda: solve_least_squares_qp(A, A[:, 0], A[:, 0], -bound, bound, **options)).lower()
    assert beside_a_gpu == []


@pytest.mark.variants(release=["hard-float64", "soft-float64", "soft-float32", "none-float32"])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("rows", ["none", "soft", "hard"])
def test_when_the_kernel_is_asked(beside_a_gpu, rows, dtype):
    A, bound = np.ones((4, 5), dtype), np.ones(5, dtype)
    b, one = A[:, 0], bound[:1]
    options = {} if rows == "none" else dict(rows=A[:1], rows_lower=-one, rows_upper=one)
    options |= dict(rows_compliance=one) if rows == "soft" else {}
    jax.jit(lambda: solve_least_squares_qp(A, b, b, -bound, bound, **options)).lower()
    assert set(beside_a_gpu) == {(4, 5)}


@pytest.mark.parametrize("set_", [[], [0], [6], [1, 4], [0, 1, 2, 3, 4, 5, 6]])
@pytest.mark.parametrize("size", [1, 3, 7])
def test_the_first_flags_that_are_set(set_, size):
    flags = np.isin(np.arange(7), set_)
    np.testing.assert_array_equal(first_set(jnp.asarray(flags), size), (set_ + [7] * 7)[:size])


@pytest.mark.parametrize("lanes", [1, 4])
def test_what_no_lane_needs_is_not_computed(lanes):
    """XLA takes out of a loop what is the same in each round, and of one lane that is everything."""

    def solve(matrices, done):
        return with_the_rest(matrices[:, 0], done, lambda at, _: jnp.linalg.cholesky(matrices[at])[:, 0], min(2, lanes))

    matrices = jnp.tile(4.0 * jnp.eye(3), (lanes, 1, 1))
    program = jax.jit(solve).lower(matrices, jnp.ones(lanes, bool)).compile()
    always, sometimes = (part.count("potrf") for part in reversed((program.as_text() or "").split("ENTRY")))
    assert (always, sometimes > 0) == (0, True)
    for done in (jnp.ones(lanes, bool), jnp.zeros(lanes, bool)):
        np.testing.assert_array_equal(program(matrices, done), matrices[:, 0] / jnp.where(done, 1.0, 2.0)[:, None])


@needs_core
def test_the_core_alone_finds_the_least_violation_of_contradicting_rows():
    """In each third lane; the answer is that of the search, and its derivative that of differences, by the rows too."""
    data = contradicting(np.random.default_rng(5), 90, every=3)
    A, b, w, low, high, C, below, above = map(jnp.asarray, data)
    n, p = A.shape[2], C.shape[1]
    damping = jnp.full((90, n), 1e-3)
    cost = LeastSquares(A, b, w, damping, jnp.zeros_like(damping))
    bounds = jnp.concatenate([low, below], 1), jnp.concatenate([high, above], 1)
    qp = QP(cost, C, jnp.zeros((90, p)), *bounds)
    found = _core.solve(qp, jnp.zeros(bounds[0].shape, jnp.int32), jnp.full(90, 1e-12), CAP)
    contradicts = np.arange(90) % 3 == 0
    np.testing.assert_array_equal(found.converged, np.where(contradicts, LEAST_VIOLATION, CERTIFIED))

    rng = np.random.default_rng(6)
    turn, shift = rng.normal(size=C.shape), rng.normal(size=below.shape)

    def solve(backend, way=0.0):
        one = functools.partial(solve_least_squares_qp, damping=1e-3, backend=backend)
        return jax.vmap(one)(A, b, w, low, high, C + way * turn, below + way * shift, above)

    expected, h = jax.jit(functools.partial(solve, "jax"))(), 1e-6
    np.testing.assert_array_equal(expected.status == Status.INFEASIBLE, contradicts)
    np.testing.assert_allclose(found.x, expected.x, atol=1e-7)
    for backend in ("core", "jax"):
        moved = jax.jit(lambda way, backend=backend: solve(backend, way).x)
        rate = jax.jit(lambda moved=moved: jax.jvp(moved, (0.0,), (1.0,))[1])()
        far, near = ((np.asarray(moved(s)) - np.asarray(moved(-s))) / (2.0 * s) for s in (3.0 * h, h))
        size = np.abs(near).max(1)
        smooth = np.abs(far - near).max(1) < 1e-6 * size  # no bound becomes active on the way
        assert (smooth & contradicts).sum() > 20
        assert (np.abs(rate - near).max(1) < 1e-5 * size)[smooth].all(), backend

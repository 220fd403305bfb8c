"""The CUDA kernels on a CPU, thread by thread: certified answers, no races, and nothing left to XLA."""

import inspect
from functools import cache, partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_saturation
from emulated_warp import emulated, needs_compiler
from hierarchy_families import SMALL
from lexicographic import certificate
from null_space_families import FAMILIES, check_active, check_derivatives_of_saturation, saturated
from recorded import (
    QP_DAMPING,
    check_far_saturated,
    check_recorded_saturated,
    check_single_saturated,
    recorded_far_saturated,
    recorded_hierarchies,
    recorded_qps,
    recorded_saturated,
    recorded_single_saturated,
    recorded_turned_signs,
)

import osik_jax as osik
from osik_jax.execution import _backends
from osik_jax.solvers import Damping, Level, Status, solve_hqp, solve_least_squares_qp, solve_nullspace
from osik_jax.solvers.hqp import _dispatch as hqp_dispatch
from osik_jax.solvers.hqp import _warp as hqp_kernel
from osik_jax.solvers.null_space import _saturation
from osik_jax.solvers.null_space import _warp as null_space_kernel
from osik_jax.solvers.null_space._padding import Problem, pad_levels
from osik_jax.solvers.null_space._saturation import _by_core as by_core
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
        patch.setattr(jax.lax, "platform_dependent", lambda *args, default, cuda=None, **_: (cuda or default)(*args))
        for module in (hqp_kernel, qp_kernel, null_space_kernel):
            patch.setattr(module, "_kernel", fake(module))
        for module in (hqp_dispatch, qp_dispatch):
            patch.setattr(module, "with_the_rest", nothing_for_the_rest)
        patch.setattr(_saturation, "with_a_few", lambda _, *rest: nothing_for_the_rest(*rest))
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


QUICK = ("damped inequalities", "repeated and damped", "a humanoid's")
OTHERS = ("damped, more rows", "nothing left", "one variable", "level without rows", "dependent", "huge", "zeros")


@pytest.mark.variants(release=[f"{way}-{name}" for way in ("forwards", "backwards") for name in OTHERS])
@pytest.mark.parametrize("name", [*QUICK, *OTHERS])
def test_saturation_lane_by_lane_as_the_plain_method(name, on_emulated_gpu):
    found, expected = saturated(FAMILIES[name]), saturated(FAMILIES[name], backend="jax")
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-8)
    if "repeated" not in name:  # what a level asks for that has been met is rounding, and has any scale
        np.testing.assert_allclose(found.scales, expected.scales, rtol=0, atol=1e-8)
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-8)
    check_active(found, expected)


@pytest.mark.parametrize("number", range(len(test_saturation.FAMILIES)), ids=test_saturation.FAMILIES)
def test_saturation_decides_as_the_plain_method(number, on_emulated_gpu):
    """Where the core does too (``tests/test_saturation.py``): infinite bounds, pinned joints, conflicts, ties."""
    name = test_saturation.FAMILIES[number]
    p = test_saturation.family(name, np.random.default_rng(100 + number))
    found = inspect.unwrap(test_saturation.solve_full)(p)  # traced here, where a GPU seems to be
    expected = test_saturation.solve_full(p, backend="jax")
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    assert ((found.x >= p.lower) & (found.x <= p.upper)).all()
    size = 1.0 + np.abs(expected.x).max(1)
    assert (np.abs(found.x - expected.x).max(1) < 1e-8 * size).all()
    near = np.abs(found.scales - expected.scales) < 1e-9
    assert near.all() or (name == "ties" and near.mean() > 0.99)
    np.testing.assert_allclose(found.projector, expected.projector, rtol=0, atol=1e-9)
    for mine, other in ((found, expected), (expected, found)):
        bound = np.where(mine.active > 0, p.upper, p.lower)
        assert (np.abs(other.x - bound) < 1e-8 * size[:, None])[np.asarray(mine.active) != 0].all()


def test_saturation_that_is_cut_short(on_emulated_gpu):
    """Levels that were not finished do nothing; those before them stay."""
    p = test_saturation.family("tight", np.random.default_rng(4))

    @jax.jit
    @jax.vmap
    def solve(p):
        levels = test_saturation.as_levels(p.levels[:2])
        first, both = solve_nullspace(levels[:1], p.lower, p.upper), partial(solve_nullspace, levels, p.lower, p.upper)
        return first, both(max_iterations=6)

    first, cut = solve(p)
    unfinished = np.asarray(cut.status) == Status.MAX_ITERATIONS
    assert 20 < unfinished.sum() < len(unfinished)
    np.testing.assert_array_equal(cut.status[~unfinished], Status.SOLVED)
    assert ((cut.x >= p.lower) & (cut.x <= p.upper)).all()
    alone = unfinished & (np.asarray(cut.scales)[:, 0] > 0.0) & (np.asarray(cut.scales)[:, 1:] == 0.0).all(1)
    assert alone.any()
    np.testing.assert_allclose(cut.x[alone], first.x[alone], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", ["damped inequalities", "a humanoid's"])
def test_saturation_in_single_precision_is_double_inside(name, on_emulated_gpu):
    """As near to the answer in double precision as its rounded data can be."""
    single = jax.tree.map(lambda a: jnp.asarray(a, jnp.float32), FAMILIES[name])
    found = saturated(single)
    expected = saturated(jax.tree.map(lambda a: np.asarray(a, float), single), backend="jax")
    assert found.x.dtype == found.projector.dtype == jnp.float32
    np.testing.assert_array_equal(found.status, Status.SOLVED)
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-5)


def test_saturation_of_a_robot_whose_target_is_far(on_emulated_gpu):
    """NAO on both feet, a hand pulled away in many directions, slow joints: the velocities of plain JAX."""
    robot = osik.load_robot("nao")
    tasks = {foot: osik.FrameTask(robot, foot, weight=100.0, priority=1) for foot in ("l_sole", "r_sole")}
    hand = osik.FrameTask(robot, "l_gripper", rows="position", priority=2)
    tasks |= {"hand": hand, "posture": osik.PostureTask(robot, weight=1e-3, gain=1.0, priority=3)}
    limits = osik.ConfigurationLimit(robot), osik.VelocityLimit(robot, velocity={"*": 0.3})
    away = np.random.default_rng(1).normal(size=(COUNT, 3))
    points = hand.target[0] + 0.3 * away / np.linalg.norm(away, axis=1, keepdims=True)

    def step(backend, point):
        given = tasks | {"hand": hand.replace(target=(point, hand.target[1]))}
        scheme = osik.NullSpace(method="saturated", backend=backend)
        solution = osik.solve(robot, robot.q0, given, scheme=scheme, limits=limits, dt=0.005)
        return solution.velocity, solution.status, solution.box_violation

    found, expected = (jax.jit(jax.vmap(partial(step, backend)))(points) for backend in ("auto", "jax"))
    np.testing.assert_array_equal(found[1], Status.SOLVED)
    np.testing.assert_allclose(found[0], expected[0], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(found[2], 0.0)
    assert (np.abs(found[0]) > 0.3 - 1e-9).sum() > 2 * COUNT


def test_recorded_saturated_problems_whatever_rounding_does(on_emulated_gpu):
    copies = 16
    p = recorded_saturated(copies)
    check_recorded_saturated(jax.jit(lambda p: null_space_kernel.solve(p, 330))(p), p, copies)


def test_saturation_goes_to_the_largest_scale_there_is(on_emulated_gpu):
    p, largest = recorded_far_saturated(1)
    check_far_saturated(jax.jit(lambda p: null_space_kernel.solve(p, 330))(p), p, largest)


@pytest.mark.parametrize("recorded", [recorded_single_saturated, recorded_turned_signs])
def test_saturation_with_rows_that_were_summed_in_single_precision(recorded, on_emulated_gpu):
    p, largest = recorded(1)
    check_single_saturated(jax.jit(lambda p: null_space_kernel.solve(p, 330))(p), p, largest)


def test_saturation_of_levels_whose_square_matrices_have_no_room_in_shared_memory(on_emulated_gpu, rng):
    """11 rows of 12 variables, damped by what is missed: the matrix is where the projector will be."""
    n, m = 12, 11

    def problem() -> Problem:
        A, wanted = rng.normal(size=(m, n)), rng.normal(size=m)
        terms = Damping(*map(jnp.asarray, (1e-3, 0.8, np.linalg.norm(wanted), np.full(n, 0.01))))
        bound = jnp.full(n, 0.3)
        return pad_levels([Level(A, wanted).scaled()], -bound, bound, jnp.zeros(n), [terms], 1e-9)

    p = jax.tree.map(lambda *a: jnp.stack(a), *(problem() for _ in range(COUNT)))
    found, expected = (jax.jit(lambda p, solve=solve: solve(p, 330))(p) for solve in (null_space_kernel.solve, by_core))
    assert found.done.all()
    assert expected.done.all()
    np.testing.assert_allclose(found.x, expected.x, rtol=0, atol=1e-10)


def test_derivatives_of_saturation(on_emulated_gpu, rng):
    check_derivatives_of_saturation(rng, "auto")

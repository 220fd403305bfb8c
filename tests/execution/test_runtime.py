"""Importing changes nothing in the process; ``configure_cpu`` does, and leaves alone what the user has set."""

import json
import os
import subprocess
import sys
import tomllib
from importlib.metadata import distribution
from pathlib import Path

import pytest

from osik_jax.execution._cpu_settings import _UNTRIED_JAXLIB
from osik_jax.execution._workers import jaxlib_version, splits
from osik_jax.runtime import configure_cpu

OURS = "PJRT_NPROC", "OPENBLAS_NUM_THREADS", "XLA_FLAGS", "JAX_CPU_ENABLE_ASYNC_DISPATCH"
SERIAL = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
STATE = """
import json, os, jax, numpy, scipy.linalg, threadpoolctl
def state():
    blas = [p for p in threadpoolctl.threadpool_info() if p["internal_api"] == "openblas"]
    pools = {p["filepath"]: p["num_threads"] for p in blas}
    return [dict(os.environ), dict(jax.config.values), pools]
"""
IMPORT = f"""{STATE}
import importlib, pkgutil, warnings
before = state()
import osik_jax, osik_jax.cli
after = state()
from osik_jax.runtime import configure_cpu
warnings.simplefilter("ignore")
for module in pkgutil.iter_modules(osik_jax.__path__):
    if module.ispkg:
        importlib.import_module(f"osik_jax.{{module.name}}")
configure_cpu()
print(json.dumps([before, after], default=str))
"""
CONFIGURE = (
    STATE + "from osik_jax.runtime import configure_cpu; configure_cpu(); configure_cpu(); "
    "import jax.numpy as jnp; jnp.zeros(3).block_until_ready(); configure_cpu(); "
    "print(json.dumps(state(), default=str))"
)


def in_a_process(script, **settings):
    env = {k: v for k, v in os.environ.items() if k not in OURS} | settings
    command = [sys.executable, "-c", script]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=300, check=True)


def configured(**settings):
    environment, config, pools = json.loads(in_a_process(CONFIGURE, **settings).stdout)
    lapack = [threads for path, threads in pools.items() if "scipy" in path.split("site-packages")[-1].split("/")[1]]
    return environment, config, lapack


@pytest.mark.slow
def test_an_import_changes_nothing_prints_nothing_and_no_import_computes():
    done = in_a_process(IMPORT, PYTHONWARNINGS="error")  # settings are refused once JAX has made its client
    before, after = json.loads(done.stdout)
    assert before == after
    assert done.stderr == ""


@pytest.mark.slow
def test_a_wide_pool_one_lapack_thread_and_programs_run_where_they_are_called():
    environment, config, lapack = configured()
    assert int(environment.get("PJRT_NPROC", os.cpu_count())) >= 8
    assert environment["XLA_FLAGS"] == SERIAL
    assert lapack == [1]
    assert config["jax_cpu_enable_async_dispatch"] is False


@pytest.mark.slow
def test_the_users_settings_stay():
    chosen = "--xla_cpu_enable_concurrency_optimized_scheduler=true"
    environment, config, lapack = configured(
        PJRT_NPROC="3", OPENBLAS_NUM_THREADS="2", XLA_FLAGS=chosen, JAX_CPU_ENABLE_ASYNC_DISPATCH="1"
    )
    assert (environment["PJRT_NPROC"], environment["XLA_FLAGS"]) == ("3", chosen)
    assert lapack == [min(2, os.cpu_count() or 1)]
    assert config["jax_cpu_enable_async_dispatch"] is True


@pytest.mark.slow
def test_other_flags_stay_beside_ours():
    other = "--xla_cpu_enable_fast_min_max=true"
    assert configured(XLA_FLAGS=other)[0]["XLA_FLAGS"] == f"{other} {SERIAL}"


@pytest.mark.slow
def test_too_late_is_told_and_changes_nothing():
    script = (
        STATE + "import jax.numpy as jnp; jnp.zeros(3); before = state(); from osik_jax.runtime import configure_cpu\n"
        "try: configure_cpu(workers=64)\n"
        "except RuntimeError as error: print(json.dumps([str(error), before == state()]))"
    )
    message, unchanged = json.loads(in_a_process(script).stdout)
    assert "PJRT_NPROC" in message and "XLA_FLAGS" in message and "before the first" in message
    assert unchanged


@pytest.mark.parametrize("workers", [0, 2.5, True])
def test_a_number_of_workers_is_checked(workers):
    with pytest.raises(ValueError, match="workers"):
        configure_cpu(workers=workers)


SIDE_BY_SIDE = """
import os
os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[:2])
import jax, numpy as np
jax.config.update("jax_enable_x64", True)
from osik_jax.solvers import Level, solve_hqp, solve_least_squares_qp, solve_nullspace
def solve(A, b):
    levels = [Level(A[:24], b[:24]), Level(A[24:], b[24:])]
    if SOLVER == "qp":
        return solve_least_squares_qp(A, b, np.ones(48), -np.ones(48), np.ones(48), backend="jax").x
    if SOLVER == "hqp":
        return solve_hqp(levels, -np.ones(48), np.ones(48), backend="auto").x
    return solve_nullspace(levels, backend="auto").x
def again(_, state):
    A, u, v = state
    x, y = jax.vmap(solve)(A, u), jax.vmap(solve)(2.0 * A, v)
    return A, u + 0.0 * x, v + 0.0 * y
A, b = np.random.default_rng(0).normal(size=(64, 48, 48)), np.ones((64, 48))
jax.block_until_ready(jax.jit(lambda *s: jax.lax.fori_loop(0, 20, again, s))(A, b, 2.0 * b))
print("done")
"""


@pytest.mark.release
@pytest.mark.parametrize("solver", ["nullspace", "hqp", "qp"])
def test_batches_side_by_side_wait_for_no_workers(solver):
    """Two cores, nothing configured: null spaces with ``backend="jax"`` wait for ever, as QPs by 16 lanes can."""
    assert in_a_process(f"SOLVER = {solver!r}\n{SIDE_BY_SIDE}").stdout == "done\n"


WITHOUT_WARNINGS = """
import jax
jax.config.update("jax_enable_x64", True)
import osik_jax as osik
osik.runtime.configure_cpu()
robot = osik.load_robot("arm7")
tasks = {"hand": osik.FrameTask(robot, "hand", priority=1), "posture": osik.PostureTask(robot, priority=2)}
for scheme in (osik.HierarchicalQP(), osik.NullSpace(method="saturated")):
    osik.raise_if_failed(osik.solve(robot, robot.q0, tasks, scheme=scheme))
equal = {"hand": osik.FrameTask(robot, "hand"), "posture": osik.PostureTask(robot)}
osik.raise_if_failed(osik.solve(robot, robot.q0, equal, scheme=osik.WeightedQP()))
osik.rollout(robot, robot.q0, tasks, steps=3)
jax.grad(lambda q: osik.solve(robot, q, tasks).velocity.sum())(robot.q0)
"""


@pytest.mark.release
def test_a_program_warns_of_nothing():
    """As ``python -W error`` runs it: a step of each scheme, a rollout, a derivative."""
    done = in_a_process(WITHOUT_WARNINGS, PYTHONWARNINGS="error")
    assert done.stdout + done.stderr == ""


WARNED = """
import os, warnings
os.sched_getaffinity = lambda _: {0, 1}
import jax, jax.numpy as jnp, osik_jax
from osik_jax.solvers import solve_qp
H, g, b = jnp.eye(2), jnp.ones(2), jnp.ones(2)
with warnings.catch_warnings(record=True) as seen:
    warnings.simplefilter("always")
    solve_qp(H, g, -b, b)
    alone = len(seen)
    for _ in range(2):
        jax.vmap(lambda g: solve_qp(H, g, -b, b).x)(jnp.ones((3, 2)))
print(alone, [str(w.message) for w in seen if "configure_cpu" in str(w.message)].__len__())
"""


@pytest.mark.release
def test_batches_on_few_cores_that_are_not_configured_are_warned_of_once():
    assert in_a_process(WARNED).stdout.strip() == f"0 {int(splits(jaxlib_version()))}"
    assert in_a_process(WARNED, PJRT_NPROC="8").stdout.strip() == "0 0"


def test_releases_of_jaxlib_that_wait():
    """As their wheels have it: those that wait name absl's BlockingCounter in jaxlib/cpu/_lapack.so."""
    assert all(map(splits, [(0, 10, 0), (0, 10, 2), (0, 11, 0)]))
    assert not any(map(splits, [(0, 8, 0), (0, 9, 2), (0, 11, 1), (0, 11, 2), (0, 12, 0)]))


def test_this_jaxlib_waits_where_it_is_said_to():
    library = Path(str(distribution("jaxlib").locate_file("jaxlib/cpu/_lapack.so")))
    assert (b"BlockingCounter" in library.read_bytes()) == splits(jaxlib_version())


def test_flags_are_set_for_every_jax_that_may_be_installed():
    """A flag that XLA does not know ends the process, so a new jax is tried with ours before it is allowed."""
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    (bounds,) = [d.removeprefix("jax").split(",") for d in project["dependencies"] if d.startswith("jax>")]
    major, minor = _UNTRIED_JAXLIB
    assert f"<{major}.{minor}" in bounds

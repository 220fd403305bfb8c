"""What importing the package does to the CPU runtime, and that it leaves alone what the user has set."""

import json
import os
import subprocess
import sys
import tomllib
from pathlib import Path

from osik_jax._runtime import _UNTRIED_JAXLIB

PROBE = """
import json, os, numpy, osik_jax, threadpoolctl
pools = {p["filepath"]: p["num_threads"] for p in threadpoolctl.threadpool_info() if p["internal_api"] == "openblas"}
print(json.dumps([os.environ["PJRT_NPROC"], os.environ.get("XLA_FLAGS", ""), pools]))
"""


def runtime(**settings):
    ours = "PJRT_NPROC", "OPENBLAS_NUM_THREADS", "XLA_FLAGS"
    env = {k: v for k, v in os.environ.items() if k not in ours} | settings
    done = subprocess.run([sys.executable, "-c", PROBE], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.count("\n") == 1  # nothing else is printed, by us or by MJX
    workers, flags, pools = json.loads(done.stdout)
    lapack = [threads for path, threads in pools.items() if "scipy" in path.split("site-packages")[-1].split("/")[1]]
    return int(workers), flags, lapack


def test_a_wide_pool_and_one_lapack_thread_by_default():
    workers, flags, lapack = runtime()
    assert workers >= 8
    assert flags == "--xla_cpu_enable_concurrency_optimized_scheduler=false"
    assert lapack == [1]


def test_the_users_settings_stay():
    chosen = "--xla_cpu_enable_concurrency_optimized_scheduler=true"
    workers, flags, lapack = runtime(PJRT_NPROC="3", OPENBLAS_NUM_THREADS="2", XLA_FLAGS=chosen)
    assert (workers, flags) == (3, chosen)
    assert lapack == [min(2, os.cpu_count() or 1)]


def test_programs_run_where_they_are_called_unless_set_back_after_the_import():
    probe = """
import jax, osik_jax, jax.numpy as jnp, sys
if "back" in sys.argv: jax.config.update("jax_cpu_enable_async_dispatch", True)
program, x = jax.jit(jnp.linalg.inv), jnp.eye(1200)
jax.block_until_ready(program(x))
print(program(x).is_ready())
"""
    for argument, done_on_return in (("", True), ("back", False)):
        done = subprocess.run([sys.executable, "-c", probe, argument], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == str(done_on_return)


def test_other_flags_stay_beside_ours():
    other = "--xla_cpu_enable_fast_min_max=true"
    assert runtime(XLA_FLAGS=other)[1] == f"{other} --xla_cpu_enable_concurrency_optimized_scheduler=false"


def test_flags_are_set_for_every_jax_that_may_be_installed():
    """A flag that XLA does not know ends the process, so a new jax is tried with ours before it is allowed."""
    project = tomllib.loads((Path(__file__).parent.parent / "pyproject.toml").read_text())["project"]
    (bounds,) = [d.removeprefix("jax").split(",") for d in project["dependencies"] if d.startswith("jax>")]
    major, minor = _UNTRIED_JAXLIB
    assert f"<{major}.{minor}" in bounds

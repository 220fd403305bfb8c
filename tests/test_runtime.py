"""What importing the package does to the CPU runtime, and that it leaves alone what the user has set."""

import json
import os
import subprocess
import sys

PROBE = """
import json, os, numpy, osik_jax, threadpoolctl
pools = {p["filepath"]: p["num_threads"] for p in threadpoolctl.threadpool_info() if p["internal_api"] == "openblas"}
print(json.dumps([os.environ["PJRT_NPROC"], pools]))
"""


def runtime(**settings):
    env = {k: v for k, v in os.environ.items() if k not in ("PJRT_NPROC", "OPENBLAS_NUM_THREADS")} | settings
    done = subprocess.run([sys.executable, "-c", PROBE], env=env, capture_output=True, text=True, check=True)
    assert done.stdout.count("\n") == 1  # nothing else is printed, by us or by MJX
    workers, pools = json.loads(done.stdout)
    lapack = [threads for path, threads in pools.items() if "scipy" in path.split("site-packages")[-1].split("/")[1]]
    return int(workers), lapack


def test_a_wide_pool_and_one_lapack_thread_by_default():
    workers, lapack = runtime()
    assert workers >= 8
    assert lapack == [1]


def test_the_users_settings_stay():
    workers, lapack = runtime(PJRT_NPROC="3", OPENBLAS_NUM_THREADS="2")
    assert workers == 3
    assert lapack == [min(2, os.cpu_count() or 1)]

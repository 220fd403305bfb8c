"""Shared by all tests: double precision, quick compilation, one seed, compiled programs dropped after each file."""

import os
import shutil
from collections.abc import Iterator
from importlib.metadata import version
from importlib.util import find_spec

# Most of the suite's time is XLA's: without its optimiser and with its older fusions compiling takes a quarter of that.
# The gate runs the recorded problems and the demos as users do.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    # jaxlib 0.11 does not know this one, and unknown flags end the process
    + (" --xla_cpu_use_fusion_emitters=false" if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11) else ""),
)

import jax
import numpy as np
import pytest

from osik_jax.runtime import configure_cpu

configure_cpu()
jax.config.update("jax_enable_x64", True)


WITH_TORCH = "test_beside_pytorch_kinematics.py"
WITH_BROWSER = "test_live_browser.py"
NOT_INSTALLED = {} if find_spec("pytorch_kinematics") else {WITH_TORCH: "pytorch-kinematics"}
if not (shutil.which("chromium") and find_spec("playwright")):
    NOT_INSTALLED[WITH_BROWSER] = "chromium or playwright"
collect_ignore = list(NOT_INSTALLED)


def pytest_report_header() -> list[str]:
    """Says with which JAX, and what is left out where an oracle or a browser is not installed."""
    without = [f"NOT RUN, for {missing} is not installed: {name}" for name, missing in NOT_INSTALLED.items()]
    return [f"jax {version('jax')}, jaxlib {version('jaxlib')}, mujoco {version('mujoco')}", *without]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Keeps memory flat: hundreds of compiled programs would stay until the end."""
    yield
    jax.clear_caches()

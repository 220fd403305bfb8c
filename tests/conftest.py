"""Shared by all tests: double precision, quick compilation that is not done twice, one seed, memory that stays flat."""

import atexit
import contextlib
import ctypes
import gc
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator
from importlib.metadata import version
from importlib.util import find_spec
from pathlib import Path

# Most of the suite's time is XLA's: without its optimiser and with its older fusions compiling takes a quarter of that.
# The gate runs the recorded problems and the demos as users do.
os.environ.setdefault(
    "XLA_FLAGS",
    "--xla_backend_optimization_level=0 --xla_llvm_disable_expensive_passes=true"
    " --xla_cpu_parallel_codegen_split_count=1"  # both cores are in use: parts of a program compile no sooner
    # jaxlib 0.11 does not know this one, and unknown flags end the process
    + (" --xla_cpu_use_fusion_emitters=false" if tuple(map(int, version("jaxlib").split(".")[:2])) < (0, 11) else ""),
)

# A program that was compiled before is read from a folder, which all files and processes of a run share.
if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
    os.environ["JAX_COMPILATION_CACHE_DIR"] = tempfile.mkdtemp(prefix="osik-tests-")
    atexit.register(shutil.rmtree, os.environ["JAX_COMPILATION_CACHE_DIR"], ignore_errors=True)
# So are Python's own compiled files, where none may be written beside the sources.
if sys.dont_write_bytecode:
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = str(
        Path(os.environ["JAX_COMPILATION_CACHE_DIR"]) / "python"
    )
os.environ.setdefault("JAX_PLATFORMS", "cpu")  # also beside a GPU, whose kernels have tests of their own
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_ENTRY_SIZE_BYTES", "-1")
os.environ.setdefault("JAX_TRACEBACK_IN_LOCATIONS_LIMIT", "0")  # programs without the lines that they come from

import jax
import numpy as np
import pytest

import osik_jax as osik
from osik_jax.core import _build
from osik_jax.runtime import configure_cpu

configure_cpu()
jax.config.update("jax_enable_x64", True)
# Tracing makes many objects that stay; looking for garbage among them, as often as by default, is 6 % of the time.
gc.set_threshold(50_000, 20, 20)


MOST_MEMORY = 4 * 2**30
"""What a process may hold after a file of tests, in bytes, before it drops its compiled programs."""
WITH_TORCH = "kinematics/test_beside_pytorch_kinematics.py"
WITH_BROWSER = "viewer/test_live_browser.py"
UNKNOWN_VARIANTS: list[tuple[str, str]] = []
"""Tests and variants that are marked and do not exist."""
NOT_INSTALLED = {} if find_spec("pytorch_kinematics") else {WITH_TORCH: "pytorch-kinematics"}
if not (shutil.which("chromium") and find_spec("playwright")):
    NOT_INSTALLED[WITH_BROWSER] = "chromium or playwright"
collect_ignore = list(NOT_INSTALLED)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Marks single variants of a test as slow or for releases: ``@pytest.mark.variants(slow=[...], release=[...])``.

    With ``ordinary=[...]`` all variants that are not named are for releases.
    """
    named, found = set(), set()
    for item in items:
        test, variant = item.nodeid.removesuffix("]").partition("[")[::2]
        for tiers in [mark.kwargs for mark in item.iter_markers("variants")]:
            named |= {(test, name) for ids in tiers.values() for name in ids}
            tier = next((tier for tier, ids in tiers.items() if variant in ids), None)
            if tier is not None:
                found.add((test, variant))
            elif "ordinary" in tiers:
                tier = "release"
            if tier in ("slow", "release"):
                item.add_marker(tier)
    if not config.getoption("lf", False) and not any("::" in argument for argument in config.args):
        UNKNOWN_VARIANTS.extend(sorted(named - found))  # otherwise only some are collected
    gc.freeze()  # what was imported stays: looking for garbage among it again and again is some percent of the time


def pytest_configure(config: pytest.Config) -> None:
    """Compile the core of a checkout whose C++ files have changed since its library was built."""
    if hasattr(config, "workerinput") or "OSIK_CORE_LIBRARY" in os.environ or "site-packages" in str(_build.FOLDER):
        return
    with contextlib.suppress(RuntimeError):  # no compiler: tests of the core are skipped
        _build.build_if_changed()


def pytest_report_header() -> list[str]:
    """Says with which JAX, and what is left out where an oracle or a browser is not installed."""
    without = [f"NOT RUN, for {missing} is not installed: {name}" for name, missing in NOT_INSTALLED.items()]
    return [f"jax {version('jax')}, jaxlib {version('jaxlib')}, mujoco {version('mujoco')}", *without]


def pytest_sessionfinish() -> None:
    """Has nobody look for garbage among all that there is when it goes anyway."""
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def marked_variants_exist() -> None:
    assert UNKNOWN_VARIANTS == []


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20240229)


@pytest.fixture(scope="session")
def arm() -> osik.Robot:
    """The embedded arm of seven joints."""
    return osik.load_robot("arm7")


@pytest.fixture(scope="session")
def nao() -> osik.Robot:
    """The embedded NAO."""
    return osik.load_robot("nao")


@pytest.fixture(autouse=True)
def restore_settings() -> Iterator[None]:
    """Puts back what a notebook, a page or an example sets for the whole process: figure style and precision."""
    matplotlib = sys.modules.get("matplotlib")
    with matplotlib.rc_context() if matplotlib else contextlib.nullcontext():
        yield
    jax.config.update("jax_enable_x64", True)


@pytest.fixture(autouse=True, scope="module")
def forget_programs() -> Iterator[None]:
    """Keeps memory within bounds: the compiled programs of all files would stay until the end."""
    yield
    if memory_in_use() > MOST_MEMORY:
        jax.clear_caches()
        with contextlib.suppress(AttributeError, OSError, TypeError):  # only glibc keeps what was freed
            ctypes.CDLL(None).malloc_trim(0)


def memory_in_use() -> int:
    """What this process holds, in bytes; more than any bound where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except OSError:
        return MOST_MEMORY + 1
    return pages * os.sysconf("SC_PAGE_SIZE")

"""The core built with AddressSanitizer and UndefinedBehaviorSanitizer: tests of its solvers find nothing to say."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from osik_jax.core import _build

SANITIZED = (
    *("test_core_qps.py::test_recorded_problems", "test_core_qps.py::test_lane_by_lane_as_the_plain_method"),
    *("test_core_qps.py::test_lanes_that_are_left_to_the_search", "test_core_hard_data.py"),
    *("test_core_hierarchies.py::test_recorded_hierarchies", "test_core_null_space.py::test_recorded_problems"),
    *("test_core_plans.py", "test_core_kinematics.py"),
)


def sanitizers(compiler: str) -> str:
    """Return the libraries that a process which loads the core has to load first; "" where there are none."""
    found = [
        subprocess.run([compiler, f"-print-file-name=lib{name}.so"], capture_output=True, text=True).stdout.strip()
        for name in ("asan", "ubsan")
    ]
    return " ".join(found) if all(Path(path).is_absolute() for path in found) else ""


@pytest.mark.slow
def test_sanitizers_find_nothing(tmp_path):
    compiler = shutil.which(os.environ.get("CXX") or "c++")
    preload = sanitizers(compiler) if compiler and sys.platform == "linux" else ""
    if not preload:
        pytest.skip("needs a compiler with libasan and libubsan")
    library = tmp_path / "core.so"
    flags = ["-std=c++20", "-O1", "-g", "-Wno-psabi", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined"]
    text = [str(path) for path in _build.sources() if path.suffix == ".cpp"]
    command = [str(compiler), *flags, '-DOSIK_SOURCES="sanitized"', "-shared", "-fPIC", *text, "-o", str(library)]
    subprocess.run(command, check=True)
    here = Path(__file__).parent
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *SANITIZED],
        cwd=here,
        env=os.environ | dict(LD_PRELOAD=preload, OSIK_CORE_LIBRARY=str(library), ASAN_OPTIONS="detect_leaks=0"),
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, (ran.stdout + ran.stderr)[-4000:]
    assert " passed" in ran.stdout

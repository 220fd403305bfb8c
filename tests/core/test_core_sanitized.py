"""Tests of the core's solvers, with the core built by AddressSanitizer and UndefinedBehaviorSanitizer."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from core_checks import compile_core, run_tests_with

SOME = (
    "core/test_core_qps.py::test_recorded_problems",
    "core/test_core_hierarchies.py::test_recorded_hierarchies",
    "core/test_core_null_space.py::test_as_numpy",
    "core/test_core_null_space.py::test_saturation_of_recorded_problems_whatever_rounding_does",
    "core/test_core_plans.py::test_the_centre_of_mass_is_kept_as_by_the_plain_method",
    "kinematics/test_core_kinematics.py::test_beside_the_plain_method",
    "control/test_compiled_step.py::test_the_core_answers_as_plain_jax_does",
    "control/test_compiled_step.py::test_numbers_that_are_not_valid_are_answered_as_by_plain_jax",
)
ALL = (
    *("-m", ""),  # slow ones too
    *("core/test_core_qps.py", "core/test_core_hierarchies.py", "core/test_core_null_space.py"),
    *("core/test_core_hard_data.py", "core/test_core_plans.py", "kinematics/test_core_kinematics.py"),
)


def sanitizers(compiler: str) -> str:
    """Return the libraries that a process which loads the core has to load first; "" if there are none."""
    found = [
        subprocess.run([compiler, f"-print-file-name=lib{name}.so"], capture_output=True, text=True).stdout.strip()
        for name in ("asan", "ubsan")
    ]
    return " ".join(found) if all(Path(path).is_absolute() for path in found) else ""


@pytest.mark.release
@pytest.mark.parametrize("tests", [SOME, ALL], ids=["some", "all"])
def test_sanitizers_find_nothing(tests, tmp_path):
    compiler = shutil.which(os.environ.get("CXX") or "c++")
    preload = sanitizers(compiler) if compiler and sys.platform == "linux" else ""
    if not preload:
        pytest.skip("needs a compiler with libasan and libubsan")
    library = tmp_path / "core.so"
    flags = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")
    compile_core(str(compiler), library, *flags)
    # leaks are those of Python and XLA
    run_tests_with(library, tests, LD_PRELOAD=preload, ASAN_OPTIONS="detect_leaks=0")

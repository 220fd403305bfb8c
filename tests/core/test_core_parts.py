"""The core's linear algebra, layouts, rotations and file reader beside plain sums, in C++ and under sanitizers."""

import subprocess
from pathlib import Path

import pytest
from core_checks import compiler

from osik_jax.core import _build
from osik_jax.core._library import core

PROGRAM = Path(__file__).parents[1] / "support" / "core_parts.cpp"
SANITIZERS = ("-fsanitize=address,undefined", "-fno-sanitize-recover=undefined")


def ran(folder: Path, *flags: str) -> int:
    """Compile the program and return how many comparisons it made."""
    command = [compiler("g++"), *_build._FLAGS, "-g", "-Wall", "-Wextra", "-Werror", f"-I{_build.FOLDER}"]
    subprocess.run([*command, *flags, PROGRAM, "-o", folder / "parts"], check=True)
    done = subprocess.run([folder / "parts"], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]
    return int(done.stdout)


@pytest.mark.variants(slow=["narrow"], release=["wide"])
@pytest.mark.parametrize("packs", ["narrow", "wide"])
def test_parts_are_right_and_sanitizers_find_nothing(packs, tmp_path):
    """Packs of columns are as wide as the instruction set has them."""
    found = core().path
    if packs == "wide" and not (found and "v3" in found.name):
        pytest.skip("THE WIDE PACKS ARE NOT TESTED: this processor has no AVX2")
    flags = ("-O1", *_build.levels()["x86_64_v3"]) if packs == "wide" else ("-O0",)
    assert ran(tmp_path, *flags, *SANITIZERS) > 90_000

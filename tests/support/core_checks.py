"""Marks and helpers for tests of the compiled core."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from osik_jax.core import _build
from osik_jax.core._library import core

needs_core = pytest.mark.skipif(core().library is None, reason=core().reason)


def compiler(name: str) -> str:
    """Return the path of g++ or clang++, perhaps with a version in its name; skip the test where there is none."""
    folders = map(Path, os.environ["PATH"].split(os.pathsep))
    numbered = sorted(str(path) for folder in folders for path in folder.glob(f"{name}-[0-9]*"))
    path = shutil.which(name) or next(iter(numbered), None)
    return path or pytest.skip(f"THE CORE IS NOT COMPILED BY {name}, which is not installed")


def run_tests_with(library: Path, tests: tuple[str, ...], **env: str) -> None:
    """Run tests in another process, which loads this library as the core."""
    ran = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-n", "0", "-p", "no:cacheprovider", *tests],
        cwd=Path(__file__).parents[1],
        env=os.environ | {"OSIK_CORE_LIBRARY": str(library)} | env,
        capture_output=True,
        text=True,
    )
    assert ran.returncode == 0, (ran.stdout + ran.stderr)[-4000:]
    assert " passed" in ran.stdout


def compile_core(compiler: str, library: Path, *flags: str) -> None:
    """Compile the core to a library of this path."""
    done = subprocess.run(_build.command(compiler, library, *flags), capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-4000:]

"""The compiled core as a library: constants, which file is loaded, and what is said where there is none."""

import os
import re
import subprocess
import sys

import numpy as np
from core_checks import needs_core

from osik_jax.core import _build
from osik_jax.numerics import _constants


def test_constants_are_those_of_python():
    text = (_build.FOLDER / "constants.hpp").read_text()
    found = {name: float(value) for name, value in re.findall(r"([A-Z_0-9]+) = ([-+.0-9e]+)[,;]", text)}
    assert len(found) > 8
    single = dict(
        SINGLE_CORRECTION="LAST_CORRECTION",
        SINGLE_RIDGE="KKT_RIDGE",
        SINGLE_BOUND_MULTIPLIER="BOUND_MULTIPLIER",
    )
    for name, value in found.items():
        there, kind = getattr(_constants, single.get(name) or name), "float32" if name in single else "float64"
        assert value == (there[np.dtype(kind)] if isinstance(there, dict) else there), name


@needs_core
def test_a_library_of_other_sources_is_refused(tmp_path, monkeypatch):
    from osik_jax.core import _library

    monkeypatch.setattr(_build, "fingerprint", lambda: "another state")
    core = _library.core.__wrapped__()
    assert core.library is None and "built from other sources" in core.reason and "_build" in core.reason


@needs_core
def test_a_library_is_built_again_where_its_sources_changed_or_it_cannot_be_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(_build, "build", lambda: "built")
    there = _build.build_if_changed()
    assert there == [_build.library_path(level) for level in _build.levels()]
    with monkeypatch.context() as patch:
        patch.setattr(_build, "fingerprint", lambda: "another state")
        assert _build.build_if_changed() == "built"
    broken = tmp_path / "core.so"
    broken.write_text("no library")
    for path in (broken, tmp_path / "none.so"):
        monkeypatch.setattr(_build, "library_path", lambda level, path=path: path)
        assert _build.build_if_changed() == "built"


def test_without_the_core_a_warning_says_what_to_do():
    code = "import jax, osik_jax; from osik_jax.solvers import Level, solve_hqp; import jax.numpy as jnp, numpy as np;"
    code += "one = jnp.ones(2); print(solve_hqp([Level(jnp.eye(2), one)], -one, one).x)"
    code = f"from osik_jax.core import _build; _build.library_path = lambda level: _build.FOLDER / 'none.so'; {code}"
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=os.environ)
    assert "[1. 1.]" in ran.stdout
    assert ran.stderr.count("OsikWarning") == 1 and "install a C++ compiler" in ran.stderr


def test_a_compiler_that_fails_is_named(monkeypatch):
    monkeypatch.setenv("CXX", "false")
    monkeypatch.setattr(_build, "library_path", lambda level: _build.FOLDER / f"never_{level}.so")
    try:
        _build.build()
    except RuntimeError as problem:
        assert "false failed with status 1" in str(problem)
    else:
        raise AssertionError("a compiler that fails has to be an error")

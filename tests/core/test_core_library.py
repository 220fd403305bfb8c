"""The compiled core as a library: constants, which file is loaded, and what is said where there is none."""

import re
import shutil
import subprocess
from pathlib import Path

import jax
import numpy as np
import pytest
from core_checks import compile_core, compiler, needs_core, run_tests_with
from refusals import refuses

from osik_jax import OsikWarning
from osik_jax.core import _build, _library
from osik_jax.core._library import core
from osik_jax.numerics import _constants
from osik_jax.solvers import Level, solve_hqp

SOLVES = (
    "core/test_core_qps.py::test_recorded_problems",
    "core/test_core_hierarchies.py::test_recorded_hierarchies",
    "core/test_core_null_space.py::test_as_numpy",
    "kinematics/test_core_kinematics.py::test_beside_the_plain_method",
    "control/test_compiled_step.py::test_the_core_answers_as_plain_jax_does",
)


def test_constants_are_those_of_python():
    """Of those that both have; those of kernels alone are in one place."""
    shared, alone = (
        {name: float(value) for name, value in re.findall(r"([A-Z_0-9]+) = ([-+.0-9e]+)[,;]", part)}
        for part in (_build.FOLDER / "constants.hpp").read_text().split("// ---- of kernels alone")
    )
    assert len(shared) > 40 and len(alone) > 15 and not any(hasattr(_constants, name) for name in alone)
    single = dict(
        SINGLE_CORRECTION="LAST_CORRECTION",
        SINGLE_RIDGE="KKT_RIDGE",
        SINGLE_BOUND_MULTIPLIER="BOUND_MULTIPLIER",
        SINGLE_INFEASIBLE_COMPLIANCE="INFEASIBLE_COMPLIANCE",
    )
    for name, value in shared.items():
        there, kind = getattr(_constants, single.get(name) or name), "float32" if name in single else "float64"
        assert value == (there[np.dtype(kind)] if isinstance(there, dict) else there), name


@needs_core
def test_a_library_of_other_sources_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(_build, "fingerprint", lambda: "another state")
    found = _library.core.__wrapped__()
    assert found.library is None and "built from other sources" in found.reason and "_build" in found.reason


@needs_core
def test_a_library_is_built_again_where_its_sources_changed_or_it_cannot_be_loaded(tmp_path, monkeypatch):
    monkeypatch.setattr(_build, "build", lambda: "built")
    there = _build.build_if_changed()
    assert there == [_build.library_path(level) for level in _build.levels()]
    older = Path(shutil.copy(there[-1], tmp_path / "older.so"))
    with monkeypatch.context() as patch:
        patch.setattr(_build, "fingerprint", lambda: "another state")
        patch.setattr(_build, "library_path", lambda level: older)
        assert _build.build_if_changed() == "built"
    maps = Path("/proc/self/maps")  # loaded, it would stay in place of the new one
    assert not maps.exists() or str(older) not in maps.read_text()
    broken = tmp_path / "core.so"
    broken.write_text("no library")
    for path in (broken, tmp_path / "none.so"):
        monkeypatch.setattr(_build, "library_path", lambda level, path=path: path)
        assert _build.build_if_changed() == "built"


@needs_core
def test_arrays_of_another_type_or_with_too_few_axes_are_an_error():
    matrix, numbers = np.ones((1, 2, 3)), np.full(1, 1e-9)
    shapes = [jax.ShapeDtypeStruct(shape, np.float64) for shape in ((1, 2, 3), (1, 4, 2), (1, 2, 2))]
    call = jax.ffi.ffi_call(_library.register("row_factors"), shapes)
    assert np.isfinite(call(matrix, numbers, 0.0 * numbers)[0]).all()
    wrong = {
        "another type": (matrix.astype(np.float32), numbers, numbers),
        "too few axes": (matrix[0], numbers, numbers),
        "too few arrays": (matrix, numbers),
    }
    for message, given in wrong.items():
        with pytest.raises(jax.errors.JaxRuntimeError, match=message):
            jax.block_until_ready(call(*given))


def test_without_the_core_a_warning_says_what_to_do(monkeypatch):
    monkeypatch.setattr(_build, "library_path", lambda level: _build.FOLDER / "none.so")
    monkeypatch.setattr(_library, "core", _library.core.__wrapped__)
    _library._warn_once.cache_clear()
    one = np.ones(2)
    with pytest.warns(OsikWarning, match=r"install a C\+\+ compiler") as caught:
        x = jax.jit(lambda b: solve_hqp([Level(np.eye(2), b)], -one, one).x)(one)
    np.testing.assert_allclose(x, one)
    assert len(caught) == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["g++", "clang++"])
def test_each_compiler_takes_all_of_the_core_without_a_warning(name):
    texts = [*_build.FOLDER.glob("*.cpp"), *_build.FOLDER.glob("c/*.cpp")]
    flags = (*_build._FLAGS, '-DOSIK_SOURCES=""', "-Wall", "-Wextra", "-Werror", "-fsyntax-only")
    done = subprocess.run([compiler(name), *flags, *texts], capture_output=True, text=True)
    assert len(texts) > 8 and done.returncode == 0, done.stderr[-4000:]


@pytest.mark.release
def test_a_core_by_clang_solves_as_plain_jax_does(tmp_path):
    own, library = core().path, tmp_path / "core.so"
    flags = _build.levels().get(own.stem.removeprefix("_core_"), []) if own else []
    compile_core(compiler("clang++"), library, *flags, "-Wall", "-Wextra", "-Werror")
    run_tests_with(library, SOLVES)


def test_a_compiler_that_fails_is_named(monkeypatch):
    monkeypatch.setenv("CXX", "false")
    monkeypatch.setattr(_build, "library_path", lambda level: _build.FOLDER / f"never_{level}.so")
    refuses(RuntimeError, "false failed with status 1", _build.build)

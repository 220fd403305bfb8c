"""The CUDA text of the core: one text without includes, which NVRTC takes where it is installed."""

import ctypes
from itertools import pairwise

import pytest
from core_checks import needs_core

from osik_jax.core import _cuda
from osik_jax.retargeting import _banded as banded
from osik_jax.solvers.hqp import _core as hierarchy
from osik_jax.solvers.hqp._problem import Layout
from osik_jax.solvers.null_space import _cuda as null_space
from osik_jax.solvers.qp import _core as weighted_qp

NAO = Layout(3, 2, 2, (2, 1), (-1, -1, -1, 1), ((4, 4), (3, 4)))
"""Two levels of three variables; the second has one inequality row."""

PLACED = (2, 3, 3), (2, 3, 3, 3), (2, 7, 3), (2, 7, 3), (2, 7, 3)
"""Kinematics of three bodies and seven dofs."""
CENTER = (*PLACED, (1, 50), (9,), (2, 9))
POSE = (2, 3), (2, 3, 3), (2, 6, 7), (1, 25), (8,)
CHAIN = (2, 7), (2, 1, 12), (1, 347), (38,)
"""Steps of a search for the pose of a frame that seven joints carry."""
ROWS = (2, 6), (2, 6, 7), (2, 6), (2,), (2, 6), (2, 7), (2, 6)
"""Rows of a pose task or of one on the centre of mass, for seven dofs."""
FIND = ((2, 1, 12), (2, 1), (1, 500), (60,), (12,), (2, 7)), (1, 3, 4, 5)
SCENE = (300,), (1, 900), (2, 121), (2, 100)
"""A robot with shapes, and scenes of their own for all lanes."""
FREE = (
    ((2, 1, 12), (2, 1), (1, 500), (60,), (12,), (2, 7), *SCENE, (1,)),
    (1, 3, 4, 5, 6, 8),
    ((2, 9), (2, 9), (2, 12), (2, 10), (2, 3)),
)
PLACES = ((2, 9), (1, 300), *SCENE[1:]), (1, 3)
NEAR = ((*PLACED, *SCENE, (1, 5), (1,)), (5, 7, 10))
NEAREST = (2, 4, 7), (2, 4), (2, 4), (2, 4, 4)
"""Rows of the four nearest pairs."""


def test_headers_become_one_text_whose_loops_stay_loops():
    text = _cuda.text_of("hierarchy.hpp")
    assert "#include" not in text and "#pragma once" not in text and "struct Serial" not in text
    assert text.count("struct Warp :") == 1
    lines = [line.strip() for line in text.splitlines()]
    loops = [before for before, line in pairwise(lines) if line.startswith(("for (", "while ("))]
    assert len(loops) > 30 and all("unroll" in before.lower() for before in loops)


TEXTS = {
    "hierarchy": lambda: hierarchy._source(NAO, 50),
    "weighted QP, double": lambda: weighted_qp._source(5, 7, 2, False, 100, 1),
    "weighted QP, single": lambda: weighted_qp._source(5, 7, 0, True, 100, 4),
    "more rows than variables": lambda: weighted_qp._source(40, 33, 3, False, 100, 1),
    "more than 32 variables": lambda: weighted_qp._source(5, 35, 2, True, 100, 1),
    "more than 64 variables": lambda: weighted_qp._source(5, 70, 2, True, 100, 1),
    "saturated null space": lambda: null_space._source("saturation", 7, (6, 6, 6), 2, 100),
    "classical projection": lambda: null_space._source("projection", 35, (12, 3, 3), 2),
    "bodies": lambda: _cuda._lanes_source(
        "kinematics", True, ((2, 8), (1, 90), (40,)), (2,), ((2, 3, 3), *[(2, 2, 3)] * 4)
    ),
    "frames": lambda: _cuda._lanes_source(
        "moving_frames", False, (*PLACED, (1, 50), (9,)), (6,), ((2, 1, 3), (2, 1, 6, 7))
    ),
    "centre of mass": lambda: _cuda._lanes_source("center_rows", True, CENTER, (6,), ROWS, (), 33),
    "rows of a frame": lambda: _cuda._lanes_source("frame_rows", True, (*PLACED, (1, 19), (2, 25), (16,)), (7,), ROWS),
    "rows of a pose": lambda: _cuda._lanes_source("pose_rows", True, POSE, (4,), ROWS),
    "chain": lambda: _cuda._lanes_source("chain_steps", True, CHAIN, (3,), ((2, 7), (2, 7), (2, 4)), (), 227),
    "searches": lambda: _cuda._lanes_source("chain_find", True, *FIND, ((2, 9), (2, 9), (2, 12)), (2,), 400),
    "searches in scenes": lambda: _cuda._lanes_source("free_find", False, *FREE, (2, 4), 900),
    "clearances": lambda: _cuda._lanes_source("clearances", True, *PLACES, ((2, 10), (2, 2)), (1,), 400),
    "rows of near pairs": lambda: _cuda._lanes_source("near_rows", False, *NEAR, NEAREST, (3,), 400),
    "their geometry": lambda: _cuda._lanes_source(
        "near_geometry", True, *NEAR, (*NEAREST, (2, 4, 29), (2, 4)), (3, 5), 400
    ),
    "banded": lambda: banded.kernel_source(13, 2),
}


@needs_core
@pytest.mark.parametrize("name", TEXTS)
def test_nvrtc_compiles_every_text(name):
    path = _cuda.nvrtc()
    if path is None:
        pytest.skip("NVRTC is not installed")
    nvrtc, program = ctypes.CDLL(path), ctypes.c_void_p()
    assert nvrtc.nvrtcCreateProgram(ctypes.byref(program), TEXTS[name]().encode(), b"osik.cu", 0, None, None) == 0
    options = b"--gpu-architecture=sm_90", b"--std=c++20", b"--device-as-default-execution-space"
    assert nvrtc.nvrtcCompileProgram(program, 3, (ctypes.c_char_p * 3)(*options)) == 0


@needs_core
@pytest.mark.parametrize("shared, capability, fit", [(227, 9, True), (99, 8, False), (227, 7, False)])
def test_what_does_not_fit_a_device_is_left_to_plain_jax(shared, capability, fit, monkeypatch):
    device = {_cuda._SHARED_BYTES: shared * 1024, _cuda._CAPABILITY: capability}
    monkeypatch.setattr(_cuda, "_attribute", device.get)
    monkeypatch.setattr(_cuda, "nvrtc", lambda: "libnvrtc.so")
    levels = Layout(64, 3, 64, (64, 64, 0), (-1,) * 64, ())
    assert null_space.fits(64, (64,)) == hierarchy.fits(levels) == fit
    assert null_space.fits(7, (3, 3)) == (capability >= 8)


@pytest.mark.parametrize("shared, blocks", [(227, 9), (99, 4), (20, 1)])
def test_blocks_are_as_many_as_have_room_in_the_shared_memory_of_a_multiprocessor(shared, blocks, monkeypatch):
    monkeypatch.setattr(_cuda, "_attribute", {_cuda._SHARED_BYTES: shared * 1024}.get)
    assert _cuda.blocks_beside(24 * 1024) == blocks and _cuda.blocks_beside(0) == 16


def test_a_device_that_is_not_known_is_asked_for_nothing():
    if _cuda._attribute(_cuda._CAPABILITY) is None:  # no driver
        assert _cuda.shared_bytes() == 227 * 1024

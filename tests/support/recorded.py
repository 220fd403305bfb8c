"""Recorded problems with oracle answers: a subset in tests/data, or all of them from the folder in OSIK_REFERENCE."""

from __future__ import annotations

import os
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from osik_jax.numerics._constants import PART
from osik_jax.solvers import Damping
from osik_jax.solvers._level import PaddedLevel
from osik_jax.solvers.null_space._implicit_diff import SaturatedResult
from osik_jax.solvers.null_space._padding import Problem

DATA = Path(__file__).parents[1] / "data"
FULL = os.environ.get("OSIK_REFERENCE")
QP_DAMPING = 1e-9


class RecordedQPs(NamedTuple):
    """Whole-body QPs, min 1/2 |A x - b|^2 + damping/2 |x|^2 in a box, solved by daqp and polished in float64."""

    A: np.ndarray
    b: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    solution: np.ndarray
    regime: np.ndarray  # 0 standard run, 1 tight velocity limits, 2 near joint limits, 3 stretched legs


def recorded_qps(robot: str) -> RecordedQPs:
    """128 problems of ``robot`` ("g1" or "nao"), or all 1,024."""
    if FULL:
        z = np.load(Path(FULL) / f"qps_{robot}.npz")
        return RecordedQPs(*(z[k] for k in ("A", "b", "lb", "ub", "solution", "regime")))
    z = np.load(DATA / f"qps_{robot}.npz")
    count, _, n = z["A"].shape
    posture = np.zeros((n - 6, n))
    posture[:, 6:] = 0.05 * np.eye(n - 6)
    A = np.concatenate([z["A"], np.broadcast_to(posture, (count, *posture.shape))], 1)
    return RecordedQPs(A, *(z[k] for k in ("b", "lb", "ub", "solution", "regime")))


class RecordedHierarchies(NamedTuple):
    """NAO's feet, CoM (inequality), hand and posture; residual norms of each level certified in float64."""

    levels: list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # matrix, lower, upper, batched
    lower: np.ndarray
    upper: np.ndarray
    residual_norm: np.ndarray  # (256, 4)
    kind: np.ndarray  # 0 easy, 1 conflicting, 2 near-singular stretched legs, 3 unreachable


def recorded_hierarchies(unit_rows: bool) -> RecordedHierarchies:
    """All 256 hierarchies, rows as they are or scaled to unit length."""
    z = np.load(DATA / "hqp_nao.npz")
    posture = np.zeros((26, 32))
    posture[:, 6:] = np.eye(26)
    matrices = [z["A1"], z["A2"], z["A3"], np.broadcast_to(posture, (len(z["lb"]), 26, 32))]
    levels = []
    for k, A in enumerate(matrices, 1):
        length = np.linalg.norm(A, axis=2) if unit_rows else np.ones(A.shape[:2])
        levels.append((A / length[..., None], z[f"lower{k}"] / length, z[f"upper{k}"] / length))
    norm = z["residual_norm_unit_rows" if unit_rows else "residual_norm"]
    return RecordedHierarchies(levels, z["lb"], z["ub"], norm, z["kind"])


def recorded_saturated(copies: int) -> Problem:
    """Eight steps of NAO towards targets that had jumped, in single precision, whose levels need most changes.

    Joints there depend on each other but for the rounding of the data. Each is there so many times, its rows perturbed
    by rounding of double precision, which decides how the search goes.
    """
    with np.load(DATA / "saturated_nao.npz") as z:
        return _saturated([z[name] for name in z.files], copies)


SCALED = {"far": "saturated_nao_far.npz", "single": "saturated_nao_single.npz", "signs": "saturated_nao_signs.npz"}


def recorded_scales(kind: str, copies: int) -> tuple[Problem, np.ndarray]:
    """Eight more of these steps, and the largest scale of their third level by a linear program (HiGHS).

    far: targets and boxes changed at random. Searches that let the joint enter whose saturation costs most went round
    in four of them, beside joints that nearly depend on each other, and ended at smaller scales in the others.
    single: rows with the rounding of sums in single precision, so that joints depend on each other to 1e-8 to 1e-5. A
    search that decides by a tolerance which of them do leaves them unsolved: five with any of 1e-9, 1e-6 and 1e-4.
    signs: rows know a finger by rounding alone. In attempts that let the motion be missed in part, multipliers are 1e13
    times that of the finger, whose sign their rounding turns: unsolved if the search ends with it.
    """
    with np.load(DATA / SCALED[kind]) as z:
        problem = _saturated([z[name] for name in z.files if name != "largest_scales"], copies)
        return problem, np.repeat(z["largest_scales"], copies)


def check_scales(found: SaturatedResult, problem: Problem, largest: np.ndarray, kind: str) -> None:
    """All are solved, in their box, with the scale of the linear program; the first far one may stop, for its cost."""
    assert np.asarray(found.done).all()
    assert ((found.x >= problem.lower) & (found.x <= problem.upper)).all()
    scales, atol = np.asarray(found.scales)[:, 2], 1e-9 if kind == "far" else 1e-8
    is_first = np.arange(len(scales)) < (len(scales) // 8 if kind == "far" else 0)
    stopped = is_first & (scales < largest - atol)
    np.testing.assert_allclose(scales[~stopped], largest[~stopped], rtol=0, atol=atol)
    assert (np.asarray(found.active_joints.ending)[stopped, 2] == PART).all()


def _saturated(arrays: list[np.ndarray], copies: int) -> Problem:
    """Recorded problems, each so many times."""
    parts = [np.repeat(a, copies, 0) for a in arrays]
    levels, *rest = (jnp.asarray(a if a.dtype == bool else a.astype(float)) for a in parts)
    levels *= 1.0 + 1e-15 * np.random.default_rng(0).normal(size=levels.shape)
    return Problem(PaddedLevel(levels, *rest[:3]), Damping(*rest[3:7]), *rest[7:])


def check_recorded_saturated(found: SaturatedResult, problem: Problem, copies: int) -> None:
    """All copies are solved, inside their box, and have the same answer."""
    found = jax.tree.map(np.asarray, found)
    assert found.done.all()
    assert ((found.x >= problem.lower) & (found.x <= problem.upper)).all()
    for numbers, atol in ((found.x, 1e-9), (found.scales, 1e-11)):
        of_one = numbers.reshape(-1, copies, numbers.shape[-1])
        np.testing.assert_allclose(of_one, np.broadcast_to(of_one[:, :1], of_one.shape), rtol=0, atol=atol)
    assert (found.scales < 1.0).any(1).all()

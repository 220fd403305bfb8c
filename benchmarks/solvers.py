"""The array-level solvers beside daqp and quadprog: the same recorded problems, the same machine, the same run.

    python -m benchmarks.solvers                                    the subset in tests/data
    OSIK_REFERENCE=<folder> python -m benchmarks.solvers            all recorded problems

Peers run on one core, one problem after another, set-up included. Ours runs as one batch, with whatever cores XLA
takes, blocked until ready. Each line gives the median over rounds in which all take turns, the ratio to daqp, the share
solved and the largest error against the recorded answer.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable
from typing import Any

import daqp
import jax
import numpy as np
import quadprog
from rich.console import Console
from rich.table import Table

import osik_jax
from osik_jax.runtime import configure_cpu
from osik_jax.solvers import Level, Status, solve_hqp, solve_least_squares_qp, solve_qp
from tests.support.recorded import QP_DAMPING, RecordedHierarchies, recorded_hierarchies, recorded_qps

ROUNDS = 7
FAR = 1e30


def compiled(function: Callable[..., Any], *args: Any) -> tuple[Callable[[], Any], float]:
    """The call on these arguments, and the seconds that compiling it took."""
    jax.clear_caches()
    started = time.perf_counter()
    program = jax.jit(jax.vmap(function)).lower(*args).compile()
    seconds = time.perf_counter() - started
    placed = jax.device_put(args)
    return lambda: jax.block_until_ready(program(*placed)), seconds


def interleaved(calls: dict[str, Callable[[], Any]]) -> tuple[dict[str, float], dict[str, Any]]:
    """Median seconds of each call, in rounds in which all take turns, and what each returned."""
    answers = {name: call() for name, call in calls.items()}
    seconds: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            started = time.perf_counter()
            call()
            seconds[name].append(time.perf_counter() - started)
    return {name: float(np.median(s)) for name, s in seconds.items()}, answers


def line(problem: str, solver: str, seconds: float, daqp_seconds: float, **more: Any) -> dict[str, Any]:
    """One row of the result."""
    return dict(problem=problem, solver=solver, us=1e6 * seconds, ratio=seconds / daqp_seconds, **more)


def quadratic_programs(robot: str) -> list[dict[str, Any]]:
    """Whole-body QPs: cold, warm, and those without an active bound alone."""
    p = recorded_qps(robot)
    count, n = p.lower.shape
    H = np.einsum("bmi,bmj->bij", p.A, p.A) + QP_DAMPING * np.eye(n)
    g = -np.einsum("bmi,bm->bi", p.A, p.b)
    low, high = np.clip(p.lower, -FAR, FAR), np.clip(p.upper, -FAR, FAR)
    bounded = np.isfinite(p.lower[0])
    normals = np.hstack([np.eye(n)[:, bounded], -np.eye(n)[:, bounded]])
    no_rows, sense = np.zeros((0, n)), np.zeros(n, np.int32)
    easy = p.regime == 0
    ones = np.ones_like(p.b)

    def least_squares(A: Any, b: Any, w: Any, lower: Any, upper: Any) -> Any:
        return solve_least_squares_qp(A, b, w, lower, upper, damping=QP_DAMPING)

    ours, seconds = {}, {}
    ours["solve_qp, cold"], seconds["solve_qp, cold"] = compiled(solve_qp, H, g, p.lower, p.upper)
    active = ours["solve_qp, cold"]().active
    ours["solve_qp, easy regime"], _ = compiled(solve_qp, H[easy], g[easy], p.lower[easy], p.upper[easy])
    ours["solve_qp, warm"], _ = compiled(
        lambda H, g, lo, hi, a: solve_qp(H, g, lo, hi, warm_start=a), H, g, p.lower, p.upper, active
    )
    name = "solve_least_squares_qp, cold"
    ours[name], seconds[name] = compiled(least_squares, p.A, p.b, ones, p.lower, p.upper)
    single = np.float32
    ours["the same, float32"], _ = compiled(
        least_squares, *(a.astype(single) for a in (p.A, p.b, ones, p.lower, p.upper))
    )
    peers = {
        "daqp": lambda: [daqp.solve(H[i], g[i], no_rows, high[i], low[i], sense)[0] for i in range(count)],
        "quadprog": lambda: [
            quadprog.solve_qp(H[i], -g[i], normals, np.r_[p.lower[i, bounded], -p.upper[i, bounded]])[0]
            for i in range(count)
        ],
    }
    times, answers = interleaved(peers | ours)
    out = []
    for name, answer in answers.items():
        some = easy if "easy" in name else slice(None)
        x = np.asarray(answer if name in peers else answer.x, float)
        share = 1.0 if name in peers else float(np.mean(np.asarray(answer.status) == Status.SOLVED))
        error = float(np.abs(x - p.solution[some]).max())
        per = times[name] / len(x)
        out.append(
            line(
                f"QP {robot}", name, per, times["daqp"] / count, solved=share, error=error, compile_s=seconds.get(name)
            )
        )
    return out


def level_norms(r: RecordedHierarchies, x: np.ndarray) -> np.ndarray:
    """Distance of each level's rows to their intervals."""
    values = [np.einsum("bmn,bn->bm", a, x) for a, _, _ in r.levels]
    slacks = [v - np.clip(v, lo, hi) for v, (_, lo, hi) in zip(values, r.levels, strict=True)]
    return np.stack([np.linalg.norm(s, axis=1) for s in slacks], 1)


def hierarchies(unit_rows: bool) -> list[dict[str, Any]]:
    """NAO's feet, centre of mass, hand and posture; the error is of the level norms. daqp minimises unit rows."""
    r = recorded_hierarchies(unit_rows)
    count, n = r.lower.shape
    A = np.ascontiguousarray(np.concatenate([a for a, _, _ in r.levels], 1))
    low = np.clip(np.concatenate([r.lower, *(a for _, a, _ in r.levels)], 1), -FAR, FAR)
    high = np.clip(np.concatenate([r.upper, *(a for _, _, a in r.levels)], 1), -FAR, FAR)
    breaks = np.cumsum([n, *(a.shape[1] for a, _, _ in r.levels)]).astype(np.int32)
    sense = np.zeros(low.shape[1], np.int32)

    def by_daqp(i: int) -> np.ndarray:
        return daqp.solve(None, None, A[i], high[i], low[i], sense, breaks)[0]

    def levels(data: Any) -> list[Level]:
        return [Level(a, lo, None if k != 1 else hi) for k, (a, lo, hi) in enumerate(data)]

    def solve(data: Any, lower: Any, upper: Any, warm_start: Any = None) -> Any:
        return solve_hqp(levels(data), lower, upper, warm_start=warm_start)

    cold, compile_s = compiled(solve, r.levels, r.lower, r.upper)
    warm, _ = compiled(solve, r.levels, r.lower, r.upper, cold().warm_start)
    calls = {"daqp": lambda: [by_daqp(i) for i in range(count)], "solve_hqp, cold": cold, "solve_hqp, warm": warm}
    times, answers = interleaved(calls)
    out = []
    for name, answer in answers.items():
        worse = level_norms(r, np.asarray(answer if name == "daqp" else answer.x)) - r.residual_norm
        excess = worse[np.arange(count), np.argmax(np.abs(worse) > 1e-5, 1)]  # at the first level that differs
        numbers = dict(solved=float((excess <= 1e-5).mean()), error=float(excess.max()))
        seconds = compile_s if "cold" in name else None
        kind = f"HQP, {'unit' if unit_rows else 'plain'} rows"
        out.append(line(kind, name, times[name] / count, times["daqp"] / count, **numbers, compile_s=seconds))
    return out


def main() -> None:
    """Prints a table, and JSON to the file named as the only argument."""
    jax.config.update("jax_enable_x64", True)
    rows = [*quadratic_programs("g1"), *quadratic_programs("nao"), *hierarchies(True), *hierarchies(False)]
    table = Table("problem", "solver", "µs each", "times daqp", "solved", "largest error", "compile [s]")
    for r in rows:
        seconds = "" if r["compile_s"] is None else f"{r['compile_s']:.1f}"
        numbers = (f"{r['us']:.1f}", f"{r['ratio']:.2f}", f"{r['solved']:.4f}", f"{r['error']:.1e}")
        table.add_row(r["problem"], r["solver"], *numbers, seconds)
    Console(width=120).print(table)
    if len(sys.argv) > 1:
        with open(sys.argv[1], "w", encoding="utf-8") as file:
            json.dump(dict(jax=jax.__version__, osik_jax=osik_jax.__name__, rows=rows), file, indent=1)


if __name__ == "__main__":
    configure_cpu()
    main()

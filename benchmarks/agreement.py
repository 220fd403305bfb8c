"""Kernels beside the search, problem by problem: random hierarchies solved with both backends.

    python -m benchmarks.agreement [--count 1000000] [--backend numba] [--solver hqp] [--seed 0]

Of each family of ``tests/hierarchy_families.py`` as many as of the others. Each line gives the problems so far, those
whose verdicts differ, those in which a level's residual norm differs by more than 1e-7 of the level's size, the largest
such difference, and those that the kernel left over for the search. With ``--solver nullspace`` the same levels are
projected, without their box: there an inequality counts where the levels above leave it violated, and some of the
degenerate ones are on their bound but for a rounding.
"""

from __future__ import annotations

import argparse
from functools import partial
from typing import Any

import jax
import numpy as np

from osik_jax.solvers import HQPSolution, Level, NullSpaceSolution, solve_hqp, solve_nullspace
from osik_jax.solvers.hqp import _dispatch
from tests.hierarchy_families import SMALL

BATCH = 4096
"""Problems of one call."""
APART = 1e-7
"""Of a level's size, a difference that counts."""


@partial(jax.jit, static_argnames=("solver", "backend"))
def solved(levels: Any, lower: Any, upper: Any, solver: str, backend: Any) -> HQPSolution | NullSpaceSolution:
    """A batch, by one backend."""

    def one(levels: Any, lower: Any, upper: Any) -> HQPSolution | NullSpaceSolution:
        given = [Level(*level) for level in levels]
        if solver == "nullspace":
            return solve_nullspace(given, backend=backend)
        return solve_hqp(given, lower, upper, backend=backend)

    return jax.vmap(one)(levels, lower, upper)


def main() -> None:
    """Prints a line a batch."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agreement", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--backend", default="numba")
    parser.add_argument("--solver", default="hqp", choices=("hqp", "nullspace"))
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    over = 0

    def counted(end: Any, done: Any, again: Any, block: int) -> Any:
        def note(done: np.ndarray) -> None:
            nonlocal over
            over += int((~done).sum())

        jax.debug.callback(note, done)
        return with_the_rest(end, done, again, block)

    with_the_rest, _dispatch.with_the_rest = _dispatch.with_the_rest, counted
    rng, so_far, verdicts, apart, worst = np.random.default_rng(asked.seed), 0, 0, 0, 0.0
    while so_far < asked.count:
        for name, draw in SMALL.items():
            p = draw(rng, BATCH)
            data = [tuple(level) for level in p.levels], p.lower, p.upper
            mine, search = (solved(*data, solver=asked.solver, backend=backend) for backend in (asked.backend, "jax"))
            off = np.zeros(BATCH)
            for a, b, level in zip(mine.slacks, search.slacks, p.levels, strict=True):
                rows = np.sqrt(level.weight)[..., None] * level.A
                size = np.linalg.norm(rows, axis=2).max(1) * (1.0 + np.abs(search.x).max(1))
                norms = [np.linalg.norm(np.sqrt(level.weight) * np.asarray(w), axis=1) for w in (a, b)]
                off = np.maximum(off, np.abs(norms[0] - norms[1]) / np.where(size > 0.0, size, 1.0))
            so_far, verdicts = so_far + BATCH, verdicts + int((mine.status != search.status).sum())
            apart, worst = apart + int((off > APART).sum()), max(worst, float(off.max()))
            print(
                f"{name}: {so_far} problems, {verdicts} verdicts, {apart} apart, {worst:.1e}; {over} left over",
                flush=True,
            )


if __name__ == "__main__":
    main()

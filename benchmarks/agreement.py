"""Kernels beside plain JAX, problem by problem: random problems solved by both.

    python -m benchmarks.agreement --solver qp|hqp|nullspace|saturated [--count 1000000]
        [--backend core] [--precision float64] [--seed 0] [--batch 4096] [--keep FILE]

Each family is drawn as often as the others: in ``tests/support``, for weighted QPs those of ``weighted_families.py``
and the planted ones of ``problem_families.py`` as least squares, for the others those of ``hierarchy_families.py``.
Each line of the result is that of a family: its problems; by status, the kernel's first, those whose status differs;
those of the others in which the rows of a QP's cost, or the norm of what a level misses, differ by more than 1e-7 of
their
size, and the largest such difference; and those that the kernel left to the search. ``--keep`` writes the problems
that differ to a file, for ``kept`` to read: who is right is a third method's to say.

Null spaces without bounds (``nullspace``) are given the same levels without their box. There an inequality
counts where the levels above leave it violated, so where these put it on its bound, roundoff decides whether it counts:
some problems of the degenerate families differ for that reason alone.
"""

from __future__ import annotations

import argparse
import dataclasses
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import numpy as np

from osik_jax.runtime import configure_cpu
from osik_jax.solvers import Level, Status, solve_hqp, solve_least_squares_qp, solve_nullspace
from osik_jax.solvers.hqp import _dispatch as hqp_dispatch
from osik_jax.solvers.null_space import _saturation
from osik_jax.solvers.qp import _dispatch as qp_dispatch
from tests.support.hierarchy_families import SMALL, Hierarchies
from tests.support.problem_families import PLANTED, QPs
from tests.support.weighted_families import MANY, M, Problems, problems

APART = 1e-7
"""Of a problem's size, a difference that counts."""
_SEARCHES = (
    (qp_dispatch, "with_a_few", 2),
    (hqp_dispatch, "with_the_rest", 1),
    (_saturation, "with_a_few", 2),
)
"""Where a solver searches for what a kernel left over: module, function, and which argument says what is done."""


class Comparison(NamedTuple):
    """What is compared: problems by family, how one is solved, and by how much the answers to a batch differ."""

    families: dict[str, Callable[[np.random.Generator, int], Any]]
    solve: Callable[..., Any]
    difference: Callable[[Any, Any, Any], np.ndarray]


@dataclasses.dataclass
class Tally:
    """What is found of a family."""

    problems: int = 0
    statuses: Counter[str] = dataclasses.field(default_factory=Counter)
    apart: int = 0
    worst: float = 0.0
    left_over: int = 0
    kept: list[Any] = dataclasses.field(default_factory=list)

    def add(self, mine: Any, plain: Any, off: np.ndarray, left_over: int) -> None:
        """Count a batch: the kernel's answers, those of plain JAX, and how far they are apart."""
        pairs = np.stack([mine.status, plain.status], 1)
        same = pairs[:, 0] == pairs[:, 1]
        self.problems += len(off)
        self.statuses.update("/".join(Status(code).name for code in pair) for pair in pairs[~same])
        self.apart += int((off[same] > APART).sum())
        self.worst = max(self.worst, float(off[same].max(initial=0.0)))
        self.left_over += left_over

    def __str__(self) -> str:
        """All of it."""
        statuses = ", ".join(f"{name} {count}" for name, count in self.statuses.items()) or "none"
        found = f"{self.problems} problems; statuses: {statuses}; apart: {self.apart}, {self.worst:.1e} at most"
        return f"{found}; left over: {self.left_over}"


def differ(mine: Any, plain: Any, off: np.ndarray) -> np.ndarray:
    """Which problems differ, in status or in their answer."""
    return (np.asarray(mine.status) != np.asarray(plain.status)) | (off > APART)


def keep(file: str, tallies: dict[str, Tally]) -> None:
    """Write the problems that differ, an array of each of their numbers under family and position."""
    leaves = {
        f"{name}/{at}": np.concatenate(parts)
        for name, tally in tallies.items()
        for at, parts in enumerate(zip(*(jax.tree.leaves(p) for p in tally.kept), strict=True))
    }
    np.savez_compressed(file, **leaves)  # pyright: ignore[reportArgumentType]


def kept(file: str, solver: str) -> dict[str, Any]:
    """Read what ``keep`` wrote: by family, the problems as they were drawn."""
    found, out = np.load(file), {}
    for name, draw in comparison(solver).families.items():
        if f"{name}/0" in found:
            structure = jax.tree.structure(draw(np.random.default_rng(0), 1))
            leaves = [found[f"{name}/{at}"] for at in range(structure.num_leaves)]
            out[name] = jax.tree.unflatten(structure, leaves)
    return out


def weighted(rng: np.random.Generator, count: int, *, m: int) -> Problems:
    """Weights over five decades, rows hard and soft; ``m`` rows of the cost."""
    return problems(count, m, seed=int(rng.integers(2**32)))


def planted(rng: np.random.Generator, count: int, *, draw: Callable[[np.random.Generator, int], QPs]) -> Problems:
    """A family of QPs with a Hessian, as least squares: half of what its diagonal can spare is damping."""
    p = draw(rng, count)
    diagonal = np.einsum("bii->bi", p.H)
    root = np.sqrt(diagonal)
    spare = np.linalg.eigvalsh(p.H / root[:, :, None] / root[:, None, :])[:, :1]
    damping = 0.5 * np.maximum(spare, 0.0) * diagonal
    factor = np.linalg.cholesky(p.H - damping[:, :, None] * np.eye(damping.shape[1]))
    target = -np.linalg.solve(factor, p.g[..., None])[..., 0]
    rows = p.C, p.row_lower, p.row_upper, np.zeros_like(p.row_lower)
    return Problems(np.swapaxes(factor, 1, 2), target, np.ones_like(target), p.lower, p.upper, *rows, damping)


def solve_qp(p: Problems, backend: Any) -> Any:
    """One weighted QP."""
    *given, compliance, damping = p
    return solve_least_squares_qp(*given, rows_compliance=compliance, damping=damping, backend=backend)


def qp_difference(p: Problems, mine: Any, plain: Any) -> np.ndarray:
    """The weighted rows of the cost and the damped variables: how far those of both answers are apart."""

    def rows(x: np.ndarray) -> np.ndarray:
        values = np.einsum("bmn,bn->bm", p.matrix, x)
        return np.concatenate([np.sqrt(p.weight) * values, np.sqrt(p.damping) * x], 1)

    size = np.linalg.norm(rows(np.asarray(plain.x)), axis=1)
    size = size + np.linalg.norm(np.sqrt(p.weight) * p.target, axis=1)
    return np.linalg.norm(rows(np.asarray(mine.x - plain.x)), axis=1) / np.where(size > 0.0, size, 1.0)


def solve_levels(p: Hierarchies, backend: Any, *, solver: str) -> Any:
    """One hierarchy, or the projection of its levels."""
    levels = [Level(*level) for level in p.levels]
    if solver == "hqp":
        return solve_hqp(levels, p.lower, p.upper, backend=backend)
    if solver == "saturated":
        return solve_nullspace(levels, p.lower, p.upper, backend=backend)
    return solve_nullspace(levels, backend=backend)


def levels_difference(p: Hierarchies, mine: Any, plain: Any) -> np.ndarray:
    """The largest difference between the norms of what a level misses, of the size of the level."""
    off = np.zeros(len(p.lower))
    for a, b, level in zip(mine.slacks, plain.slacks, p.levels, strict=True):
        rows = np.sqrt(level.weight)[..., None] * level.A
        size = np.linalg.norm(rows, axis=2).max(1, initial=0.0) * (1.0 + np.abs(plain.x).max(1))
        norms = [np.linalg.norm(np.sqrt(level.weight) * np.asarray(w), axis=1) for w in (a, b)]
        off = np.maximum(off, np.abs(norms[0] - norms[1]) / np.where(size > 0.0, size, 1.0))
    return off


def comparison(solver: str) -> Comparison:
    """What is compared of a solver."""
    if solver != "qp":
        return Comparison(SMALL, partial(solve_levels, solver=solver), levels_difference)
    few_and_many = {"few_rows": partial(weighted, m=M), "many_rows": partial(weighted, m=MANY)}
    return Comparison(
        few_and_many | {name: partial(planted, draw=draw) for name, draw in PLANTED.items()}, solve_qp, qp_difference
    )


def count_left_over() -> list[int]:
    """Have the solvers count, in the list's one entry, the problems that are not done after a kernel."""
    total = [0]

    def note(done: np.ndarray) -> None:
        total[0] += int((~done).sum())

    def counting(search: Callable[..., Any], at: int) -> Callable[..., Any]:
        def counted(*args: Any) -> Any:
            jax.debug.callback(note, args[at])
            return search(*args)

        return counted

    for module, name, at in _SEARCHES:
        setattr(module, name, counting(getattr(module, name), at))
    return total


def main() -> None:
    """Print a line for each family."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.agreement", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--solver", default="hqp", choices=("qp", "hqp", "nullspace", "saturated"))
    parser.add_argument("--count", type=int, default=100_000)
    parser.add_argument("--backend", default="core")
    parser.add_argument("--precision", default="float64", choices=("float64", "float32"), help="of the problems")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=4096, help="problems of one call")
    parser.add_argument("--keep", help="file for the problems that differ, .npz")
    asked = parser.parse_args()
    configure_cpu()
    jax.config.update("jax_enable_x64", asked.precision == "float64")
    families, solve, difference = comparison(asked.solver)
    left_over = count_left_over()

    @partial(jax.jit, static_argnums=1)
    def solved(p: Any, backend: Any) -> Any:
        return jax.vmap(partial(solve, backend=backend))(p)

    rng, tallies = np.random.default_rng(asked.seed), {name: Tally() for name in families}
    while sum(tally.problems for tally in tallies.values()) < asked.count:
        for name, draw in families.items():
            p, before = draw(rng, asked.batch), left_over[0]
            mine, plain = jax.block_until_ready((solved(p, asked.backend), solved(p, "jax")))
            jax.effects_barrier()
            off = difference(p, mine, plain)
            tallies[name].add(mine, plain, off, left_over[0] - before)
            if asked.keep:
                which = differ(mine, plain, off)
                tallies[name].kept.append(jax.tree.map(lambda a: a[which], p))  # noqa: B023
    if asked.keep:
        keep(asked.keep, tallies)
    for name, tally in tallies.items():
        print(f"{name}: {tally}", flush=True)


if __name__ == "__main__":
    main()

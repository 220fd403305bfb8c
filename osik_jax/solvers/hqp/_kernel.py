"""The CUDA kernel of the hierarchy: a Warp native function, called from JAX through Warp's FFI.

One warp of 32 threads goes through all levels of one problem, in double precision. ``_cascade.cu`` is compiled for the
layout of the hierarchy, once a process (and once for all in Warp's cache on disk).
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.resources import files
from typing import Any, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array

from .._damping import BENDS, LEAST, PASSES, ROOM, SPENT
from ._cascade import Descent, descent_of
from ._problem import Tolerances, WorkingSet
from ._stack import Layout, Stack

_MOST_ROWS, _MOST_HARD_ROWS = 64, 32
_SHARED_BYTES = 48 * 1024
"""Shared memory that any CUDA device gives a block without being asked for more."""
_MOST_WARPS = 2
_INPUTS = (
    dict(matrix="double", rows_lower="double", rows_upper="double", rows_equal="int")
    | dict(hard_lower="double", hard_upper="double", hard_equal="int")
    | dict(guess_hard="int", guess_own="int", dampings="double", bends="double", tolerances="double")
)
_OUTPUTS = dict(
    solution="double", box="int", sides="int", tight_rows="int", missed_rows="int", own_rows="int", ranks="int"
) | dict(multipliers="double", reached="double", strengths="double", residuals="double", report="int")


class Shape(NamedTuple):
    """What a kernel is compiled for: the layout, as the numbers that it takes."""

    variables: int
    rows: int  # of the longest level
    counts: tuple[int, ...]  # rows of each level
    mixed: tuple[bool, ...]  # which levels may hold inequalities
    place: tuple[int, ...]  # of each hard row beside the box, among the rows of all levels
    level: tuple[int, ...]  # of each of those

    @classmethod
    def of(cls, layout: Layout) -> Shape:
        """Of a hierarchy."""
        n, h = layout.variables, len(layout.level_of_hard)
        offsets = [sum(layout.counts[:k]) for k in range(layout.levels)]
        at = {q: offsets[k] + a for k, places in enumerate(layout.place_of_row) for a, q in enumerate(places) if q < h}
        level = layout.level_of_hard[n:]
        mixed = tuple(k in level for k in range(layout.levels))
        return cls(n, layout.rows, layout.counts, mixed, tuple(at[q] for q in range(n, h)), level)

    @property
    def all_rows(self) -> int:
        """Of all levels."""
        return sum(self.counts)

    @property
    def warps(self) -> int:
        """How many of them a block can have; 0 for a problem too large for this kernel."""
        n, m, p = self.variables, self.rows, len(self.place)
        if m > _MOST_ROWS or p > _MOST_HARD_ROWS or not self.all_rows:
            return 0
        row, column = n | 1, m | 1
        rank = min(n, m)
        factors = n * column + m * row
        doubles = n * row + factors + max(p, 1) * row + 4 * max(n, m, p) + rank + m * (column + 1)
        return min(_MOST_WARPS, _SHARED_BYTES // (8 * doubles + 4 * (2 * n + m)))


def solve(
    layout: Layout, stack: Stack, tolerances: Tolerances, warm: WorkingSet | None, max_iterations: int
) -> Descent:
    """Solves a batch of hierarchies on the CUDA device that the program runs on; all levels, the last one too."""
    shape = Shape.of(layout)
    lanes, count, m, n = stack.levels.matrix.shape
    h = stack.hard.shape[1]
    guess = WorkingSet(jnp.zeros((lanes, count, h), int), jnp.zeros((lanes, count, m), int)) if warm is None else warm

    def rows(a: Array) -> Array:
        return jnp.concatenate([a[:, k, :size] for k, size in enumerate(shape.counts)], 1)

    given = (
        jnp.swapaxes(rows(stack.levels.matrix), 1, 2),
        *(rows(a) for a in (stack.levels.lower, stack.levels.upper, stack.equal.astype(jnp.int32))),
        *(stack.hard_lower, stack.hard_upper, stack.hard_equal.astype(jnp.int32)),
        *(a.astype(jnp.int32) for a in guess),
        jnp.stack(stack.damping[:3], 1),
        stack.damping.bends,
        jnp.stack(tolerances, -1),
    )
    sizes = dict(solution=n, box=n, sides=count * h, tight_rows=count * h, missed_rows=count * m, own_rows=count * m)
    sizes |= dict(ranks=count, multipliers=count * h, reached=count, strengths=count, residuals=1, report=3)
    x, box, sides, tight, missed, own, ranks, multipliers, reached, strengths, residual, report = _kernel(shape)(
        *(a.reshape(lanes, -1) for a in given),
        max_iterations,
        launch_dims=32 * lanes,
        output_dims={name: (lanes, size) for name, size in sizes.items()},
    )
    sides, tight, multipliers = (a.reshape(lanes, count, h) for a in (sides, tight, multipliers))
    missed, own = (a.reshape(lanes, count, m) for a in (missed, own))
    return descent_of(x, multipliers, reached, strengths, residual[:, 0], box, sides, tight, missed, own, ranks, report)


@cache
def _kernel(shape: Shape) -> Callable[..., Any]:
    """The kernel as a function of JAX arrays."""
    warp = import_module("warp")
    types = {"double": warp.array2d(dtype=warp.float64), "int": warp.array2d(dtype=warp.int32)}
    inputs = {name: types[kind] for name, kind in _INPUTS.items()} | dict(most_changes=warp.int32)
    outputs = {name: types[kind] for name, kind in _OUTPUTS.items()}

    def solve_by_warp(
        matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
        dampings, bends, tolerances, most_changes, solution, box, sides, tight_rows, missed_rows, own_rows, ranks,
        multipliers, reached, strengths, residuals, report, pid,
    ): ...  # fmt: skip

    solve_by_warp.__annotations__ = inputs | outputs | dict(pid=warp.int32)
    native = warp.func_native(source(shape))(solve_by_warp)

    def solve_all(
        matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
        dampings, bends, tolerances, most_changes, solution, box, sides, tight_rows, missed_rows, own_rows, ranks,
        multipliers, reached, strengths, residuals, report,
    ):  # fmt: skip
        native(
            matrix, rows_lower, rows_upper, rows_equal, hard_lower, hard_upper, hard_equal, guess_hard, guess_own,
            dampings, bends, tolerances, most_changes, solution, box, sides, tight_rows, missed_rows, own_rows, ranks,
            multipliers, reached, strengths, residuals, report, warp.tid() // 32,
        )  # fmt: skip

    solve_all.__annotations__ = inputs | outputs
    # what XLA calls it: the same in every process, for caches of compiled programs
    numbers = [shape.variables, *shape.counts, *map(int, shape.mixed), *shape.place]
    solve_all.__qualname__ = solve_all.__name__ = "solve_hqp_" + "_".join(map(str, numbers))
    block = 32 * shape.warps
    kernel = warp.kernel(solve_all, enable_backward=False, module="unique", launch_bounds=block)
    return warp.jax_kernel(kernel, num_outputs=len(outputs), block_dim=block)


def source(shape: Shape) -> str:
    """The CUDA text of a shape."""
    offsets = [sum(shape.counts[:k]) for k in range(len(shape.counts))]
    numbers = dict(N=shape.variables, LEVELS=len(shape.counts), M=shape.rows, ROWS=shape.all_rows)
    numbers |= dict(P=len(shape.place), WARPS=shape.warps, PASSES=PASSES)
    lists = dict(COUNT=shape.counts, OFFSET=offsets, MIXED=[int(a) for a in shape.mixed])
    lists |= dict(PLACE=shape.place or (0,), LEVEL=shape.level or (0,))
    head = [f"constexpr int {name} = {value};" for name, value in numbers.items()]
    head += [
        f"constexpr double {name} = {value!r};"
        for name, value in dict(LEAST=LEAST, SPENT=SPENT, ROOM=ROOM, BENDS=BENDS).items()
    ]
    head += [f"const int {name}[] = {{{', '.join(map(str, values))}}};" for name, values in lists.items()]
    body = files("osik_jax.solvers.hqp").joinpath("_cascade.cu").read_text()
    return "\n".join(head) + "\n" + rolled(body)


def rolled(text: str) -> str:
    """CUDA text whose loops stay loops, but for those that ask to be unrolled.

    Written out, this kernel is several times as long as the instruction caches, which then decide how fast it is.
    """
    lines = text.splitlines(keepends=True)
    loose = [
        re.match(r"\s*(for|while) \(", line) and not before.startswith("#pragma")
        for before, line in zip(["", *lines], lines, strict=False)
    ]
    return "".join("#pragma unroll 1\n" + line if alone else line for line, alone in zip(lines, loose, strict=True))

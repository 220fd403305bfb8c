"""Products and triangular solves of matrices of a few dozen rows, in tiles that stay in registers.

A matrix is an array whose rows are ``padded`` numbers long and whose number of rows is at least the number of those
that are used, rounded up to ``WIDTH``. What is behind the n-th row or column may be anything: it does not come into the
numbers before it. With Numba's bounds checks on, these are plain loops.
"""

from __future__ import annotations

from typing import Any, cast

import numpy as np
from llvmlite import binding, ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._frame import lean
from ._vectors import _BLOCK, _CHECKED, WIDTH, _multiply_add, _splat

HEIGHT = 4
"""Rows of a tile."""
_WIDE = bool(binding.get_host_cpu_features().get("avx512f", False))
"""Whether registers hold tiles of several blocks: where a block takes two of sixteen, they hold one alone."""


@lean
def padded(n):
    """Return how many numbers a row of n has, filled up to whole blocks."""
    return (n + WIDTH - 1) // WIDTH * WIDTH


def _at(context: Any, builder: Any, kind: Any, array: Any, i: Any, j: Any) -> Any:
    """Return a pointer to number j of row i."""
    assert kind.layout == "C" and kind.dtype == types.float64 and kind.ndim == 2, kind
    made = context.make_array(kind)(context, builder, array)
    length = cgutils.unpack_tuple(builder, made.shape, 2)[1]
    return builder.gep(made.data, [builder.add(builder.mul(i, length), j)])


def _block(builder: Any, pointer: Any, k: int) -> Any:
    """Return a pointer to the k-th block from a number on."""
    return builder.bitcast(builder.gep(pointer, [ir.IntType(64)(WIDTH * k)]), _BLOCK.as_pointer())


def _tile_taking(blocks: int) -> Any:
    """``C -= A'B`` in a tile: HEIGHT rows from i on, ``blocks`` blocks from column j on, over some rows of A and B."""

    def take(typing_context, C, i, j, A, B, first, last):
        def generate(context, builder, signature, arguments):
            c, i, j, a, b, first, last = arguments
            kinds = signature.args
            into = [_at(context, builder, kinds[0], c, builder.add(i, i.type(r)), j) for r in range(HEIGHT)]
            sums = [[cgutils.alloca_once(builder, _BLOCK) for _ in range(blocks)] for _ in range(HEIGHT)]
            for r in range(HEIGHT):
                for k in range(blocks):
                    builder.store(builder.load(_block(builder, into[r], k), align=8), sums[r][k])
            with cgutils.for_range_slice(builder, first, last, i.type(1), inc=True) as (row, _):
                factors = _at(context, builder, kinds[3], a, row, i)
                numbers = _at(context, builder, kinds[4], b, row, j)
                right = [builder.load(_block(builder, numbers, k), align=8) for k in range(blocks)]
                for r in range(HEIGHT):
                    factor = builder.load(builder.gep(factors, [ir.IntType(64)(r)]))
                    factor = builder.fneg(_splat(builder, factor, _BLOCK))
                    for k in range(blocks):
                        total = _multiply_add(builder, factor, right[k], builder.load(sums[r][k]))
                        builder.store(total, sums[r][k])
            for r in range(HEIGHT):
                for k in range(blocks):
                    builder.store(builder.load(sums[r][k]), _block(builder, into[r], k), align=8)
            return context.get_dummy_value()

        whole = types.int64
        return types.void(C, whole, whole, A, B, whole, whole), generate

    return cast(Any, intrinsic)(take)


_take_one, _take_two, _take_three = map(_tile_taking, (1, 2, 3))


def _panel_solving(typing_context, X, j, U, k):
    """WIDTH rows of a block of X, from row k and column j on, become L^-1 of them, L' the block of U at k, k."""

    def generate(context, builder, signature, arguments):
        x, j, u, k = arguments
        places = [_at(context, builder, signature.args[0], x, builder.add(k, k.type(r)), j) for r in range(WIDTH)]
        rows = [builder.load(_block(builder, place, 0), align=8) for place in places]
        for i in range(WIDTH):
            factors = _at(context, builder, signature.args[2], u, builder.add(k, k.type(i)), k)
            found = [builder.load(builder.gep(factors, [ir.IntType(64)(r)])) for r in range(i, WIDTH)]
            rows[i] = builder.fmul(rows[i], _splat(builder, found[0], _BLOCK))
            for r in range(i + 1, WIDTH):
                factor = builder.fneg(_splat(builder, found[r - i], _BLOCK))
                rows[r] = _multiply_add(builder, factor, rows[i], rows[r])
        for place, row in zip(places, rows, strict=True):
            builder.store(row, _block(builder, place, 0), align=8)
        return context.get_dummy_value()

    return types.void(X, types.int64, U, types.int64), generate


_solve_in_registers = cast(Any, intrinsic)(_panel_solving)


@lean
def take_product(C, A, B, top, bottom, left, right, first, last):
    """``C -= A'B`` in rows from ``top`` to ``bottom`` and columns from ``left`` to ``right``, the latter whole blocks.

    Args:
        C: what is changed.
        A: factors: its columns are C's rows.
        B: its columns are C's.
        top: first row of C, a multiple of HEIGHT.
        bottom: the row after the last; rows up to a multiple of HEIGHT are changed.
        left: first column of C.
        right: the column after the last.
        first: first row of A and B that counts.
        last: the row after the last of those.
    """
    for i in range(top, bottom, HEIGHT):
        if _CHECKED:
            for r in range(i, i + HEIGHT):
                for j in range(left, right):
                    for k in range(first, last):
                        C[r, j] -= A[k, r] * B[k, j]
            continue
        j = left
        if _WIDE:
            while right - j > 4 * WIDTH or right - j == 3 * WIDTH:
                _take_three(C, i, j, A, B, first, last)
                j += 3 * WIDTH
            while right - j >= 2 * WIDTH:
                _take_two(C, i, j, A, B, first, last)
                j += 2 * WIDTH
        while right > j:
            _take_one(C, i, j, A, B, first, last)
            j += WIDTH


@lean
def take_square(C, A, n, right, first, last):
    """Take A'A from the upper triangle of C: n rows and the columns to ``right``, in whole blocks."""
    for top in range(0, n, WIDTH):
        take_product(C, A, A, top, min(top + WIDTH, n), top, right, first, last)


@lean
def take_product_of_lower(C, A, G, n):
    """``C -= A'G`` for a lower triangular G, n rows and columns."""
    for left in range(0, n, 2 * WIDTH):
        take_product(C, A, G, 0, n, left, min(left + 2 * WIDTH, padded(n)), left, n)


@lean
def take_square_of_lower(C, G, n):
    """Take G'G from C, for a lower triangular G of n rows and columns."""
    for left in range(0, n, 2 * WIDTH):
        right = min(left + 2 * WIDTH, padded(n))
        take_product(C, G, G, 0, min(right, n), left, right, left, n)


@lean
def _solve_panel(X, left, right, U, k):
    """Rows k to k + WIDTH of X become L^-1 of them, L' the diagonal's block of U there, in some blocks of columns."""
    for j in range(left, right, WIDTH):
        if _CHECKED:
            for i in range(k, k + WIDTH):
                for c in range(j, j + WIDTH):
                    X[i, c] *= U[i, i]
                    for r in range(i + 1, k + WIDTH):
                        X[r, c] -= U[i, r] * X[i, c]
        else:
            _solve_in_registers(X, j, U, k)


@lean
def _factor_block(S, k, stop):
    """The diagonal's block at k becomes U, up to row ``stop``, with ones over its diagonal; or False."""
    for i in range(k, stop):
        pivot = S[i, i]
        if not pivot > 0.0:
            return False
        inverse = 1.0 / np.sqrt(pivot)
        S[i, i] = inverse
        for j in range(i + 1, k + WIDTH):
            S[i, j] *= inverse
        for r in range(i + 1, stop):
            for j in range(r, k + WIDTH):
                S[r, j] -= S[i, r] * S[i, j]
    return True


@lean
def factor(S, n, right):
    """The upper triangle of S, n rows and columns, becomes U with ``U'U = S`` and ones over its diagonal; or False.

    Columns from n to ``right``, whole blocks, become ``U'^-1`` of them.
    """
    for k in range(0, n, WIDTH):
        take_product(S, S, S, k, min(k + WIDTH, n), k, right, 0, k)
        if not _factor_block(S, k, min(k + WIDTH, n)):
            return False
        _solve_panel(S, k + WIDTH, right, S, k)
    return True


@lean
def solve_lower(U, X, n, left, right):
    """X becomes ``U'^-1 X`` in whole blocks of columns, n rows; U as ``factor`` leaves it."""
    for k in range(0, n, WIDTH):
        take_product(X, U, X, k, min(k + WIDTH, n), left, right, 0, k)
        _solve_panel(X, left, right, U, k)


@lean
def solve_lower_diagonal(U, X, diagonal, n):
    """X becomes ``U'^-1 diag(diagonal)``, lower triangular, in n rows and columns."""
    for k in range(0, n, WIDTH):
        end = k + WIDTH
        for i in range(k, end):
            for j in range(padded(n)):
                X[i, j] = 0.0
        for i in range(k, min(end, n)):
            X[i, i] = diagonal[i]
        for left in range(0, k, WIDTH):
            take_product(X, U, X, k, min(end, n), left, left + WIDTH, left, k)
        _solve_panel(X, 0, end, U, k)

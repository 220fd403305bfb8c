"""Factors L D L' of a symmetric matrix and solutions by them, a block of eight rows in registers at a time.

Nothing goes through memory between one number and the next that depends on it. Matrices are ``padded``, rows too, with
zeros behind the n-th row and column. With Numba's bounds checks on, these are plain loops.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._addresses import BYTES, ONES, address, call_of, everywhere, load, row_bytes, store
from ._frame import lean
from ._padded_rows import sum_rows
from ._tiles import padded, take_product
from ._transpose import transpose_upper
from ._vectors import _BLOCK, _CHECKED, _INDEX, _LANE, WIDTH, _multiply_add

_LANES = ir.VectorType(_LANE, WIDTH)
_NOTHING, _ZEROS = ir.Constant(_BLOCK, ir.Undefined), _BLOCK([0.0] * WIDTH)


def _lane(builder: Any, block: Any, k: int) -> Any:
    """Return a block of the k-th number of a block."""
    return builder.shuffle_vector(block, _NOTHING, _LANES([k] * WIDTH))


def _only(builder: Any, block: Any, lanes: range) -> Any:
    """Return a block with zeros elsewhere."""
    return builder.shuffle_vector(block, _ZEROS, _LANES([k if k in lanes else WIDTH for k in range(WIDTH)]))


def _factor_block(builder: Any, S: Any, T: Any, inverse: Any, step: Any) -> None:
    """The block of S on the diagonal becomes D L', that of T L', above their diagonals; 1 / D goes into ``inverse``."""
    rows = [load(builder, builder.add(S, builder.mul(step, _INDEX(r)))) for r in range(WIDTH)]
    inverses = ONES
    for j in range(WIDTH):
        by = builder.fdiv(ONES, _lane(builder, rows[j], j))
        inverses = builder.shuffle_vector(inverses, by, _LANES([k if k != j else WIDTH + j for k in range(WIDTH)]))
        unit = builder.fmul(rows[j], by)
        store(builder, unit, builder.add(T, builder.mul(step, _INDEX(j))))
        for r in range(j + 1, WIDTH):
            rows[r] = _multiply_add(builder, builder.fneg(_lane(builder, unit, r)), rows[j], rows[r])
    for r, row in enumerate(rows):
        store(builder, row, builder.add(S, builder.mul(step, _INDEX(r))))
    store(builder, inverses, inverse)


def _factor_beside(builder: Any, S: Any, T: Any, L: Any, inverse: Any, step: Any) -> None:
    """Likewise a block of S and T beside it, with that of L' at ``L``."""
    rows = [load(builder, builder.add(S, builder.mul(step, _INDEX(r)))) for r in range(WIDTH)]
    for j in range(WIDTH):
        units = builder.add(L, builder.mul(step, _INDEX(j)))
        for r in range(j + 1, WIDTH):
            by = builder.fneg(everywhere(builder, builder.add(units, _INDEX(8 * r))))
            rows[r] = _multiply_add(builder, by, rows[j], rows[r])
    for r, row in enumerate(rows):
        place = builder.mul(step, _INDEX(r))
        store(builder, row, builder.add(S, place))
        by = everywhere(builder, builder.add(inverse, _INDEX(8 * r)))
        store(builder, builder.fmul(row, by), builder.add(T, place))


def _factoring(typing_context, S, T, inverse, k, wide):
    """Return the block of rows from k on, from which what is above it has been taken off."""

    def body(builder, S, T, inverse, step, right):
        _factor_block(builder, S, T, inverse, step)
        with cgutils.for_range_slice(builder, _INDEX(BYTES), right, _INDEX(BYTES), inc=True) as (place, _):
            _factor_beside(builder, builder.add(S, place), builder.add(T, place), T, inverse, step)

    def generate(context, builder, signature, arguments):
        S, T, inverse, k, wide = arguments
        kinds = signature.args
        step = row_bytes(context, builder, kinds[0], S)
        places = [address(context, builder, kind, a, k, k) for kind, a in zip(kinds[:2], (S, T), strict=True)]
        given = [*places, address(context, builder, kinds[2], inverse, k), step]
        call_of(builder, "factor", body, [*given, builder.mul(_INDEX(8), builder.sub(wide, k))])
        return context.get_dummy_value()

    return types.void(S, T, inverse, types.int64, types.int64), generate


def _substitute(builder: Any, b: Any, others: Any, B: Any, rows: Any, own: Any, step: Any, *, upwards: bool) -> None:
    """A block of b: takes off what others times rows of B are, then goes through its own rows of ``own``."""
    total = cgutils.alloca_once(builder, _BLOCK)
    builder.store(load(builder, b), total)
    sum_rows(builder, "minus", [total], others, B, step, rows)
    block = builder.load(total)
    for j in range(WIDTH - 1, 0, -1) if upwards else range(WIDTH - 1):
        row = load(builder, builder.add(own, builder.mul(step, _INDEX(j))))
        row = _only(builder, row, range(j) if upwards else range(j + 1, WIDTH))
        block = _multiply_add(builder, builder.fneg(_lane(builder, block, j)), row, block)
    store(builder, block, b)


def _solving(typing_context, L, T, inverse, b, wide):
    """b becomes (L D L')^-1 b."""

    def body(builder, L, T, inverse, b, step, wide):
        size = _INDEX(8)
        with cgutils.for_range_slice(builder, _INDEX(0), wide, _INDEX(WIDTH), inc=True) as (k, _):
            here = builder.mul(size, k)
            corner = builder.mul(builder.add(step, size), k)
            place, above, own = (builder.add(at, by) for at, by in ((b, here), (T, here), (T, corner)))
            _substitute(builder, place, b, above, k, own, step, upwards=False)
        with cgutils.for_range_slice(builder, _INDEX(0), wide, _INDEX(WIDTH), inc=True) as (k, _):
            here = builder.mul(size, k)
            place = builder.add(b, here)
            store(builder, builder.fmul(load(builder, place), load(builder, builder.add(inverse, here))), place)
        begin, end = _INDEX(WIDTH), builder.add(wide, _INDEX(1))
        with cgutils.for_range_slice(builder, begin, end, _INDEX(WIDTH), inc=True) as (back, _):
            k = builder.sub(wide, back)
            here, last = builder.mul(size, k), builder.add(k, _INDEX(WIDTH))
            below = builder.add(builder.add(L, here), builder.mul(step, last))
            corner = builder.add(L, builder.mul(builder.add(step, size), k))
            rest = builder.add(b, builder.mul(size, last))
            _substitute(builder, builder.add(b, here), rest, below, builder.sub(wide, last), corner, step, upwards=True)

    def generate(context, builder, signature, arguments):
        *arrays, wide = arguments
        given = [address(context, builder, kind, a) for kind, a in zip(signature.args, arrays, strict=False)]
        call_of(builder, "solve", body, [*given, row_bytes(context, builder, signature.args[0], arrays[0]), wide])
        return context.get_dummy_value()

    return types.void(L, T, inverse, b, types.int64), generate


@lean
def _factor_plain(S, T, inverse, k, wide):
    for j in range(k, k + WIDTH):
        inverse[j] = 1.0 / S[j, j]
        for c in range(j, wide):
            T[j, c] = S[j, c] * inverse[j]
        for i in range(j + 1, k + WIDTH):
            for c in range(i, wide):
                S[i, c] -= T[j, i] * S[j, c]


@lean
def _solve_plain(L, T, inverse, b, n):
    for j in range(n):
        for c in range(j + 1, n):
            b[c] -= b[j] * T[j, c]
    for i in range(n):
        b[i] *= inverse[i]
    for i in range(n - 1, -1, -1):
        for c in range(i):
            b[c] -= b[i] * L[i, c]


_factor_rows: Any = _factor_plain if _CHECKED else cast(Any, intrinsic)(_factoring)
_solve: Any = _solve_plain if _CHECKED else cast(Any, intrinsic)(_solving)


@lean
def factor_symmetric(S, L, T, inverse, diagonal, n, smallest):
    """S = L D L': L' into T, L into L, both of them in their halves, and 1 / D; all ``padded(n)`` wide at least.

    Returns whether every pivot is at least ``smallest`` of its element of S, of which the upper half is used up.
    """
    wide = padded(n)
    for j in range(n):
        diagonal[j] = S[j, j]
    for j in range(n, wide):
        S[j, j] = 1.0
    for k in range(0, wide, WIDTH):
        if k > 0:
            take_product(S, T, S, k, k + WIDTH, k, wide, 0, k)
        _factor_rows(S, T, inverse, k, wide)
    transpose_upper(L, T, wide, wide)
    is_regular = True
    for j in range(n):
        is_regular = is_regular and inverse[j] > 0.0 and smallest * diagonal[j] * inverse[j] <= 1.0
    return is_regular


@lean
def solve_symmetric(L, T, inverse, b, n):
    """b becomes (L D L')^-1 b, with the factors of ``factor_symmetric``; zeros behind its n numbers."""
    for j in range(n, padded(n)):
        b[j] = 0.0
    _solve(L, T, inverse, b, padded(n))

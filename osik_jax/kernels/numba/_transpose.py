"""Transposes of matrices whose rows and columns are ``padded``, in whole blocks."""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._addresses import address, call_of, load, row_bytes, store
from ._frame import lean
from ._tiles import padded
from ._vectors import _CHECKED, _INDEX, _LANE, WIDTH


def _turn_block(builder: Any, T: Any, B: Any, into: Any, step: Any) -> None:
    """A block of rows at T, ``into`` bytes apart, becomes the transpose of one at B: rounds of exchanged halves."""
    rows = [load(builder, builder.add(B, builder.mul(step, _INDEX(r)))) for r in range(WIDTH)]
    apart, kind = 1, ir.VectorType(_LANE, WIDTH)
    while apart < WIDTH:
        lower = kind([c + (WIDTH - apart if c & apart else 0) for c in range(WIDTH)])
        upper = kind([c + (WIDTH if c & apart else apart) for c in range(WIDTH)])
        turned = list(rows)
        for r in range(WIDTH):
            if not r & apart:
                turned[r] = builder.shuffle_vector(rows[r], rows[r + apart], lower)
                turned[r + apart] = builder.shuffle_vector(rows[r], rows[r + apart], upper)
        rows, apart = turned, 2 * apart
    for r, row in enumerate(rows):
        store(builder, row, builder.add(T, builder.mul(into, _INDEX(r))))


def _transposing(upper: bool) -> Any:
    def body(builder, T, B, into, step, m, n):
        with cgutils.for_range_slice(builder, _INDEX(0), m, _INDEX(WIDTH), inc=True) as (i, _):
            begin = i if upper else _INDEX(0)
            with cgutils.for_range_slice(builder, begin, n, _INDEX(WIDTH), inc=True) as (j, _):
                to = builder.add(T, builder.add(builder.mul(into, j), builder.mul(_INDEX(8), i)))
                of = builder.add(B, builder.add(builder.mul(step, i), builder.mul(_INDEX(8), j)))
                _turn_block(builder, to, of, into, step)

    def take(typing_context, T, B, m, n):
        def generate(context, builder, signature, arguments):
            T, B, m, n = arguments
            kinds = signature.args
            places = [address(context, builder, kind, a) for kind, a in zip(kinds[:2], (T, B), strict=True)]
            steps = [row_bytes(context, builder, kind, a) for kind, a in zip(kinds[:2], (T, B), strict=True)]
            call_of(builder, "transpose_upper" if upper else "transpose", body, [*places, *steps, m, n])
            return context.get_dummy_value()

        return types.void(T, B, types.int64, types.int64), generate

    return cast(Any, intrinsic)(take)


@lean
def _transpose_plain(T, B, m, n):
    for i in range(min(padded(m), B.shape[0], T.shape[1])):
        for j in range(min(padded(n), B.shape[1], T.shape[0])):
            T[j, i] = B[i, j]


@lean
def _transpose_upper_plain(T, B, m, n):
    for i in range(m):
        for j in range(i, n):
            T[j, i] = B[i, j]


transpose: Any = _transpose_plain if _CHECKED else _transposing(False)
"""``(T, B, m, n)``: T = B' for m rows of n numbers, in whole blocks: both have ``padded`` rows too."""
transpose_upper: Any = _transpose_upper_plain if _CHECKED else _transposing(True)
"""Likewise of the upper half, with the blocks on the diagonal whole."""

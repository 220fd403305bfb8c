"""Sums of many rows, each times a number, and what else is done with whole blocks of numbers.

A sum that goes row by row through memory waits for each row to be written before the next is added. Here a few blocks
of columns stay in registers until all rows are in them. Rows are ``padded`` numbers long, so that every block is whole;
what is behind their last number comes into nothing else. With Numba's bounds checks on, these are plain loops, over
whole blocks too as far as arrays go: what is behind the last number is then what it is without checks.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._addresses import BYTES, ONES, ZEROS, address, blocks_of, call_of, everywhere, load, row_bytes, store
from ._frame import lean
from ._tiles import padded
from ._vectors import _BLOCK, _CHECKED, _DOUBLE, _INDEX, _LANE, WIDTH, _multiply_add, _splat

_MOST = 5
"""Blocks that are summed at a time."""


def _of_block(name: str) -> Callable[[Any, Any], Any]:
    """Return a call of a function of LLVM's, number by number."""
    kind = ir.FunctionType(_BLOCK, [_BLOCK])
    full = f"llvm.{name}.v{WIDTH}f64"
    return lambda builder, block: builder.call(cgutils.get_or_insert_function(builder.module, kind, full), (block,))


_absolute, _square_root = _of_block("fabs"), _of_block("sqrt")


def sum_rows(builder: Any, what: str, sums: list[Any], a: Any, B: Any, step: Any, rows: Any) -> None:
    """Adds to the blocks at ``sums`` what ``what`` says of ``rows`` rows, the first at B and ``step`` bytes apart."""
    with cgutils.for_range(builder, rows) as loop:
        row, factor = builder.add(B, builder.mul(step, loop.index)), None
        if what != "squares":
            factor = everywhere(builder, builder.add(a, builder.mul(_INDEX(8), loop.index)))
            factor = builder.fneg(factor) if what == "minus" else factor
            factor = _absolute(builder, factor) if what == "sizes" else factor
        for k, total in enumerate(sums):
            x = load(builder, row, k)
            x = _absolute(builder, x) if what == "sizes" else x
            builder.store(_multiply_add(builder, x if factor is None else factor, x, builder.load(total)), total)


def _by_some_blocks(builder: Any, blocks: Any, body: Callable[[Any, int], None]) -> None:
    """``body(bytes before, k)`` for k blocks at a time, until all are done."""
    with builder.if_then(builder.icmp_signed(">", blocks, _INDEX(0))):
        rounds = builder.sdiv(builder.sub(blocks, _INDEX(1)), _INDEX(_MOST))
        with cgutils.for_range(builder, rounds) as loop:
            body(builder.mul(loop.index, _INDEX(_MOST * BYTES)), _MOST)
        left = builder.sub(blocks, builder.mul(rounds, _INDEX(_MOST)))
        for k in range(1, _MOST + 1):
            with builder.if_then(builder.icmp_signed("==", left, _INDEX(k))):
                body(builder.mul(rounds, _INDEX(_MOST * BYTES)), k)


def _summing(what: str) -> Any:
    """Return an intrinsic: the blocks at ``out`` become those at ``base`` with rows of B added."""

    def body(builder, out, base, a, B, step, rows, blocks):
        def some(before: Any, k: int) -> None:
            sums = [cgutils.alloca_once(builder, _BLOCK) for _ in range(k)]
            for i, total in enumerate(sums):
                builder.store(load(builder, builder.add(base, before), i), total)
            sum_rows(builder, what, sums, a, builder.add(B, before), step, rows)
            for i, total in enumerate(sums):
                store(builder, builder.load(total), builder.add(out, before), i)

        _by_some_blocks(builder, blocks, some)

    def take(typing_context, out, base, a, B, first, last, start, stop):
        def generate(context, builder, signature, arguments):
            out, base, a, B, first, last, start, stop = arguments
            kinds = signature.args
            given = [
                address(context, builder, kinds[0], out, start),
                address(context, builder, kinds[1], base, start),
                address(context, builder, kinds[2], a, first),
                address(context, builder, kinds[3], B, first, start),
                row_bytes(context, builder, kinds[3], B),
                builder.sub(last, first),
                blocks_of(builder, builder.sub(stop, start)),
            ]
            call_of(builder, what, body, given)
            return context.get_dummy_value()

        return types.void(out, base, a, B, *[types.int64] * 4), generate

    return cast(Any, intrinsic)(take)


def _spreading(typing_context, B, a, v, first, last, start, stop):
    def body(builder, B, a, v, step, rows, blocks):
        def some(before: Any, k: int) -> None:
            added = [load(builder, builder.add(v, before), i) for i in range(k)]
            with cgutils.for_range(builder, rows) as loop:
                row = builder.add(builder.add(B, before), builder.mul(step, loop.index))
                factor = everywhere(builder, builder.add(a, builder.mul(_INDEX(8), loop.index)))
                for i in range(k):
                    store(builder, _multiply_add(builder, factor, added[i], load(builder, row, i)), row, i)

        _by_some_blocks(builder, blocks, some)

    def generate(context, builder, signature, arguments):
        B, a, v, first, last, start, stop = arguments
        kinds = signature.args
        given = [
            address(context, builder, kinds[0], B, first, start),
            address(context, builder, kinds[1], a, first),
            address(context, builder, kinds[2], v, start),
            row_bytes(context, builder, kinds[0], B),
            builder.sub(last, first),
            blocks_of(builder, builder.sub(stop, start)),
        ]
        call_of(builder, "spread", body, given)
        return context.get_dummy_value()

    return types.void(B, a, v, *[types.int64] * 4), generate


_plus, _minus, _sizes, _squares = map(_summing, ("plus", "minus", "sizes", "squares"))
_spread: Any = cast(Any, intrinsic)(_spreading)


def _summing_plain(term: Any) -> Any:
    """Return a function that adds the sum over j of ``term(a_j, B_jc)`` to each number of a row, as a plain loop."""

    @lean
    def plain(out, base, a, B, first, last, start, stop):
        for c in range(start, min(start + padded(stop - start), len(out), len(base), B.shape[1])):
            total = base[c]
            for j in range(first, last):
                total += term(a[j], B[j, c])
            out[c] = total

    return plain


_plus_plain = _summing_plain(lean(lambda a, b: a * b))
_minus_plain = _summing_plain(lean(lambda a, b: -(a * b)))
_sizes_plain = _summing_plain(lean(lambda a, b: abs(a * b)))
_squares_plain = _summing_plain(lean(lambda a, b: b * b))


@lean
def _spread_plain(B, a, v, first, last, start, stop):
    for j in range(first, last):
        for c in range(start, min(start + padded(stop - start), len(v), B.shape[1])):
            B[j, c] += a[j] * v[c]


plus_rows: Any = _plus_plain if _CHECKED else _plus
"""``(out, base, a, B, first, last, start, stop)``: out = base + sum_j a_j B_j over rows from ``first`` to ``last``, in
columns from ``start`` to ``stop``."""
minus_rows: Any = _minus_plain if _CHECKED else _minus
"""Likewise with the sum taken off."""
plus_sizes: Any = _sizes_plain if _CHECKED else _sizes
"""Likewise of |a_j| |B_j|."""
plus_squares: Any = _squares_plain if _CHECKED else _squares
"""Likewise of B_j^2; ``a`` is any vector."""
add_to_rows: Any = _spread_plain if _CHECKED else _spread
"""``(B, a, v, first, last, start, stop)``: B_j += a_j v in rows from ``first`` to ``last``."""


def _each(name: str, formula: Callable[..., Any], count: int) -> Any:
    """``out = formula(...)`` of vectors, number by number, up to a column."""

    def body(builder, *arguments):
        *places, blocks = arguments
        with cgutils.for_range(builder, blocks) as loop:
            into, *given = (builder.add(place, builder.mul(_INDEX(BYTES), loop.index)) for place in places)
            store(builder, formula(builder, *(load(builder, place) for place in given)), into)

    def write(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        *vectors, stop = arguments
        places = [address(context, builder, kind, v) for kind, v in zip(signature.args, vectors, strict=False)]
        call_of(builder, name, body, [*places, blocks_of(builder, stop)])
        return context.get_dummy_value()

    def none(typing_context, out, stop):
        return types.void(out, types.int64), write

    def one(typing_context, out, a, stop):
        return types.void(out, a, types.int64), write

    def two(typing_context, out, a, b, stop):
        return types.void(out, a, b, types.int64), write

    def three(typing_context, out, a, b, c, stop):
        return types.void(out, a, b, c, types.int64), write

    return cast(Any, intrinsic)((none, one, two, three)[count])


@lean
def _clear_plain(out, stop):
    for j in range(min(padded(stop), len(out))):
        out[j] = 0.0


def _of_one_plain(formula: Any) -> Any:
    """``out = formula(a)`` as a plain loop."""

    @lean
    def plain(out, a, stop):
        for j in range(min(padded(stop), len(out), len(a))):
            out[j] = formula(a[j])

    return plain


def _of_two_plain(formula: Any) -> Any:
    """``out = formula(a, b)`` as a plain loop."""

    @lean
    def plain(out, a, b, stop):
        for j in range(min(padded(stop), len(out), len(a), len(b))):
            out[j] = formula(a[j], b[j])

    return plain


_copy_plain, _invert_plain, _root_plain = map(
    _of_one_plain, (lean(lambda a: a), lean(lambda a: 1.0 / a), lean(lambda a: np.sqrt(a)))
)
_subtract_plain, _multiply_plain = map(_of_two_plain, (lean(lambda a, b: a - b), lean(lambda a, b: a * b)))


@lean
def _damping_gradient_plain(out, d, a, b, stop):
    for j in range(min(padded(stop), len(out), len(d), len(a), len(b))):
        out[j] = d[j] * (a[j] - b[j])


clear: Any = _clear_plain if _CHECKED else _each("clear", lambda builder: ZEROS, 0)
"""``(out, stop)``: out = 0 up to a column; whole blocks, as in all that follow."""
put: Any = _copy_plain if _CHECKED else _each("put", lambda builder, a: a, 1)
"""``(out, a, stop)``: out = a."""
put_inverse: Any = _invert_plain if _CHECKED else _each("invert", lambda builder, a: builder.fdiv(ONES, a), 1)
"""``(out, a, stop)``: out = 1 / a."""
put_root: Any = _root_plain if _CHECKED else _each("root", _square_root, 1)
"""``(out, a, stop)``: out = sqrt(a)."""
put_difference: Any = _subtract_plain if _CHECKED else _each("subtract", lambda builder, a, b: builder.fsub(a, b), 2)
"""``(out, a, b, stop)``: out = a - b."""
put_product: Any = _multiply_plain if _CHECKED else _each("multiply", lambda builder, a, b: builder.fmul(a, b), 2)
"""``(out, a, b, stop)``: out = a b."""
put_damping_gradient: Any = (
    _damping_gradient_plain
    if _CHECKED
    else _each("damping_gradient", lambda builder, d, a, b: builder.fmul(d, builder.fsub(a, b)), 3)
)
"""``(out, d, a, b, stop)``: out = d (a - b)."""


def _multiplying(typing_context, out, by, a, n):
    def some(builder, factor, out, a):
        store(builder, builder.fmul(factor, load(builder, a)), out)

    def body(builder, out, by, a, n):
        factor, size = _splat(builder, by, _BLOCK), _INDEX(8)
        whole = builder.and_(n, _INDEX(-WIDTH))
        with cgutils.for_range_slice(builder, _INDEX(0), whole, _INDEX(WIDTH), inc=True) as (j, _):
            some(builder, factor, *(builder.add(at, builder.mul(size, j)) for at in (out, a)))
        is_left, is_long = builder.icmp_signed("<", whole, n), builder.icmp_signed(">", whole, _INDEX(0))
        with builder.if_then(builder.and_(is_left, is_long)):
            before = builder.mul(size, builder.sub(n, _INDEX(WIDTH)))
            some(builder, factor, *(builder.add(at, before) for at in (out, a)))
        with builder.if_then(builder.not_(is_long)), cgutils.for_range(builder, n) as loop:
            places = (builder.add(at, builder.mul(size, loop.index)) for at in (out, a))
            into, of = (builder.inttoptr(place, _DOUBLE.as_pointer()) for place in places)
            builder.store(builder.fmul(by, builder.load(of)), into)

    def generate(context, builder, signature, arguments):
        _, by, _, n = arguments
        places = [address(context, builder, signature.args[k], arguments[k]) for k in (0, 2)]
        call_of(builder, "multiple", body, [places[0], by, places[1], n])
        return context.get_dummy_value()

    return types.void(out, types.float64, a, types.int64), generate


@lean
def _multiple_plain(out, by, a, n):
    for c in range(min(n, len(out), len(a))):
        out[c] = by * a[c]


put_multiple: Any = _multiple_plain if _CHECKED else cast(Any, intrinsic)(_multiplying)
"""``(out, by, a, n)``: out = by a, of n numbers and no more: the last block is that of the last numbers."""


def _seeking(typing_context, a, b, stop):
    def larger(builder, x, y):
        return builder.select(builder.fcmp_ordered(">", x, y), x, y)

    def body(builder, a, b, blocks):
        most = cgutils.alloca_once_value(builder, ZEROS)
        with cgutils.for_range(builder, blocks) as loop:
            x, y = (load(builder, builder.add(at, builder.mul(_INDEX(BYTES), loop.index))) for at in (a, b))
            builder.store(larger(builder, _absolute(builder, builder.fmul(x, y)), builder.load(most)), most)
        block, width = builder.load(most), WIDTH
        while width > 1:
            nothing, half = ir.Constant(ir.VectorType(_DOUBLE, width), ir.Undefined), width // 2
            kind = ir.VectorType(_LANE, half)
            halves = (builder.shuffle_vector(block, nothing, kind(list(range(at, at + half)))) for at in (0, half))
            block, width = larger(builder, *halves), half
        return builder.extract_element(block, _LANE(0))

    def generate(context, builder, signature, arguments):
        places = [address(context, builder, signature.args[k], arguments[k]) for k in range(2)]
        return call_of(builder, "largest", body, [*places, blocks_of(builder, arguments[2])], _DOUBLE)

    return types.float64(a, b, types.int64), generate


@lean
def _largest_plain(a, b, stop):
    most = 0.0
    for j in range(min(stop, len(a), len(b))):
        most = max(most, abs(a[j] * b[j]))
    return most


largest_product: Any = _largest_plain if _CHECKED else cast(Any, intrinsic)(_seeking)
"""``(a, b, stop)``: the largest |a_j b_j| up to a column; what is no number counts as none."""

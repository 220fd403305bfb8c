"""Sums, multiples and products of rows, eight numbers at a time.

A compiler that vectorises a loop takes 16 or 32 numbers at once and leaves the rest to scalar code: all there is, for
rows as short as those of a robot. Here the last eight are masked. Numbers after ``stop`` are read, and written back as
they were: an array needs ``BEYOND`` of them after its last row. With Numba's bounds checks on, these are plain loops.
"""

from __future__ import annotations

from typing import Any, cast

from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import intrinsic

from ._frame import lean

WIDTH = 8
"""Numbers of a block; rows that are read in blocks are filled up to whole ones. LLVM splits a block where registers are
shorter."""

BEYOND = WIDTH - 1
"""Numbers after the last row that may be read."""

_CHECKED = bool(cast(Any, config).BOUNDSCHECK)
_DOUBLE, _INDEX, _LANE = ir.DoubleType(), ir.IntType(64), ir.IntType(32)
_BLOCK = ir.VectorType(_DOUBLE, WIDTH)
_INDICES = ir.VectorType(_INDEX, WIDTH)


def _in_blocks(builder: Any, start: Any, stop: Any, body: Any) -> None:
    """Call ``body(j, None)`` for blocks from j on, and ``body(j, mask)`` for the numbers that are left."""
    stop = builder.select(builder.icmp_signed("<", start, stop), stop, start)
    whole = builder.add(start, builder.and_(builder.sub(stop, start), _INDEX(-WIDTH)))
    with cgutils.for_range_slice(builder, start, whole, _INDEX(WIDTH), inc=True) as (j, _):
        body(j, None)
    with builder.if_then(builder.icmp_signed("<", whole, stop)):
        left = _splat(builder, builder.sub(stop, whole), _INDICES)
        body(whole, builder.icmp_signed("<", _INDICES(list(range(WIDTH))), left))


def _splat(builder: Any, number: Any, kind: Any) -> Any:
    """Return a block of the same number."""
    nothing = ir.Constant(kind, ir.Undefined)
    one = builder.insert_element(nothing, number, _LANE(0))
    return builder.shuffle_vector(one, nothing, ir.VectorType(_LANE, WIDTH)([0] * WIDTH))


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """Return ``a b + c``."""
    kind = ir.FunctionType(_BLOCK, [_BLOCK] * 3)
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, f"llvm.fmuladd.v{WIDTH}f64"), (a, b, c))


def _sum(builder: Any, block: Any) -> Any:
    """Return the sum of a block, by halves."""
    width = WIDTH
    while width > 1:
        nothing, half = ir.Constant(ir.VectorType(_DOUBLE, width), ir.Undefined), width // 2
        lanes = ir.VectorType(_LANE, half)
        halves = (builder.shuffle_vector(block, nothing, lanes(list(range(at, at + half)))) for at in (0, half))
        block, width = builder.fadd(*halves), half
    return builder.extract_element(block, _LANE(0))


def _pointer(context: Any, builder: Any, kind: Any, array: Any, j: Any) -> Any:
    """Return a pointer to the block from number j of an array on."""
    assert kind.layout == "C" and kind.dtype == types.float64, kind
    data = context.make_array(kind)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [j]), _BLOCK.as_pointer())


def _dot(typing_context, a, b, start, stop):
    def generate(context, builder, signature, arguments):
        *rows, start, stop = arguments
        nothing = _BLOCK([0.0] * WIDTH)
        total = cgutils.alloca_once(builder, _BLOCK)
        builder.store(nothing, total)

        def body(j, mask):
            pointers = (_pointer(context, builder, *row, j) for row in zip(signature.args[:2], rows, strict=True))
            x, y = (builder.load(p, align=8) for p in pointers)
            if mask is not None:
                x, y = (builder.select(mask, block, nothing) for block in (x, y))
            builder.store(_multiply_add(builder, x, y, builder.load(total)), total)

        _in_blocks(builder, start, stop, body)
        return _sum(builder, builder.load(total))

    return types.float64(a, b, types.int64, types.int64), generate


def _add(typing_context, a, by, b, start, stop):
    def generate(context, builder, signature, arguments):
        factor = _splat(builder, arguments[1], _BLOCK)
        _update(context, builder, signature, arguments, lambda x: factor)
        return context.get_dummy_value()

    return types.void(a, types.float64, b, types.int64, types.int64), generate


def _add_squares(typing_context, a, b, start, stop):
    def generate(context, builder, signature, arguments):
        _update(context, builder, signature, arguments, lambda x: x)
        return context.get_dummy_value()

    return types.void(a, b, types.int64, types.int64), generate


def _update(context: Any, builder: Any, signature: Any, arguments: Any, factor: Any) -> None:
    """Add ``factor(b) b`` to a, the first array among the arguments; b is the last one."""
    ends, (start, stop) = (0, len(arguments) - 3), arguments[-2:]

    def body(j, mask):
        into, of = (_pointer(context, builder, signature.args[k], arguments[k], j) for k in ends)
        before, x = builder.load(into, align=8), builder.load(of, align=8)
        after = _multiply_add(builder, factor(x), x, before)
        builder.store(after if mask is None else builder.select(mask, after, before), into, align=8)

    _in_blocks(builder, start, stop, body)


_dot_in_blocks, _add_in_blocks, _add_squares_in_blocks = map(cast(Any, intrinsic), (_dot, _add, _add_squares))


@lean
def dot(a, b, start, stop):
    """Return ``sum_j a_j b_j`` over some columns."""
    if _CHECKED:
        total = 0.0
        for j in range(start, stop):
            total += a[j] * b[j]
        return total
    return _dot_in_blocks(a, b, start, stop)


@lean
def add(a, by, b, start, stop):
    """Add ``by b`` to a in some columns."""
    if _CHECKED:
        for j in range(start, stop):
            a[j] += by * b[j]
    else:
        _add_in_blocks(a, by, b, start, stop)


@lean
def add_squares(a, b, start, stop):
    """Add ``b_j^2`` to ``a_j`` in some columns."""
    if _CHECKED:
        for j in range(start, stop):
            a[j] += b[j] * b[j]
    else:
        _add_squares_in_blocks(a, b, start, stop)

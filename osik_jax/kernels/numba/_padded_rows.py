"""Sums of many rows, each times a number, and what else is done with whole blocks of numbers.

A sum that goes row by row through memory waits for each row to be written before the next is added. Here a few blocks
of columns stay in registers until all rows are in them. Rows are ``padded`` numbers long, so that every block is whole;
what is behind their last number comes into nothing else. With Numba's bounds checks on, these are plain loops.

A call hands every array over as seven numbers or more on the stack, and functions that Numba inlines take long to
compile. So each of these takes the addresses of its arrays and calls a function of those, which is written once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from ._frame import lean
from ._vectors import _BLOCK, _CHECKED, _DOUBLE, _INDEX, _LANE, WIDTH, _multiply_add, _splat

BYTES = 8 * WIDTH
"""Of a block."""
_MOST = 5
"""Blocks that are summed at a time."""
_ONES, _NOUGHT = _BLOCK([1.0] * WIDTH), _BLOCK([0.0] * WIDTH)


def call_of(builder: Any, name: str, body: Callable[..., Any], arguments: list[Any], result: Any = None) -> Any:
    """Calls a function of numbers and addresses, ``body(builder, *arguments)``, written where the module has none."""
    name = f"osik_jax_{name}"
    function = builder.module.globals.get(name)
    if function is None:
        kind = ir.FunctionType(ir.VoidType() if result is None else result, [a.type for a in arguments])
        function = ir.Function(builder.module, kind, name)
        function.linkage = "internal"
        function.attributes.add("noinline")
        inside = ir.IRBuilder(function.append_basic_block("entry"))
        found = body(inside, *function.args)
        inside.ret_void() if result is None else inside.ret(found)
    return builder.call(function, arguments)


def _address(context: Any, builder: Any, kind: Any, array: Any, *place: Any) -> Any:
    """Of an array's number at a place, which may leave its last axis out."""
    assert kind.layout == "C" and kind.dtype == types.float64, kind
    made = context.make_array(kind)(context, builder, array)
    at = builder.ptrtoint(made.data, _INDEX)
    for k, index in enumerate(place):
        step = _step(builder, made, kind) if k < kind.ndim - 1 else _INDEX(8)
        at = builder.add(at, builder.mul(step, index))
    return at


def _step(builder: Any, made: Any, kind: Any) -> Any:
    """Bytes of a matrix's row."""
    return builder.mul(_INDEX(8), cgutils.unpack_tuple(builder, made.shape, kind.ndim)[-1])


def row_bytes(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Bytes between the rows of a matrix."""
    return _step(builder, context.make_array(kind)(context, builder, array), kind)


def blocks_of(builder: Any, count: Any) -> Any:
    """Blocks that so many numbers fill."""
    return builder.ashr(builder.add(count, _INDEX(WIDTH - 1)), _INDEX(WIDTH.bit_length() - 1))


def _block(builder: Any, at: Any, k: int = 0) -> Any:
    """A pointer to the k-th block from an address on."""
    return builder.inttoptr(builder.add(at, _INDEX(BYTES * k)), _BLOCK.as_pointer())


def load(builder: Any, at: Any, k: int = 0) -> Any:
    """The k-th block from an address on."""
    return builder.load(_block(builder, at, k), align=8)


def store(builder: Any, block: Any, at: Any, k: int = 0) -> None:
    """Writes a block there."""
    builder.store(block, _block(builder, at, k), align=8)


def everywhere(builder: Any, at: Any) -> Any:
    """A block of the number at an address."""
    return _splat(builder, builder.load(builder.inttoptr(at, _DOUBLE.as_pointer())), _BLOCK)


def _of_block(name: str) -> Callable[[Any, Any], Any]:
    """A function of LLVM's, number by number."""
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
    """The blocks at ``out`` become those at ``base`` with rows of B added."""

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
                _address(context, builder, kinds[0], out, start),
                _address(context, builder, kinds[1], base, start),
                _address(context, builder, kinds[2], a, first),
                _address(context, builder, kinds[3], B, first, start),
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
            _address(context, builder, kinds[0], B, first, start),
            _address(context, builder, kinds[1], a, first),
            _address(context, builder, kinds[2], v, start),
            row_bytes(context, builder, kinds[0], B),
            builder.sub(last, first),
            blocks_of(builder, builder.sub(stop, start)),
        ]
        call_of(builder, "spread", body, given)
        return context.get_dummy_value()

    return types.void(B, a, v, *[types.int64] * 4), generate


_plus, _minus, _sizes, _squares = map(_summing, ("plus", "minus", "sizes", "squares"))
_spread: Any = cast(Any, intrinsic)(_spreading)


@lean
def _plus_plain(out, base, a, B, first, last, start, stop):
    for c in range(start, min(stop, len(out), len(base))):
        total = base[c]
        for j in range(first, last):
            total += a[j] * B[j, c]
        out[c] = total


@lean
def _minus_plain(out, base, a, B, first, last, start, stop):
    for c in range(start, min(stop, len(out), len(base))):
        total = base[c]
        for j in range(first, last):
            total -= a[j] * B[j, c]
        out[c] = total


@lean
def _sizes_plain(out, base, a, B, first, last, start, stop):
    for c in range(start, min(stop, len(out), len(base))):
        total = base[c]
        for j in range(first, last):
            total += abs(a[j] * B[j, c])
        out[c] = total


@lean
def _squares_plain(out, base, a, B, first, last, start, stop):
    for c in range(start, min(stop, len(out), len(base))):
        total = base[c]
        for j in range(first, last):
            total += B[j, c] * B[j, c]
        out[c] = total


@lean
def _spread_plain(B, a, v, first, last, start, stop):
    for j in range(first, last):
        for c in range(start, min(stop, len(v))):
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
        places = [_address(context, builder, kind, v) for kind, v in zip(signature.args, vectors, strict=False)]
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
    for j in range(min(stop, len(out))):
        out[j] = 0.0


@lean
def _copy_plain(out, a, stop):
    for j in range(min(stop, len(out), len(a))):
        out[j] = a[j]


@lean
def _invert_plain(out, a, stop):
    for j in range(min(stop, len(out), len(a))):
        out[j] = 1.0 / a[j]


@lean
def _root_plain(out, a, stop):
    for j in range(min(stop, len(out), len(a))):
        out[j] = np.sqrt(a[j])


@lean
def _subtract_plain(out, a, b, stop):
    for j in range(min(stop, len(out), len(a), len(b))):
        out[j] = a[j] - b[j]


@lean
def _multiply_plain(out, a, b, stop):
    for j in range(min(stop, len(out), len(a), len(b))):
        out[j] = a[j] * b[j]


@lean
def _damping_gradient_plain(out, d, a, b, stop):
    for j in range(min(stop, len(out), len(d), len(a), len(b))):
        out[j] = d[j] * (a[j] - b[j])


clear: Any = _clear_plain if _CHECKED else _each("clear", lambda builder: _NOUGHT, 0)
"""``(out, stop)``: out = 0 up to a column; whole blocks, as in all that follow."""
put: Any = _copy_plain if _CHECKED else _each("put", lambda builder, a: a, 1)
"""``(out, a, stop)``: out = a."""
put_inverse: Any = _invert_plain if _CHECKED else _each("invert", lambda builder, a: builder.fdiv(_ONES, a), 1)
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
        places = [_address(context, builder, signature.args[k], arguments[k]) for k in (0, 2)]
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
        most = cgutils.alloca_once_value(builder, _NOUGHT)
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
        places = [_address(context, builder, signature.args[k], arguments[k]) for k in range(2)]
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
            places = [_address(context, builder, kind, a) for kind, a in zip(kinds[:2], (T, B), strict=True)]
            steps = [row_bytes(context, builder, kind, a) for kind, a in zip(kinds[:2], (T, B), strict=True)]
            call_of(builder, "transpose_upper" if upper else "transpose", body, [*places, *steps, m, n])
            return context.get_dummy_value()

        return types.void(T, B, types.int64, types.int64), generate

    return cast(Any, intrinsic)(take)


@lean
def _transpose_plain(T, B, m, n):
    for i in range(m):
        for j in range(n):
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

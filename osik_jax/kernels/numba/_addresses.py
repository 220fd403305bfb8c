"""Functions of numbers and addresses that intrinsics call, and blocks of numbers at an address.

A call hands every array over as seven numbers or more on the stack, and functions that Numba inlines take long to
compile. So an intrinsic takes the addresses of its arrays and calls a function of those, which is written once.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from ._vectors import _BLOCK, _DOUBLE, _INDEX, WIDTH, _splat

BYTES = 8 * WIDTH
"""Bytes of a block."""
ONES, ZEROS = _BLOCK([1.0] * WIDTH), _BLOCK([0.0] * WIDTH)


def call_of(builder: Any, name: str, body: Callable[..., Any], arguments: list[Any], result: Any = None) -> Any:
    """Call a function of numbers and addresses, ``body(builder, *arguments)``, written where the module has none."""
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


def address(context: Any, builder: Any, kind: Any, array: Any, *place: Any) -> Any:
    """Return the address of an array's number at a place, which may leave its last axis out."""
    assert kind.layout == "C" and kind.dtype == types.float64, kind
    made = context.make_array(kind)(context, builder, array)
    at = builder.ptrtoint(made.data, _INDEX)
    for k, index in enumerate(place):
        step = _step(builder, made, kind) if k < kind.ndim - 1 else _INDEX(8)
        at = builder.add(at, builder.mul(step, index))
    return at


def _step(builder: Any, made: Any, kind: Any) -> Any:
    """Return the bytes of a matrix's row."""
    return builder.mul(_INDEX(8), cgutils.unpack_tuple(builder, made.shape, kind.ndim)[-1])


def row_bytes(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """Return the bytes between the rows of a matrix."""
    return _step(builder, context.make_array(kind)(context, builder, array), kind)


def blocks_of(builder: Any, count: Any) -> Any:
    """Return how many blocks so many numbers fill."""
    return builder.ashr(builder.add(count, _INDEX(WIDTH - 1)), _INDEX(WIDTH.bit_length() - 1))


def _block(builder: Any, at: Any, k: int = 0) -> Any:
    """Return a pointer to the k-th block from an address on."""
    return builder.inttoptr(builder.add(at, _INDEX(BYTES * k)), _BLOCK.as_pointer())


def load(builder: Any, at: Any, k: int = 0) -> Any:
    """Return the k-th block from an address on."""
    return builder.load(_block(builder, at, k), align=8)


def store(builder: Any, block: Any, at: Any, k: int = 0) -> None:
    """Writes a block there."""
    builder.store(block, _block(builder, at, k), align=8)


def everywhere(builder: Any, at: Any) -> Any:
    """Return a block of the number at an address."""
    return _splat(builder, builder.load(builder.inttoptr(at, _DOUBLE.as_pointer())), _BLOCK)

"""Products of matrices in a program, and their precision."""

from collections.abc import Iterator
from typing import Any

import jax

HIGHEST = jax.lax.Precision.HIGHEST


def products_of(jaxpr: Any) -> Iterator[Any]:
    """Precisions of a program's products of matrices; of those with vectors XLA makes sums, which no GPU rounds."""
    for equation in jaxpr.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), (batched, _) = equation.params["dimension_numbers"]
            if contracted and all(v.aval.ndim > len(contracted) + len(batched) for v in equation.invars):
                yield equation.params["precision"]
        if "late" in equation.params:  # what is traced only where a program is for another platform
            given = [jax.ShapeDtypeStruct(v.aval.shape, v.aval.dtype) for v in equation.invars]
            yield from products_of(jax.make_jaxpr(equation.params["late"])(*given).jaxpr)
        for value in jax.tree.leaves(equation.params, is_leaf=lambda x: hasattr(x, "eqns") or hasattr(x, "jaxpr")):
            inner = getattr(value, "jaxpr", value)
            if hasattr(inner, "eqns"):
                yield from products_of(inner)

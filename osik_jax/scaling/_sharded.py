"""A batch split over the devices of a mesh."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._errors import OsikTypeError, OsikValueError
from ..execution._lanes import refuse_explicit_axes


def sharded(function: Callable[..., Any], in_axes: Any = 0, *, mesh: Mesh | None = None) -> ShardedFunction:
    """Return a function like ``jax.jit(jax.vmap(function, in_axes))``, with the batch split over devices.

    Each device runs its own lanes to their own end: no device waits for another one's slowest lane, and nothing is
    sent between them but gradients of what they share. Differentiable in both modes, and may be called inside ``jit``.

    Args:
        function: of one lane; pure.
        in_axes: as ``jax.vmap`` takes it: one for all arguments or one for each, an axis, None, or a tree of them
            (``osik_jax.batch_axes``). What is None is copied to every device.
        mesh: the devices, such as ``jax.sharding.Mesh(jax.devices()[:2], ("lanes",))``; the batch is split over all of
            its axes. Default: all devices, those of other hosts too where ``jax.distributed`` joined them.

    Returns:
        A function of batches. Results have the lanes in front and stay on their devices. Compiled once for each shape;
        keep it, for another call of ``sharded`` compiles anew.

    Raises:
        TypeError: a function that cannot be called, or a mesh that is none.
    """
    if not callable(function):
        raise OsikTypeError(f"{function!r} is no function")
    if mesh is not None and not isinstance(mesh, Mesh):
        raise OsikTypeError(f"mesh is {mesh!r}; it is a jax.sharding.Mesh of devices")
    return ShardedFunction(function, in_axes, Mesh(jax.devices(), ("lanes",)) if mesh is None else mesh)


class ShardedFunction:
    """Function of a batch whose lanes are split over several devices.

    Attributes:
        function: of one lane.
        in_axes: which axes are split.
        mesh: the devices.
        run: the compiled function of arguments whose lanes the devices divide; it takes none from another device.
    """

    def __init__(self, function: Callable[..., Any], in_axes: Any, mesh: Mesh):
        self.function, self.in_axes, self.mesh = function, in_axes, mesh
        self._axes = tuple(in_axes) if isinstance(in_axes, list) else in_axes
        self._known: dict[Any, list[NamedSharding]] = {}  # where arrays are wanted, by the structure of the arguments
        self._places = jax.tree.map(self._place, self._axes, is_leaf=lambda axis: axis is None)
        # Checks of what varies over the mesh are off: loops inside the solvers begin with constants, which do not.
        mapped = jax.shard_map(
            jax.vmap(_making_empty_arrays(function), in_axes=self._axes),
            mesh=mesh,
            in_specs=jax.tree.map(lambda place: place.spec, self._places),
            out_specs=PartitionSpec(mesh.axis_names),
            check_vma=False,
        )
        self.run = jax.jit(mapped)
        functools.update_wrapper(self, function, updated=())

    def __call__(self, *args: Any) -> Any:
        """Return the results of all lanes.

        A number of lanes that the devices do not divide is filled up with copies of the last lane, which are cut off
        again; that moves data between devices, so large batches had better divide.

        Raises:
            ValueError: ``in_axes`` does not fit the arguments, lanes differ in number, or there are none.
            TypeError: an array is sharded over an explicit axis of a mesh.
        """
        leaves, structure, places = self._flat(args)
        count = _count_lanes(leaves, places)
        missing = -count % self.mesh.size
        if missing:
            leaves = [_filled(a, _axis(place), missing) for a, place in zip(leaves, places, strict=True)]
        if jax.process_count() == 1:
            wanted = [isinstance(a, jax.Array) and not isinstance(a, Tracer) and a.committed for a in leaves]
        else:
            wanted = [not isinstance(a, _NUMBERS) for a in leaves]
        out = self.run(*structure.unflatten(_moved(leaves, places, wanted)))
        return jax.tree.map(lambda a: a[:count], out) if missing else out

    def place(self, *args: Any) -> tuple[Any, ...]:
        """Return the arguments on the function's devices, so that calls in a loop copy nothing.

        Python numbers stay, because they adapt to any precision.

        Raises:
            ValueError: as a call does, and where the devices do not divide the number of lanes.
        """
        leaves, structure, places = self._flat(args)
        count = _count_lanes(leaves, places)
        if count % self.mesh.size:
            raise OsikValueError(f"{count} lanes do not divide over {self.mesh.size} devices")
        return structure.unflatten(_moved(leaves, places, [not isinstance(a, _NUMBERS) for a in leaves]))

    def _flat(self, args: tuple[Any, ...]) -> tuple[list[Any], Any, list[NamedSharding]]:
        """Return the arrays of the arguments, their structure, and where each array is wanted."""
        refuse_explicit_axes(args)
        leaves, structure = jax.tree.flatten(args)
        if structure not in self._known:
            if isinstance(self._axes, tuple) and len(self._axes) != len(args):
                raise OsikValueError(f"in_axes has {len(self._axes)} parts, for {len(args)} arguments")
            self._known[structure] = jax.tree.leaves(jax.tree.broadcast(self._places, args))
        return leaves, structure, self._known[structure]

    def _place(self, axis: int | None) -> NamedSharding:
        if axis is not None and axis < 0:
            raise OsikValueError(f"in_axes has axis {axis}; axes count from the first, 0")
        split = () if axis is None else (*[None] * axis, self.mesh.axis_names)
        return NamedSharding(self.mesh, PartitionSpec(*split))


_NUMBERS = (bool, int, float, complex)


def _axis(place: NamedSharding) -> int:
    """Return the axis that is split, or -1 where every device has the whole array."""
    return len(place.spec) - 1


def _count_lanes(leaves: list[Any], places: list[NamedSharding]) -> int:
    lengths: set[int] = set()
    for leaf, axis in zip(leaves, map(_axis, places), strict=True):
        shape = np.shape(leaf)
        if axis >= len(shape):
            raise OsikValueError(f"in_axes has axis {axis} for an array of shape {shape}")
        lengths |= {shape[axis]} if axis >= 0 else set()
    if len(lengths) != 1 or 0 in lengths:
        found = ", ".join(str(n) for n in sorted(lengths)) or "none, for in_axes splits no argument"
        raise OsikValueError(f"the arguments that are split need one number of lanes, at least 1; found: {found}")
    return lengths.pop()


def _filled(a: Any, axis: int, missing: int) -> Any:
    """Return an array with its last lane repeated ``missing`` times."""
    if axis < 0:
        return a
    xp = np if isinstance(a, np.ndarray) else jnp
    last = xp.take(a, xp.asarray([a.shape[axis] - 1]), axis=axis)
    return xp.concatenate([a, xp.repeat(last, missing, axis=axis)], axis=axis)


def _moved(leaves: list[Any], places: list[NamedSharding], wanted: list[bool]) -> list[Any]:
    """Return the arrays; those that are wanted on other devices than where they are, are moved."""
    pairs = zip(leaves, places, wanted, strict=True)
    away = [i for i, (a, place, here) in enumerate(pairs) if here and not _is_there(a, place)]
    if not away:
        return leaves
    some, there = [leaves[i] for i in away], [places[i] for i in away]
    if jax.process_count() == 1:
        new = jax.device_put(some, there)
    else:
        new = [_on_all_hosts(a, place) for a, place in zip(some, there, strict=True)]
    replaced = dict(zip(away, new, strict=True))
    return [replaced.get(i, leaf) for i, leaf in enumerate(leaves)]


def _is_there(leaf: Any, place: NamedSharding) -> bool:
    """Return whether an array has the wanted sharding."""
    if not isinstance(leaf, jax.Array) or isinstance(leaf, Tracer) or not leaf.committed:
        return False
    return leaf.sharding == place or leaf.sharding.is_equivalent_to(place, leaf.ndim)  # a spec has several spellings


def _on_all_hosts(a: Any, place: NamedSharding) -> Any:
    """Return a global array from the whole array on each host; each host takes its part without communication."""
    if isinstance(a, Tracer) or (isinstance(a, jax.Array) and not a.is_fully_addressable):
        return jax.device_put(a, place)
    whole = np.asarray(a, jax.dtypes.canonicalize_dtype(a.dtype))
    return jax.make_array_from_callback(whole.shape, place, lambda part: whole[part])


def _making_empty_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with arrays without entries made anew inside it, arguments and constants alike.

    With jaxlib 0.11.2 such an array that comes into a ``shard_map`` from outside ends the process (a segmentation fault
    of the Shardy partitioner, on every kind of device); a robot without geoms has some.
    """

    def anew(a: Any) -> Any:
        return jnp.zeros(a.shape, a.dtype) if isinstance(a, (jax.Array, np.ndarray)) and a.size == 0 else a

    def inside(*args: Any) -> Any:
        traced, shapes = jax.make_jaxpr(function, return_shape=True)(*args)
        traced = traced.replace(consts=[anew(a) for a in traced.consts])
        results = jaxpr_as_fun(traced)(*map(anew, jax.tree.leaves(args)))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return inside

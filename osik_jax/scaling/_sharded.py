"""A batch split over the devices of a mesh."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.extend.core import jaxpr_as_fun
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from .._errors import OsikTypeError, OsikValueError
from ..execution._lanes import refuse_explicit_axes

_SHARED = -1
"""Marker in place of an axis: every device has the whole array."""


def sharded(
    function: Callable[..., Any],
    in_axes: Any = 0,
    *,
    mesh: Mesh | None = None,
    donate_argnums: int | Sequence[int] = (),
) -> ShardedFunction:
    """Return a function like ``jax.jit(jax.vmap(function, in_axes))``, with the batch split over devices.

    Each device runs its own lanes to their own end: no device waits for another one's slowest lane, and nothing is
    sent between them but gradients of what they share. Differentiable in both modes, and may be called inside ``jit``.

    Args:
        function: of one lane; pure.
        in_axes: as ``jax.vmap`` takes it: one for all arguments or one for each, an axis, None, or a tree of them
            (``osik_jax.batch_axes``). What is None is copied to every device.
        mesh: the devices, such as ``jax.sharding.Mesh(jax.devices()[:2], ("lanes",))``; the batch is split over all of
            its axes. Default: all devices, those of other hosts too where ``jax.distributed`` joined them.
        donate_argnums: arguments whose memory the results may take, as in ``jax.jit``; they are lost to the caller.

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
    return ShardedFunction(function, in_axes, Mesh(jax.devices(), ("lanes",)) if mesh is None else mesh, donate_argnums)


class ShardedFunction:
    """Function of a batch whose lanes are split over several devices.

    Attributes:
        function: of one lane.
        in_axes: which axes are split.
        mesh: the devices.
    """

    def __init__(
        self, function: Callable[..., Any], in_axes: Any, mesh: Mesh, donate_argnums: int | Sequence[int] = ()
    ):
        self.function, self.in_axes, self.mesh = function, in_axes, mesh
        self._donated = {donate_argnums} if isinstance(donate_argnums, int) else set(donate_argnums)
        self._known: dict[Any, _Program] = {}  # by the structure of the arguments
        functools.update_wrapper(self, function, updated=())

    def __call__(self, *args: Any) -> Any:
        """Return the results of all lanes.

        A number of lanes that the devices do not divide is filled up with copies of the last lane, which are cut off
        again; that moves data between devices, so large batches had better divide.

        Raises:
            ValueError: ``in_axes`` does not fit the arguments, lanes differ in number, or there are none.
            TypeError: an array is sharded over an explicit axis of a mesh.
        """
        leaves, program = self._program(args)
        count = program.count(leaves)
        missing = -count % self.mesh.size
        if missing:
            leaves = [_filled(a, axis, missing) for a, axis in zip(leaves, program.axes, strict=True)]
        out = program.run(*program.reachable(leaves))
        return jax.tree.map(lambda a: a[:count], out) if missing else out

    def place(self, *args: Any) -> tuple[Any, ...]:
        """Return the arguments on the function's devices, so that calls in a loop copy nothing.

        Raises:
            ValueError: as a call does, and where the devices do not divide the number of lanes.
        """
        leaves, program = self._program(args)
        count = program.count(leaves)
        if count % self.mesh.size:
            raise OsikValueError(f"{count} lanes do not divide over {self.mesh.size} devices")
        return jax.tree.unflatten(program.structure, program.placed(leaves))

    def _program(self, args: tuple[Any, ...]) -> tuple[list[Any], _Program]:
        """Return the arrays of the arguments, and the program for their structure."""
        refuse_explicit_axes(args)
        leaves, structure = jax.tree.flatten(args)
        known = self._known.get(structure)
        if known is None:
            known = self._known[structure] = _Program(self, args, structure)
        return leaves, known


class _Program:
    """Compiled function of arrays, for arguments of one structure.

    Attributes:
        structure: of the arguments.
        axes: for each array, ``_SHARED`` where it is not split.
        places: where each array is wanted.
        run: the compiled function; takes what is elsewhere from the host, but not from another device.
    """

    def __init__(self, owner: ShardedFunction, args: tuple[Any, ...], structure: Any):
        self.structure, self.axes = structure, _flat_axes(owner.in_axes, args)
        self._split = [(i, axis) for i, axis in enumerate(self.axes) if axis != _SHARED]
        names = owner.mesh.axis_names
        specs = [PartitionSpec(*[None] * axis, names) if axis != _SHARED else PartitionSpec() for axis in self.axes]
        self.places = [NamedSharding(owner.mesh, spec) for spec in specs]
        ends = np.cumsum([0, *(argument.num_leaves for argument in structure.children())])
        donated = [i for k in owner._donated for i in range(ends[k], ends[k + 1])]
        axes = [None if axis == _SHARED else axis for axis in self.axes]

        lane = _making_empty_arrays(lambda *own: owner.function(*jax.tree.unflatten(structure, own)))

        # Checks of what varies over the mesh are off: loops inside the solvers begin with constants, which do not.
        mapped = jax.shard_map(
            jax.vmap(lane, in_axes=tuple(axes)),
            mesh=owner.mesh,
            in_specs=tuple(specs),
            out_specs=PartitionSpec(names),
            check_vma=False,
        )
        self.run = jax.jit(mapped, in_shardings=self.places, donate_argnums=donated)

    def count(self, leaves: list[Any]) -> int:
        """Return the number of lanes."""
        lengths: set[int] = set()
        for i, axis in self._split:
            shape = np.shape(leaves[i])
            if not 0 <= axis < len(shape):
                raise OsikValueError(f"in_axes has axis {axis} for an array of shape {shape}")
            lengths.add(shape[axis])
        if len(lengths) != 1 or 0 in lengths:
            found = ", ".join(str(n) for n in sorted(lengths)) or "none, for in_axes splits no argument"
            raise OsikValueError(f"the arguments that are split need one number of lanes, at least 1; found: {found}")
        return lengths.pop()

    def reachable(self, leaves: list[Any]) -> list[Any]:
        """Return the arrays; those whose sharding ``run`` does not accept are moved."""
        if jax.process_count() > 1:
            return self.placed(leaves)
        return self._with_moved(leaves, [isinstance(a, jax.Array) and not isinstance(a, Tracer) for a in leaves])

    def placed(self, leaves: list[Any]) -> list[Any]:
        """Return the arrays with the wanted shardings; Python numbers stay, because they adapt to any precision."""
        return self._with_moved(leaves, [not isinstance(a, (bool, int, float, complex)) for a in leaves])

    def _with_moved(self, leaves: list[Any], wanted: list[bool]) -> list[Any]:
        """Return the arrays; selected ones without the wanted sharding are moved."""
        pairs = zip(leaves, self.places, strict=True)
        away = [i for i, (a, place) in enumerate(pairs) if wanted[i] and not _is_there(a, place)]
        there = moved([leaves[i] for i in away], [self.places[i] for i in away])
        whole = list(leaves)
        for i, a in zip(away, there, strict=True):
            whole[i] = a
        return whole


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
        results = jaxpr_as_fun(traced)(*(anew(a) for a in args))
        return jax.tree.unflatten(jax.tree.structure(shapes), results)

    return inside


def _flat_axes(in_axes: Any, args: tuple[Any, ...]) -> list[int]:
    if isinstance(in_axes, (tuple, list)):
        if len(in_axes) != len(args):
            raise OsikValueError(f"in_axes has {len(in_axes)} parts, for {len(args)} arguments")
        in_axes = tuple(in_axes)
    marked = jax.tree.map(lambda axis: _SHARED if axis is None else axis, in_axes, is_leaf=lambda axis: axis is None)
    return jax.tree.leaves(jax.tree.broadcast(marked, args))


def _is_there(leaf: Any, place: NamedSharding) -> bool:
    """Return whether an array has the wanted sharding."""
    if not isinstance(leaf, jax.Array) or isinstance(leaf, Tracer) or not leaf.committed:
        return False
    return leaf.sharding == place or leaf.sharding.is_equivalent_to(place, leaf.ndim)  # a spec has several spellings


def moved(leaves: list[Any], places: list[NamedSharding]) -> list[Any]:
    """Return arrays with the wanted shardings, over all hosts; each host has the whole arrays."""
    if not leaves:
        return []
    if jax.process_count() == 1:
        return jax.device_put(leaves, places)
    return [_on_all_hosts(a, place) for a, place in zip(leaves, places, strict=True)]


def _filled(a: Any, axis: int, missing: int) -> Any:
    """Return an array with its last lane repeated ``missing`` times."""
    if axis == _SHARED:
        return a
    xp = np if isinstance(a, np.ndarray) else jnp
    last = xp.take(a, xp.asarray([a.shape[axis] - 1]), axis=axis)
    return xp.concatenate([a, xp.repeat(last, missing, axis=axis)], axis=axis)


def _on_all_hosts(a: Any, place: NamedSharding) -> Any:
    """Return a global array from the whole array on each host; each host takes its part without communication."""
    if isinstance(a, Tracer) or (isinstance(a, jax.Array) and not a.is_fully_addressable):
        return jax.device_put(a, place)
    whole = np.asarray(a, jax.dtypes.canonicalize_dtype(a.dtype))
    return jax.make_array_from_callback(whole.shape, place, lambda part: whole[part])

"""Export of a control step as bytes that need JAX alone."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from .._errors import OsikTypeError, OsikValueError, missing_extra
from ..batching._names import find_leaves, leaf_names, replace_named
from ..control._checks import check_setting, check_tasks, checked_limits
from ..control._rollout import move, remembering
from ..control._step import aim, step
from ..control._units import configuration_units, unit_of, velocity_units
from ..limits import Limit, Limits
from ..numerics._arguments import check_count
from ..robot import Robot
from ..schemes import Scheme
from ..schemes._default import scheme_for
from ..tasks import Task
from . import _exported
from ._exported import BATCH, FORMAT, Port

LAST_VELOCITY = "last_velocity"
"""Input of a controller whose tasks or limits remember the velocity of the last step."""
PLATFORMS = ("cpu", "cuda")
_PIVOTED_QR = ("lapack_dgeqp3_ffi", "lapack_sgeqp3_ffi", "cuhybrid_geqp3")
"""Calls of a pivoted QR, which hierarchies and saturation need; JAX guarantees them for its own release alone."""


def export_controller(
    robot: Robot,
    tasks: Mapping[str, Task],
    *,
    scheme: Scheme | None = None,
    limits: Limits | None = None,
    dt: float = 0.005,
    batch: int | Literal["symbolic"] | None = None,
    platforms: Sequence[str] = PLATFORMS,
    inputs: Sequence[str] | None = None,
) -> bytes:
    """Return a control step as bytes, for ``load_exported`` in a process with JAX alone.

    The inputs are the configuration ``q``, the targets of the tasks and, where tasks or limits remember it, the
    velocity of the last step (``last_velocity``). The outputs are ``velocity``, ``q`` after a step of ``dt``, and
    ``status``. All other numbers are constants of the program. The precision is that of the robot.

    The bytes are a zip file: ``description.json`` (names, shapes and units), one ``program.PLATFORM`` for each
    platform (StableHLO as ``jax.export`` writes it), and ``osik_controller.py``, the loader as a module.

    Args:
        robot: the robot.
        tasks: by name, as ``solve`` takes them. Tasks of your own and functions are part of the program.
        scheme: as in ``solve``; its ``backend`` is replaced by ``"jax"``.
        limits: as in ``solve``.
        dt: time of a step [s].
        batch: None: one robot. A number: so many robots. ``"symbolic"``: any number of robots. All inputs and outputs
            have the leading axis.
        platforms: ``"cpu"``, ``"cuda"`` or both.
        inputs: names of the tasks' numbers that are inputs, as ``batch_axes`` takes them: ``"hand.weight"``.
            Default: the targets of all tasks.

    Raises:
        KeyError: ``inputs`` names a number that does not exist.
        ModuleNotFoundError: ``flatbuffers`` is not installed: ``pip install ".[export]"``.
        TypeError, ValueError: as in ``solve``; invalid ``batch`` or ``platforms``.
    """
    check_setting("export_controller(robot, tasks)", robot, scheme, dt)
    check_tasks(tasks, robot)
    _check_options(batch, platforms)
    tasks, bounds = dict(tasks), checked_limits(robot, limits)
    scheme = scheme_for(tasks, robot.q0.dtype) if scheme is None else scheme
    if hasattr(scheme, "backend"):
        scheme = dataclasses.replace(scheme, backend="jax")  # pyright: ignore[reportCallIssue]
    ports = _input_ports(robot, tasks, bounds, inputs)
    one_step = _controller(robot, tasks, scheme, bounds, dt, tuple(port.name for port in ports))
    exported = [_exported_for(name, one_step, ports, batch) for name in platforms]
    description = {
        "format": FORMAT,
        "inputs": [_with_batch(port, batch) for port in ports],
        "outputs": [_with_batch(port, batch) for port in _output_ports(robot)],
        "dt": float(dt),
        "batch": batch,
        "platforms": list(platforms),
        "scheme": type(scheme).__name__,
        "jax": jax.__version__,
        "same_jax": any(call.encode() in one.mlir_module_serialized for call in _PIVOTED_QR for one in exported),
    }
    files = {"description.json": json.dumps(description, indent=1)}
    files |= {f"program.{name}": _serialized(one) for name, one in zip(platforms, exported, strict=True)}
    files |= {"osik_controller.py": Path(_exported.__file__).read_text(encoding="utf-8")}
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return out.getvalue()


def _check_options(batch: Any, platforms: Any) -> None:
    """Raise TypeError or ValueError for invalid batch or platforms."""
    if isinstance(batch, str) and batch != "symbolic":
        raise OsikValueError(f"batch is {batch!r}; it is None, a number of robots or 'symbolic'")
    if batch is not None and batch != "symbolic":
        check_count("batch", batch)
    if isinstance(platforms, str) or not platforms or set(platforms) - set(PLATFORMS):
        raise OsikValueError(f"platforms is {platforms!r}; it is a sequence of one or both of {PLATFORMS}")


def _input_ports(
    robot: Robot, tasks: dict[str, Task], limits: tuple[Limit, ...] | None, inputs: Sequence[str] | None
) -> list[Port]:
    """Return the inputs in the program's order."""
    if isinstance(inputs, str):
        raise OsikTypeError(f"inputs is a sequence of names, not one string: use ({inputs!r},)")
    names, leaves = leaf_names(tasks), jax.tree.leaves(tasks)
    aimed = [f"{name}.target" for name, task in tasks.items() if getattr(task, "target", None) is not None]
    places = sorted({place for name in (aimed if inputs is None else inputs) for place in find_leaves(names, name)})
    entries, units = configuration_units(robot)
    dtype = str(robot.q0.dtype)
    ports = [Port("q", (robot.nq,), dtype, units, entries, np.asarray(robot.q0).tolist())]
    for place in places:
        unit, value = unit_of(tasks, names[place]), np.asarray(leaves[place])
        ports.append(Port(names[place], value.shape, str(value.dtype), unit, None, value.tolist()))
    if _remembers(tasks, limits):
        entries, units = velocity_units(robot)
        ports.append(Port(LAST_VELOCITY, (robot.nv,), dtype, units, entries, [0.0] * robot.nv))
    return ports


def _remembers(tasks: dict[str, Task], limits: tuple[Limit, ...] | None) -> bool:
    """Return whether a task or limit uses the velocity of the last step."""
    return any(type(part).after not in (Task.after, Limit.after) for part in (*tasks.values(), *(limits or ())))


def _output_ports(robot: Robot) -> list[Port]:
    dtype = str(robot.q0.dtype)
    (q_entries, q_units), (v_entries, v_units) = configuration_units(robot), velocity_units(robot)
    return [
        Port("velocity", (robot.nv,), dtype, v_units, v_entries),
        Port("q", (robot.nq,), dtype, q_units, q_entries),
        Port("status", (), "int32", "osik_jax.Status: 0 is SOLVED"),
    ]


def _with_batch(port: Port, batch: int | str | None) -> dict[str, Any]:
    """Return a port as data for JSON, with the leading axis of the batch."""
    lanes = () if batch is None else (BATCH if batch == "symbolic" else batch,)
    return {**port._asdict(), "shape": [*lanes, *port.shape]}


def _controller(
    robot: Robot,
    tasks: dict[str, Task],
    scheme: Scheme,
    limits: tuple[Limit, ...] | None,
    dt: float,
    names: tuple[str, ...],
) -> Callable[..., tuple[Array, Array, Array]]:
    """Return one step of one robot, as a function of the inputs in their order."""
    leaves = leaf_names(tasks)
    targets = {name: tuple(f"{name}.target{end}" for end in ("", "[0]", "[1]")) for name in tasks}
    aimed = [name for name in tasks if set(targets[name]) & set(names)]

    def one_step(*values: Array) -> tuple[Array, Array, Array]:
        given = dict(zip(names, values, strict=True))
        q, last = given.pop("q"), given.pop(LAST_VELOCITY, None)
        todo = replace_named(tasks, leaves, given)
        # `replace` checks and normalises targets, which `replace_named` does not
        todo = aim(todo, {name: getattr(todo[name], "target") for name in aimed})  # noqa: B009
        todo, kept = remembering((todo, limits), last, True)
        answer = step(robot, q, todo, scheme, kept, jnp.asarray(dt, q.dtype))
        q = move(robot, q, answer.velocity, jnp.asarray(dt, q.dtype))
        return answer.velocity, q, answer.status.astype(jnp.int32)

    return one_step


def _exported_for(
    platform: str, one_step: Callable[..., Any], ports: list[Port], batch: int | str | None
) -> jax.export.Exported:
    """Return the program for one platform.

    A fixed batch for a GPU is exported as one of any size where this process computes on a CPU: its blocks of 16
    lanes, one after another, are for the caches of a CPU.
    """
    lanes: tuple[Any, ...] = ()
    if batch is not None:
        fixed = batch != "symbolic" and (platform == "cpu" or jax.default_backend() != "cpu")
        lanes = (batch,) if fixed else tuple(jax.export.symbolic_shape(BATCH))
        one_step = jax.vmap(one_step)
    shapes = [jax.ShapeDtypeStruct((*lanes, *port.shape), port.dtype) for port in ports]
    allowed = [jax.export.DisabledSafetyCheck.custom_call(call) for call in _PIVOTED_QR]
    return jax.export.export(jax.jit(one_step), platforms=(platform,), disabled_checks=allowed)(*shapes)


def _serialized(exported: jax.export.Exported) -> bytes:
    try:
        return bytes(exported.serialize())
    except ImportError as error:
        raise missing_extra("an export", "flatbuffers", "export") from error

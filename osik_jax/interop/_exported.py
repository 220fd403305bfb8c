"""Loader of exported controllers; it needs jax and flatbuffers alone, and is part of each export."""

from __future__ import annotations

import io
import json
import os
import warnings
import zipfile
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

FORMAT = "osik-jax exported controller 1"
BATCH = "n"
"""Name of the leading axis of any length in the shape of a ``Port``."""


class Port(NamedTuple):
    """One input or output of an exported controller.

    Attributes:
        name: of the input or output, such as ``"q"``, ``"hand.target[0]"`` or ``"velocity"``.
        shape: of the array. The leading entry is ``"n"`` in a controller for batches of any size.
        dtype: of the array.
        unit: of the entries; one text for all, or a list with one for each entry of the last axis.
        entries: names of the entries of the last axis, or None.
        default: value of an input that is not given, for one lane; None for an input that has to be given.
    """

    name: str
    shape: tuple[int | str, ...]
    dtype: str
    unit: str | list[str]
    entries: list[str] | None = None
    default: Any = None


class ExportedController:
    """A compiled control step; ``load_exported`` says what it has."""

    inputs: dict[str, Port]
    outputs: dict[str, Port]

    def __init__(self, description: Mapping[str, Any], program: bytes):
        self.inputs, self.outputs = (
            {port["name"]: Port(**{**port, "shape": tuple(port["shape"])}) for port in description[what]}
            for what in ("inputs", "outputs")
        )
        self.dt, self.batch = description["dt"], description["batch"]
        self.platforms = tuple(description["platforms"])
        self._run = jax.jit(jax.export.deserialize(bytearray(program)).call)

    def __call__(self, q: Any, inputs: Mapping[str, Any] | None = None) -> dict[str, jax.Array]:
        """Return the outputs of one step, by name.

        Args:
            q: configuration, (nq,) or (n, nq) as ``self.inputs["q"]`` says.
            inputs: other inputs by name. An input that is left out has its default in every lane.

        Raises:
            KeyError: an input that does not exist; the message lists the inputs.
            ValueError: a wrong shape, or ``jax_enable_x64`` is off and the controller computes in float64.
        """
        given = {"q": q, **(inputs or {})}
        if unknown := set(given) - set(self.inputs):
            raise KeyError(f"no input {', '.join(map(repr, sorted(unknown)))}; inputs: {', '.join(self.inputs)}")
        lanes = np.shape(q)[:1] if self.batch is not None else ()
        values = [self._value(port, given.get(name), lanes) for name, port in self.inputs.items()]
        return dict(zip(self.outputs, self._run(*values), strict=True))

    def _value(self, port: Port, given: Any, lanes: tuple[int, ...]) -> jax.Array:
        """Return an input as an array of its shape and precision."""
        if port.dtype == "float64" and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
            raise ValueError('this controller computes in float64: jax.config.update("jax_enable_x64", True) first')
        one_lane = port.shape if self.batch is None else port.shape[1:]
        if given is None:
            return jnp.broadcast_to(jnp.asarray(port.default, port.dtype), (*lanes, *one_lane))
        value = jnp.asarray(given, port.dtype)
        fits = value.shape[len(lanes) :] == one_lane and value.shape[: len(lanes)] == lanes
        if not fits or self.batch not in (None, "symbolic", *lanes):
            raise ValueError(f"{port.name} has shape {value.shape}, expected {port.shape}")
        return value

    def __repr__(self) -> str:
        """Return inputs and outputs with their shapes."""
        parts = [f"{p.name} {p.shape} {p.dtype}" for p in (*self.inputs.values(), *self.outputs.values())]
        return f"ExportedController(dt={self.dt}, batch={self.batch!r}, {'; '.join(parts)})"


def load_exported(exported: bytes | str | os.PathLike[str]) -> ExportedController:
    """Return the controller that ``export_controller`` made.

    Args:
        exported: the bytes, or the path of a file with these bytes.

    Returns:
        A compiled control step that needs neither osik_jax nor the robot's file. ``controller(q, {"hand.target[0]":
        position})`` returns the outputs by name. It may be called inside ``jax.jit``.

        - ``inputs``, ``outputs``: by name, each with ``shape``, ``dtype`` and ``unit``; ``"q"`` is the first input. An
            input that is left out has its ``default`` in every lane.
        - ``dt``: time of a step [s].
        - ``batch``: None, a number of lanes or ``"symbolic"``.
        - ``platforms``: the platforms that it was exported for.

    Raises:
        ModuleNotFoundError: ``flatbuffers`` is not installed.
        ValueError: no such bytes; no program for the platform that JAX computes on; a program that calls LAPACK's
            pivoted QR, which JAX guarantees for its own release alone, and another release of JAX.
    """
    file = io.BytesIO(exported) if isinstance(exported, bytes | bytearray) else exported
    if not zipfile.is_zipfile(file):
        raise ValueError(f"these are no bytes of export_controller ({FORMAT})")
    with zipfile.ZipFile(file) as archive:
        description = json.loads(archive.read("description.json"))
        if description.get("format") != FORMAT:
            raise ValueError(f"the format is {description.get('format')!r}, this loader reads {FORMAT!r}")
        if description["same_jax"] and description["jax"] != jax.__version__:
            raise ValueError(
                f"this program needs the release of JAX that made it, {description['jax']}, not {jax.__version__}: "
                "export it again with this release"
            )
        platform = {"gpu": "cuda"}.get(jax.default_backend(), jax.default_backend())
        if platform not in description["platforms"]:
            raise ValueError(f"exported for {description['platforms']}, and JAX computes on {platform!r} here")
        if platform == "cpu" and description["batch"] is not None:
            _warn_of_few_workers()
        return ExportedController(description, archive.read(f"program.{platform}"))


def _warn_of_few_workers() -> None:
    """Warn if batched LAPACK calls of jaxlib 0.10 and 0.11.0 may wait for each other for ever."""
    jaxlib = tuple(int(part) for part in version("jaxlib").split(".")[:3] if part.isdigit())
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if (0, 10) <= jaxlib < (0, 11, 1) and 1 < cores < 8 and "PJRT_NPROC" not in os.environ:
        warnings.warn(
            f"a batch on a CPU of {cores} cores: in this jaxlib, batched factorisations may wait for each other for "
            "ever. Set the environment variable PJRT_NPROC=8 before JAX is imported",
            stacklevel=3,
        )

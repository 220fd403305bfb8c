"""Sampled motion of a robot's joints, and its files."""

from __future__ import annotations

import csv
import io
import os
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikValueError, missing_extra
from .._npz import open_npz
from .._whole_file import whole_file, write_text
from ..control import Trajectory
from ..numerics._arguments import as_array
from ..numerics._columns import read_columns
from ..robot import Robot
from ..robot._joint_selection import check_scalar_joints, dof_names

_KINDS = "position", "velocity", "acceleration"
_LEROBOT = "observation.state", "action", "timestamp"


class Motion(eqx.Module):
    """Joint positions, velocities and accelerations at increasing times.

    Attributes:
        time: [s]. (T,)
        position: of the joints [rad or m]. (T, n)
        velocity: [rad/s or m/s]. (T, n)
        acceleration: [rad/s^2 or m/s^2]. (T, n)
        joints: their names (static).
    """

    time: Float[Array, " T"]
    position: Float[Array, "T n"]
    velocity: Float[Array, "T n"]
    acceleration: Float[Array, "T n"]
    joints: tuple[str, ...] = eqx.field(default=(), static=True)

    @classmethod
    def of(cls, robot: Robot, trajectory: Trajectory) -> Motion:
        """Return the motion of a rollout: each step's velocity, and its changes as accelerations.

        Raises:
            ValueError: the robot has joints that are no hinges or slides.
        """
        check_scalar_joints(robot, "a motion")
        velocity, time = trajectory.solution.velocity, trajectory.time
        pulls = jnp.diff(velocity, axis=0) / jnp.diff(time)[:, None]
        acceleration = jnp.concatenate([pulls, jnp.zeros_like(velocity[:1])])
        return cls(time, trajectory.q[:-1], velocity, acceleration, tuple(dof_names(robot)))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the motion to a file, whose name's end says its kind.

        - ``.npz``: arrays ``time``, ``position``, ``velocity``, ``acceleration`` and ``joints``.
        - ``.csv``: a row a sample; columns ``time``, ``position.JOINT``, ``velocity.JOINT``, ``acceleration.JOINT``.
        - ``.parquet``: LeRobot's columns ``observation.state`` (the positions), ``action`` (those of the next sample)
          and ``timestamp``, beside the velocities and accelerations. It needs the extra ``motion``.

        Raises:
            ValueError: another end of the name.
            ModuleNotFoundError: ``.parquet`` without pyarrow.
            OSError: the file cannot be written.
        """
        kind = _kind(path)
        if kind == ".csv":
            write_text(path, self._as_csv())
            return
        with whole_file(path) as file:
            if kind == ".npz":
                np.savez(file, joints=np.array(self._names(), str), time=self.time, **self._arrays())
            else:
                _pyarrow("parquet").write_table(self._as_table(), file)

    def _names(self) -> list[str]:
        return list(self.joints) or [str(i) for i in range(self.position.shape[1])]

    def _arrays(self) -> dict[str, Any]:
        return {kind: np.asarray(getattr(self, kind)) for kind in _KINDS}

    def _as_csv(self) -> str:
        text = io.StringIO()
        rows = csv.writer(text, lineterminator="\n")
        rows.writerow(["time", *(f"{kind}.{name}" for kind in _KINDS for name in self._names())])
        rows.writerows(np.column_stack([self.time, *self._arrays().values()]).tolist())
        return text.getvalue()

    def _as_table(self) -> Any:
        arrow, arrays = _pyarrow(), self._arrays()
        state = arrays["position"]
        columns = {_LEROBOT[0]: state, _LEROBOT[1]: np.concatenate([state[1:], state[-1:]])}
        columns |= {kind: arrays[kind] for kind in _KINDS[1:]}
        table = arrow.table(
            {name: list(values) for name, values in columns.items()} | {_LEROBOT[2]: np.asarray(self.time)}
        )
        return table.replace_schema_metadata({"joints": "\n".join(self._names())})


def at_rest_outside(
    states: Float[Array, "k T n"], time: Float[Array, " T"], begin: Array | float, end: Array
) -> Float[Array, "k T n"]:
    """Return states whose derivatives are 0 before the begin and after the end of a motion, but for rounding of times.

    Args:
        states: positions and derivatives at times, held at the ends.
        time: [s].
        begin, end: of the motion [s].
    """
    rounding = 8.0 * jnp.finfo(time.dtype).eps * jnp.maximum(jnp.abs(end), jnp.abs(begin))
    moves = ((time >= begin - rounding) & (time <= end + rounding))[:, None]
    return jnp.where(moves | (jnp.arange(len(states)) == 0)[:, None, None], states, 0.0)


def one_axis(time: Any) -> Any:
    """Return times as they are; raise ValueError unless they are one array or list of numbers."""
    if np.ndim(time) != 1:
        raise OsikValueError(f"time has shape {np.shape(time)}; it is an array of times (T,) [s], as [0.1] for one")
    return time


def sample_times(duration: float, dt: float) -> Float[np.ndarray, " T"]:
    """Return times from 0 that are ``dt`` apart [s], the last of which is the end or just after it.

    Raises:
        TypeError: ``dt`` is no number.
        ValueError: ``dt`` is not positive and finite.
    """
    if not 0.0 < as_array(dt, "dt", float) < np.inf:
        raise OsikValueError(f"dt is {dt!r}; it is the positive time between two samples [s]")
    return np.arange(int(np.ceil(duration / dt - 1e-9)) + 1) * dt


def load_motion(path: str | os.PathLike[str]) -> Motion:
    """Return a motion that ``Motion.save`` wrote; from CSV and Parquet of others, velocities may be missing.

    Missing velocities and accelerations are those of differences.

    Raises:
        OSError: the file cannot be read.
        ValueError: another kind of file, columns that are missing, do not fit or are not finite, or times
            that do not increase.
        ModuleNotFoundError: ``.parquet`` without pyarrow.
    """
    time, arrays, joints = {".npz": _from_npz, ".csv": _from_csv, ".parquet": _from_parquet}[_kind(path)](path)
    every = (np.size(time), *([len(joints)] if joints else np.shape(arrays["position"])[-1:]))
    for kind, values in {"time": time, **arrays}.items():
        shape = every[:1] if kind == "time" else every
        if values.shape != shape or values.dtype.kind not in "fiu" or not np.isfinite(values).all():
            raise OsikValueError(
                f"{os.fspath(path)}: {kind} has shape {values.shape}; expected {shape}, finite numbers"
            )
    if len(time) < 2 or not (np.diff(time) > 0.0).all():
        back = int(np.argmax(np.diff(time) <= 0.0)) + 1 if len(time) > 1 else 0
        raise OsikValueError(f"{os.fspath(path)}: times have to increase, two or more; sample {back} does not")
    for kind, before in zip(_KINDS[1:], _KINDS, strict=False):
        if kind not in arrays:
            arrays[kind] = np.gradient(arrays[before], time, axis=0)
    return Motion(jnp.asarray(time), *(jnp.asarray(arrays[kind]) for kind in _KINDS), joints=tuple(joints))


def _kind(path: str | os.PathLike[str]) -> str:
    kind = Path(path).suffix.lower()
    if kind not in (".npz", ".csv", ".parquet"):
        raise OsikValueError(f"{os.fspath(path)}: a motion's file ends in .npz, .csv or .parquet")
    return kind


def _missing(path: Any, column: str) -> OsikValueError:
    return OsikValueError(f"{os.fspath(path)} has no {column}: it is no motion that Motion.save wrote")


def _from_npz(path: Any) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    with open_npz(path) as file:
        for name in ("time", "position", "joints"):
            if name not in file:
                raise _missing(path, name)
        joints = [str(name) for name in np.atleast_1d(file["joints"])]
        return file["time"], {kind: file[kind] for kind in _KINDS if kind in file}, joints


def _from_csv(path: Any) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    table = read_columns(path, used=lambda name: name == "time" or name.split(".")[0] in _KINDS)
    if "time" not in table:
        raise _missing(path, "column time")
    joints = [name.removeprefix("position.") for name in table if name.startswith("position.")]
    if not joints:
        raise _missing(path, "columns position.JOINT")
    columns = {kind: [table[f"{kind}.{name}"] for name in joints if f"{kind}.{name}" in table] for kind in _KINDS}
    arrays = {kind: np.column_stack(own) for kind, own in columns.items() if len(own) == len(joints)}
    return table["time"], arrays, joints


def _from_parquet(path: Any) -> tuple[np.ndarray, dict[str, np.ndarray], list[str]]:
    parquet = _pyarrow("parquet")
    try:
        table = parquet.read_table(path)
    except ValueError as error:  # pyarrow's ArrowInvalid is one
        raise OsikValueError(f"{os.fspath(path)} cannot be read as a Parquet file: {error}") from error
    for column in (_LEROBOT[0], _LEROBOT[2]):
        if column not in table.column_names:
            raise _missing(path, f"column {column}")
    given = {"position": _LEROBOT[0], "velocity": "velocity", "acceleration": "acceleration"}
    arrays = {k: _rows(table[name].to_numpy()) for k, name in given.items() if name in table.column_names}
    names = (table.schema.metadata or {}).get(b"joints", b"").decode()
    return table[_LEROBOT[2]].to_numpy(), arrays, names.split("\n") if names else []


def _rows(lists: np.ndarray) -> np.ndarray:
    """Return lists of one length as the rows of an array, others as they are."""
    return np.stack(list(lists)) if len({np.shape(one) for one in lists}) == 1 else lists


def _pyarrow(part: str | None = None) -> Any:
    """Return pyarrow, or a module of it."""
    import importlib

    try:
        return importlib.import_module("pyarrow" if part is None else f"pyarrow.{part}")
    except ModuleNotFoundError as error:
        raise missing_extra("a .parquet file", "pyarrow", "motion") from error

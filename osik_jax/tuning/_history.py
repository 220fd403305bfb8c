"""History of a tuning, and its state on disk."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from .._errors import OsikValueError
from .._npz import open_npz
from .._whole_file import whole_file
from ._parameters import ParameterSpace

_FORMAT = 1


@dataclasses.dataclass(frozen=True)
class History:
    """One row for each iteration, of the parameters that it began with; ``tune`` says what the fields are."""

    loss: Float[np.ndarray, " k"]
    held_out: Float[np.ndarray, " k"]
    dropped: Int[np.ndarray, " k"]
    held_out_dropped: Int[np.ndarray, " k"]
    gradient_norm: Float[np.ndarray, " k"]
    seconds: Float[np.ndarray, " k"]
    vectors: Float[np.ndarray, "k p"]

    @classmethod
    def empty(cls, size: int) -> History:
        """Return a history of no iteration, for a number of parameters."""
        none, counts = np.zeros(0), np.zeros(0, int)
        return cls(none, none, counts, counts, none, none, np.zeros((0, size)))

    def __len__(self) -> int:
        """Return the number of iterations."""
        return len(self.loss)

    def and_then(self, **row: Any) -> History:
        """Return the history with one more iteration."""
        return History(**{name: np.append(old, np.asarray(row[name])[None], 0) for name, old in vars(self).items()})

    @property
    def best(self) -> int:
        """Return the iteration with the lowest training loss among those that dropped fewest scenarios.

        A loss over fewer scenarios is no better: it may have lost the hard ones.
        """
        loss = np.where(np.isfinite(self.loss), self.loss, np.inf)
        return int(np.lexsort((loss, self.dropped))[0])


@dataclasses.dataclass(frozen=True)
class State:
    """State to resume a tuning."""

    vector: Any  # parameters of the next iteration, in the space that the optimiser moves in. (p,)
    optimizer: Any  # the optimiser's state
    history: History  # of the iterations so far


def save_state(path: str | os.PathLike[str], state: State, space: ParameterSpace) -> None:
    """Write a state as .npz; it replaces an older file only when it is complete."""
    arrays = {f"history/{name}": value for name, value in vars(state.history).items()}
    arrays |= {f"optimizer/{i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(state.optimizer))}
    arrays |= {"format": np.array(_FORMAT), "vector": np.asarray(state.vector)} | _described(space)
    with whole_file(path) as file:
        np.savez(file, allow_pickle=False, **arrays)


def load_state(path: str | os.PathLike[str], space: ParameterSpace, optimizer: Any) -> State:
    """Return a state that ``save_state`` wrote; ``optimizer`` is the first state of the optimiser."""
    with open_npz(path) as file:
        arrays = dict(file)
    if arrays.get("format") != _FORMAT:
        raise OsikValueError(f"{os.fspath(path)} is no state of a tuning that this version can read")
    for name, now in _described(space).items():
        if not np.array_equal(arrays[name], now):
            what = f"{name.removeprefix('space/')} {arrays[name]}, now {now}"
            raise OsikValueError(f"the parameters are not those saved in {os.fspath(path)}: {what}")
    leaves, structure = jax.tree.flatten(optimizer)
    memory = [arrays[f"optimizer/{i}"] for i in range(sum(name.startswith("optimizer/") for name in arrays))]
    if [leaf.shape for leaf in memory] != [np.shape(leaf) for leaf in leaves]:
        raise OsikValueError(f"{os.fspath(path)} was saved with another optimizer: it has arrays of other shapes")
    memory = [jnp.asarray(new, old.dtype) for new, old in zip(memory, leaves, strict=True)]
    history = History(**{name: arrays[f"history/{name}"] for name in History.__dataclass_fields__})
    return State(jnp.asarray(arrays["vector"]), jax.tree.unflatten(structure, memory), history)


def _described(space: ParameterSpace) -> dict[str, np.ndarray]:
    """Return what a vector of parameters means: their names, and how they are mapped to numbers without bounds."""
    numbers = {f"space/{name}": np.asarray(getattr(space, name)) for name in ("log", "lower", "upper", "scale")}
    return {"space/names": np.array(space.names)} | numbers

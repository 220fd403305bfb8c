"""State of a control loop for other threads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np
from jaxtyping import Float

from ...solvers import Status


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """State after the last step.

    Attributes:
        time: simulated since the start or the last reset [s].
        q: configuration. (nq,), of a batch (B, nq), and so the others
        velocity: what the controller asked for. (nv,)
        status: a ``Status`` code; of a batch, the highest.
        errors: of each task. {name: (m,)}
        failures: steps since the start or the last reset whose answer could not be used: the robot stood still.
        ready: whether a compiled step runs; before that, the robot stands still.
        preparing: whether what was asked for is still being compiled.
        paused: whether the robot stands still because it was asked to.
        problem: why the last change could not be compiled; empty where it could.
    """

    time: float
    q: Float[np.ndarray, "*batch nq"]
    velocity: Float[np.ndarray, "*batch nv"]
    status: int = int(Status.SOLVED)
    errors: Mapping[str, np.ndarray] = dataclasses.field(default_factory=dict)
    failures: int = 0
    ready: bool = False
    preparing: bool = False
    paused: bool = False
    problem: str = ""

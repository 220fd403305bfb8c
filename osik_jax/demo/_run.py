"""Closed loop of a motion with one scheme."""

from __future__ import annotations

import dataclasses
import time

import jax
import numpy as np
from jaxtyping import Float

from .._errors import unknown_name
from ..control import Solution, rollout
from ..schemes import HierarchicalQP, NullSpace, WeightedQP
from ._motion import Motion
from ._observed import Observed, observe

_SCHEMES = {"weighted": WeightedQP, "null-space": NullSpace, "hierarchical": HierarchicalQP}
TITLES = {"weighted": "Weighted QP", "null-space": "Null space", "hierarchical": "Hierarchical QP"}
"""Schemes by their names on the command line, with their titles."""


@dataclasses.dataclass(frozen=True)
class Run:
    """Motion of one scheme."""

    scheme: str  # name of the scheme
    q: Float[np.ndarray, "T nq"]  # configurations, starting with the start
    solution: Solution  # of each step, as NumPy arrays; every leaf has a leading axis. (steps, ...)
    compile_seconds: float  # tracing and compiling the whole loop [s]
    run_seconds: float  # running it once [s]
    seen: Observed  # frames and balance along the motion


def make_scheme(name: str) -> WeightedQP | NullSpace | HierarchicalQP:
    """Return a scheme with its default settings."""
    if name not in _SCHEMES:
        raise unknown_name("scheme", name, tuple(_SCHEMES))
    return _SCHEMES[name]()


def run_scheme(motion: Motion, scheme: str, *, dt: float) -> Run:
    """Compile the closed loop, run it once, and look at the motion."""
    own, steps = make_scheme(scheme), round(motion.duration / dt)
    start = time.perf_counter()
    loop = jax.jit(lambda q0: rollout(motion.robot, q0, motion.tasks, scheme=own, dt=dt, steps=steps))
    program = loop.lower(motion.q0).compile()
    compiled = time.perf_counter()
    trajectory = jax.block_until_ready(program(motion.q0))
    done = time.perf_counter()
    q, solution = np.asarray(trajectory.q), jax.tree.map(np.asarray, trajectory.solution)
    return Run(scheme, q, solution, compiled - start, done - compiled, observe(motion, q, dt))

"""Tuning by gradient descent through rollouts."""

from __future__ import annotations

import dataclasses
import os
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from .._errors import OsikTypeError, OsikValueError, missing_extra
from .._progress import progress_bar
from ..batching._structure import Static, put_together, taken_apart
from ..numerics._arguments import check_count
from ._evaluate import Evaluation, Problem, check_loss, chunk_size
from ._history import History, State, load_state, save_state
from ._loop import Loop, Scenarios
from ._losses import LossFunction
from ._parameters import Parameter, ParameterSpace, overlap

try:
    import optax
except ImportError as missing:
    raise missing_extra("osik_jax.tuning", "optax", "tuning") from missing

LEARNING_RATE = 0.1
"""Learning rate of the default optimiser: weights and gains change by up to 10 % an iteration."""
_default_optimizer = optax.with_extra_args_support(optax.adam(LEARNING_RATE))


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Result of a tuning; ``tune`` says what the fields are."""

    loop: Loop
    parameters: dict[str, float]
    loss: float
    held_out: float
    iteration: int
    history: History
    space: ParameterSpace


def tune(
    loss: LossFunction,
    parameters: Sequence[str | Parameter],
    scenarios: Scenarios,
    *,
    loop: Loop,
    held_out: Scenarios | None = None,
    optimizer: optax.GradientTransformation | None = None,
    iterations: int = 100,
    chunk: int | None = None,
    resume: str | os.PathLike[str] | None = None,
    save: str | os.PathLike[str] | None = None,
    progress: bool = True,
) -> Tuning:
    """Lower the mean loss of a closed loop over scenarios, by the gradient through its rollouts.

    Args:
        loss: a function of a scenario's trajectory and of its loop: ready ones such as ``Tracking("hand")`` and sums of
            them, or your own.
        parameters: names of numbers of the loop, or ``Parameter``s with bounds.
        scenarios: to train on.
        loop: what is tuned, with the numbers to begin at.
        held_out: scenarios whose loss is reported and used for nothing.
        optimizer: any of optax's, or a chain of them; also those that ask for values, as line searches do.
            Default: ``optax.adam(LEARNING_RATE)``.
        iterations: gradients taken, those of a resumed state among them.
        chunk: scenarios that run at a time. Fewer take less memory. Default: 64 on a CPU, all elsewhere.
        resume: goes on from a file that ``save`` wrote; the loss, the scenarios and the numbers that are not tuned may
            be others, the parameters and the optimiser may not.
        save: a .npz file, written after each iteration.
        progress: whether to show a bar with the loss.

    Returns:
        The best loop and the history. The best iteration has the lowest training loss; held-out scenarios do not
        count.

        - ``loop``: with the best parameters; ``loop.tasks``, ``loop.scheme``, ``loop.limits``.
        - ``parameters``: the best ones, by name.
        - ``loss``: the training loss of the best iteration.
        - ``held_out``: the held-out loss of that iteration; NaN if nothing was held out.
        - ``iteration``: which one it was.
        - ``history``: of all k iterations, each at the parameters that it began with: ``loss`` and ``held_out``, means
            over the scenarios kept (k,); ``dropped`` and ``held_out_dropped``, numbers of scenarios not kept (k,);
            ``gradient_norm``, of the mean loss in the space that the optimiser moves in (k,); ``seconds``, the first
            compiles (k,); ``vectors``, the parameters in that space (k, p); ``best``, the iteration.
        - ``space``: maps between parameters and the vector without bounds that the optimiser moves.

        A scenario whose loss or gradient is not finite, or in which a
        step failed on a NaN, is left out of that iteration's mean, and counted in ``history.dropped``.

    Raises:
        KeyError: a name that does not exist; the message lists those that do.
        TypeError: an argument of the wrong kind.
        ValueError: parameters, bounds, scenarios or a saved state that do not fit; no training scenario can be kept.
    """
    check_loss(loss)
    check_count("iterations", iterations, least=0)
    space = ParameterSpace(loop, parameters)
    overlap(space, loop, scenarios.values | (held_out.values if held_out is not None else {}))
    rule = _optimizer(optimizer)
    state = State(space.initial, rule.init(space.initial), History.empty(len(space.names)))
    if resume is not None:
        state = load_state(resume, space, state.optimizer)
    step = _compiled_step(Problem(loss, loop, space), scenarios, held_out, rule, chunk)
    bar = progress_bar(iterations, len(state.history), unit="iterations") if progress else nullcontext(lambda *_: None)
    with bar as show:
        while len(state.history) < iterations:
            state = step(state)
            if save is not None:
                save_state(save, state, space)
            show(len(state.history), _described(state.history))
    return _result(loop, space, state.history)


def _optimizer(given: Any) -> optax.GradientTransformationExtraArgs:
    if given is None:
        return _default_optimizer
    if not (callable(getattr(given, "init", None)) and callable(getattr(given, "update", None))):
        raise OsikTypeError(f"optimizer is {given!r}; it is an optax.GradientTransformation, such as optax.adam(0.1)")
    return optax.with_extra_args_support(given)


def _compiled_step(
    problem: Problem,
    scenarios: Scenarios,
    held_out: Scenarios | None,
    optimizer: optax.GradientTransformationExtraArgs,
    chunk: int | None,
) -> Callable[[State], State]:
    """Return one iteration, on the host."""
    numbers, static = taken_apart(problem)
    batches = [each.fitted(problem.loop) for each in (scenarios, held_out) if each is not None]
    chunks = tuple(chunk_size(chunk, len(each)) for each in batches)

    def step(state: State) -> State:
        start = time.perf_counter()
        options: Any = dict(static=static, chunks=chunks, optimizer=optimizer)
        vector, memory, row = _step(numbers, state.vector, state.optimizer, batches, **options)
        row = {name: np.asarray(value) for name, value in row.items()}
        if row["dropped"] == len(scenarios):
            raise OsikValueError(
                f"no training scenario can be kept in iteration {len(state.history)}: each has a loss or gradient "
                "that is not finite, or a step that failed on a NaN; look at it with osik_jax.tuning.evaluate"
            )
        seconds = time.perf_counter() - start
        history = state.history.and_then(**row, vectors=np.asarray(state.vector), seconds=seconds)
        return State(vector, memory, history)

    return step


@partial(jax.jit, static_argnames=("static", "chunks", "optimizer"))
def _step(
    numbers: Any,
    vector: Float[Array, " p"],
    memory: Any,
    batches: list[Scenarios],
    *,
    static: Static,
    chunks: tuple[int, ...],
    optimizer: optax.GradientTransformationExtraArgs,
) -> tuple[Array, Any, dict[str, Array]]:
    """Return the next vector, the next optimiser state, and the history row of this step."""
    problem: Problem = put_together(numbers, static)
    trained, gradient = problem.gradient(vector, batches[0], chunks[0])
    held = Evaluation(jnp.zeros(0), jnp.zeros(0, bool))
    if len(batches) > 1:
        held = problem.value(vector, batches[1], chunks[1])

    def objective(other: Float[Array, " p"]) -> Float[Array, ""]:
        tried = problem.value(other, batches[0], chunks[0])
        worse = (trained.kept & ~tried.kept).any()
        mean = jnp.sum(jnp.where(trained.kept, tried.losses, 0.0)) / jnp.maximum(jnp.sum(trained.kept), 1)
        return jnp.where(worse, jnp.inf, mean)

    updates, memory = optimizer.update(gradient, memory, vector, value=trained.loss, grad=gradient, value_fn=objective)
    row = {
        "loss": trained.loss,
        "held_out": held.loss,
        "dropped": trained.dropped,
        "held_out_dropped": held.dropped,
        "gradient_norm": jnp.linalg.norm(gradient),
    }
    return vector + updates, memory, row


def _result(loop: Loop, space: ParameterSpace, history: History) -> Tuning:
    if not len(history):
        raise OsikValueError("iterations is 0: there is nothing to report")
    best = history.best
    vector = jnp.asarray(history.vectors[best])
    return Tuning(
        loop=space.apply(loop, vector),
        parameters=space.by_name(vector),
        loss=float(history.loss[best]),
        held_out=float(history.held_out[best]),
        iteration=best,
        history=history,
        space=space,
    )


def _described(history: History) -> str:
    """Return the last iteration in a line."""
    parts = [f"loss {history.loss[-1]:.3e}", f"best {history.loss[history.best]:.3e}"]
    if np.isfinite(history.held_out[-1]):
        parts.append(f"held out {history.held_out[-1]:.3e}")
    lost = int(history.dropped[-1] + history.held_out_dropped[-1])
    return ", ".join(parts + ([f"{lost} dropped"] if lost else []))

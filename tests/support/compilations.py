"""Counting what JAX compiles."""

import logging
from typing import Any, Self

import jax

ONE_OPERATION = ("jit(convert_element_type)", "jit(broadcast_in_dim)", "jit(stage)")
"""What JAX itself runs on single arrays outside jit: a weakly typed dt gets the type of q, a NumPy array is staged."""


class Compilations(logging.Handler):
    """The names of the programs that JAX says it compiles, while this is entered."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        message = record.getMessage()
        if message.startswith("Compiling") and message.split()[1] not in ONE_OPERATION:
            self.names.append(message.split()[1])

    def __enter__(self) -> Self:
        self.context = jax.log_compiles()
        self.context.__enter__()
        logging.getLogger("jax").addHandler(self)
        return self

    def __exit__(self, *error: Any) -> None:
        logging.getLogger("jax").removeHandler(self)
        self.context.__exit__(*error)

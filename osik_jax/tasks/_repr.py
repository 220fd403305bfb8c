"""Tasks in one line."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.core
import numpy as np


def short_repr(task: Any) -> str:
    """The names and options of a task, its weight and its gain; arrays are left out.

    ``FrameTask(frame='l_gripper', axes='world', priority=3, weight=2.0, gain=10.0)``
    """
    parts = [f"{name}={shown}" for name, shown in _options(task)]
    parts += [f"{name}={_number(getattr(task, name))}" for name in ("weight", "gain")]
    return f"{type(task).__name__}({', '.join(parts)})"


def _options(task: Any) -> list[tuple[str, str]]:
    """Static fields that say something in a few words."""
    found = []
    for field in dataclasses.fields(task):
        value = getattr(task, field.name)
        if not field.metadata.get("static") or value is None or value is False:
            continue
        if field.name == "joints":
            found.append(("joints", f"<{len(value)}>"))
        elif isinstance(value, (str, bool, int)) or _is_short(value):
            found.append((field.name, repr(value)))
    return found


def _is_short(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) <= 6 and all(isinstance(part, (str, bool)) for part in value)


def _number(value: Any) -> str:
    """A number in full, an array by its shape."""
    if isinstance(value, eqx.Module):
        numbers = (_number(getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{type(value).__name__}({', '.join(numbers)})"
    if isinstance(value, jax.core.Tracer) or np.ndim(value) > 0:
        return f"<{'x'.join(map(str, np.shape(value)))}>" if np.shape(value) else "<traced>"
    return f"{float(value):g}"

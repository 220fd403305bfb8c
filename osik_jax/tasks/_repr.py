"""One-line representation of tasks."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx
import jax.core
import numpy as np


def short_repr(task: Any) -> str:
    """Return names, options, weight and gain of a task in one line, without arrays.

    ``FrameTask(frame='l_gripper', rows='position', axes='world', weight=2, gain=10, priority=3)``
    """
    options = _options(task)
    last = [options.pop(name) for name in ("priority", "hard") if name in options]
    parts = [*options.values(), *(f"{name}={_number(getattr(task, name))}" for name in ("weight", "gain")), *last]
    return f"{type(task).__name__}({', '.join(parts)})"


ROWS = {"pose": (True,) * 6, "position": (True,) * 3 + (False,) * 3, "orientation": (False,) * 3 + (True,) * 3}
"""Masks of a pose's rows that have a name."""
ROW_NAMES = {mask: name for name, mask in ROWS.items()}
_SILENT = ("row_count", "orientation_jacobian", "made_for")
"""Fields that are left out, because they follow from others or rarely change."""


def _options(task: Any) -> dict[str, str]:
    """Return the static fields with a short value, by name."""
    found = {}
    for field in dataclasses.fields(task):
        value, name = getattr(task, field.name), field.name
        if not field.metadata.get("static") or name in _SILENT or value is None or value is False:
            continue
        if name in ("joints", "dofs"):
            found[name] = f"{name}=<{len(value)}>"
        elif name == "kept":
            found[name] = f"rows={ROW_NAMES.get(value, value)!r}"
        elif isinstance(value, (str, bool, int)) or _is_short(value):
            found[name] = f"{name}={value!r}"
    return found


def _is_short(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) <= 6 and all(isinstance(part, (str, bool)) for part in value)


def _number(value: Any) -> str:
    """Return a number in full, an array by its shape."""
    if isinstance(value, eqx.Module):
        numbers = (_number(getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{type(value).__name__}({', '.join(numbers)})"
    if isinstance(value, jax.core.Tracer) or np.ndim(value) > 0:
        return f"<{'x'.join(map(str, np.shape(value)))}>" if np.shape(value) else "<traced>"
    return f"{float(value):g}"

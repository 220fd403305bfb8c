"""Reader of controllers in the format "osik-jax controller 2", in which an object has all its fields."""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import Any

import osik_jax

from .._errors import OsikValueError

_DERIVED = {"made_for", "gain", "row_count", "dt"}
"""Fields that a constructor makes, of classes whose constructor has no such argument."""


def converted(data: Any) -> Any:
    """Return data as ``decode`` takes it."""
    if isinstance(data, list):
        return [converted(one) for one in data]
    if not isinstance(data, Mapping):
        return data
    for wrapped in ("array", "items", "of"):
        if wrapped in data and "class" not in data:
            return converted(data[wrapped])
    kind = data["class"].rpartition(".")[2]
    if kind == "NoLimits":
        return {"kind": "no_limits"}
    fields = {"rows" if name == "kept" else name: one for name, one in data["fields"].items()}
    joints = converted(fields.pop("joints")) if kind == "JointCouplingTask" else ()
    arguments = inspect.signature(getattr(osik_jax, kind)).parameters if hasattr(osik_jax, kind) else {}
    if lost := fields.keys() - arguments.keys() - _DERIVED:
        raise OsikValueError(
            f"its {kind} was saved by an older version with {', '.join(sorted(lost))}, which this version does not "
            "read: make the controller again and save it"
        )
    made = {name: converted(one) for name, one in fields.items() if name in arguments}
    if joints:
        made["ratios"] = dict(zip(joints, made["ratios"], strict=True))
    return {"kind": kind} | made

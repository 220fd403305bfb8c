"""Tasks, limits and schemes as Python expressions, for a program with ``import osik_jax as osik`` and a ``robot``."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

import osik_jax

from ..._errors import OsikValueError
from ...robot import Robot
from ...saving._parts import Data, encode, makes, takes_robot
from ._covers import SUFFIX

_COLLISIONS = "CollisionAvoidanceLimit"


def python(part: Any, robot: Robot, where: str = "it") -> str:
    """Return the expression that makes an object, without arguments that have their defaults."""
    data = encode(part, robot, where)
    short = _shortened(data) if data["kind"] == _COLLISIONS else data
    data = short if makes(short, robot, part) else data
    for name in [*data][1:]:
        without = {key: value for key, value in data.items() if key != name}
        data = without if makes(without, robot, part) else data
    return _made(data)


def _shortened(data: Data) -> Data:
    """Return the data of a collision limit with globs for the shapes of links, and the pairs left out of these."""

    def glob(name: str) -> str:
        return f"*{SUFFIX}" if name.endswith(SUFFIX) else name

    pairs = data["pairs"]
    patterns = [list(pair) for pair in sorted({(glob(a), glob(b)) for a, b in pairs})]
    covers = list(dict.fromkeys(name for pair in pairs for name in pair if name.endswith(SUFFIX)))
    kept = {frozenset(pair) for pair in pairs}
    left_out: list[list[str]] = []
    if [f"*{SUFFIX}"] * 2 in patterns:
        left_out = [[a, b] for k, a in enumerate(covers) for b in covers[:k] if frozenset((a, b)) not in kept]
    return data | {"pairs": patterns, "exclude": left_out}


def _made(data: Mapping[str, Any]) -> str:
    """Return the call of the constructor of an object's data."""
    kind = data["kind"]
    if kind == "no_limits":
        return "osik.no_limits"
    if kind == "SupportPolygon":
        return f"osik.{kind}({', '.join(f'{n}=np.array({_text(v)})' for n, v in data.items() if n != 'kind')})"
    texts = {name: _text(value) for name, value in data.items() if name not in ("kind", "left_out")}
    if kind == _COLLISIONS:
        texts = {"q0_distance": "-np.inf"} | texts
        texts |= {name: repr([tuple(pair) for pair in data[name]]) for name in ("pairs", "exclude") if name in data}
        shapes = ", ".join(f"{name!r}: {_shape(name, one)}" for name, one in data.get("shapes", {}).items())
        texts |= {"shapes": f"{{{shapes}}}"}
    first = ["robot"] if takes_robot(getattr(osik_jax, kind)) else []
    return f"osik.{kind}({', '.join([*first, *(f'{name}={text}' for name, text in texts.items())])})"


def _shape(name: str, data: Mapping[str, Any]) -> str:
    """Return the expression that makes a shape, with its numbers rounded."""
    position, turn, size = (np.asarray(data[k]) for k in ("position", "rotation", "size"))
    kind, frame = data["shape"], f"frame={data['frame']!r}"
    if kind == "hull":
        raise OsikValueError(f"no program can make the shape {name!r}: it is a hull, whose points are not kept")
    if kind == "box":
        return f"osik.CollisionShape.box({size.tolist()}, {position.tolist()}, np.array({turn.tolist()}), {frame})"
    if kind == "half-space":
        return f"osik.CollisionShape.half_space({position.tolist()}, {turn[:, 2].tolist()}, {frame})"
    if kind == "capsule" and size[1] == 0.0:
        return f"osik.CollisionShape.sphere({float(size[0])!r}, {position.tolist()}, {frame})"
    ends = [(position + sign * (turn[:, 2] * size[1])).tolist() for sign in (-1.0, 1.0)]
    return f"osik.CollisionShape.{kind}({float(size[0])!r}, {ends[0]}, {ends[1]}, {frame})"


def _text(value: Any) -> str:
    """Return plain data as Python source."""
    if isinstance(value, Mapping):
        own = ", ".join(f"{key!r}: {_text(one)}" for key, one in value.items())
        return _made(value) if "kind" in value else f"{{{own}}}"
    if isinstance(value, list):
        return f"[{', '.join(map(_text, value))}]"
    if isinstance(value, float) and not np.isfinite(value):
        return "np.nan" if np.isnan(value) else f"{'-' if value < 0.0 else ''}np.inf"
    return repr(value)

"""Recognition of feet among frames, which decides whether a robot stands freely if nobody says so."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_FEET = (r"sole(?!.*corner)", r"foot", r"ankle", r"toe")


def find_feet(frames: Iterable[tuple[str, int]], parents: Sequence[int]) -> tuple[str, ...]:
    """Return one frame of each of two or more outermost bodies that are called like feet; none if there are fewer.

    Args:
        frames: names, and the body that each is fixed to.
        parents: of each body; body 0 is its own.
    """
    outermost = set(range(1, len(parents))) - set(parents)
    candidates = [(name, body) for name, body in frames if body in outermost]
    for pattern in _FEET:
        found: dict[int, str] = {}
        for name, body in candidates:
            if re.search(pattern, name, re.IGNORECASE):
                found.setdefault(body, name)
        if len(found) > 1:
            return tuple(found.values())
    return ()

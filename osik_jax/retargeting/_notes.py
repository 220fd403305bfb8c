"""What a report has to say in words: bounds that gave way, and feet that hardly stand."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_BOUNDS = {
    ("feet", "slip_mm_max"): (1.0, "feet that stand slip by {:.1f} mm"),
    ("feet", "float_mm_max"): (2.0, "feet that stand are {:.1f} mm above the floor"),
    ("feet", "below_floor_mm_max"): (2.0, "soles are {:.1f} mm below the floor"),
    ("shapes", "penetration_mm_max"): (1.0, "shapes overlap by {:.1f} mm"),
    ("joints", "beyond_range_max"): (1e-6, "a joint is {:.2g} rad or m beyond its range"),
    ("joints", "speed_over_limit_max"): (1.0 + 1e-6, "a joint has {:.3g} times its greatest speed"),
}
"""Figures of a report, what they are at most where the bounds hold, and what to say where they are more."""
_LEAST_STANDING = 0.2


def notes(figures: Mapping[str, Any], balance: float | None = None) -> list[str]:
    """Return sentences on what of a report has to be known before its motion is used; none where all is well.

    Args:
        figures: of ``report``.
        balance: how far inside the edge of the feet the centre of mass was asked for [m]; None: it was not.
    """
    found = [(figures[group][name], most, text) for (group, name), (most, text) in _BOUNDS.items()]
    out = [
        f"a bound gave way: {text.format(value)}" for value, most, text in found if value is not None and value > most
    ]
    margin = figures["balance"]["com_margin_mm_min"]
    if balance is not None and margin is not None and margin < 0.0:
        out.append(f"a bound gave way: the centre of mass is {-margin:.1f} mm outside the feet")
    share = figures["feet"]["contact_share"]
    if share < _LEAST_STANDING:
        out.append(
            f"feet stand in {100.0 * share:.0f} % of the frames, and nothing holds them elsewhere; where the person "
            "walks or stands, check the unit, the up axis and the contact labels of the clip"
        )
    return out

"""Notes of a report: violated bounds, clips too fast for the joints, trunks that lean, and clips with few contacts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_BOUNDS = {
    ("feet", "slip_mm_max"): (1.0, "feet that stand slip by {:.1f} mm"),
    ("feet", "float_mm_max"): (2.0, "feet that stand are {:.1f} mm above the floor"),
    ("feet", "below_floor_mm_max"): (2.0, "soles are {:.1f} mm below the floor"),
    ("shapes", "penetration_mm_max"): (1.0, "shapes overlap by {:.1f} mm"),
    ("touches", "off_mm_max"): (5.0, "hands are {:.1f} mm off what they hold"),
    ("joints", "beyond_range_max"): (1e-6, "a joint is {:.2g} rad or m beyond its range"),
    ("joints", "speed_over_limit_max"): (1.0 + 1e-6, "a joint has {:.3g} times its greatest speed"),
}
"""Figures of a report, the largest value where bounds hold, and the note for a larger value."""
_LEAST_STANDING = 0.2
_OFTEN, _OFF = 0.5, 4.0
"""Share of frames with a joint at its speed limit, and mean angle between segments [deg], above both of which a clip is
too fast.
"""
_LEANS, _RESTS, _MOST_JOINTS = 10.0, 0.5, 4
"""Angle between the trunks of person and robot [deg], and share of frames with a joint at an end of its range, above
which each is told; and largest number of joints that a note names.
"""


def notes(figures: Mapping[str, Any], balance: float | None = None) -> list[str]:
    """Return notes that a user must read before using a motion; empty if there are none.

    ``balance`` is the requested margin of the centre of mass inside the support polygon [m].
    """
    limited, angle = figures["joints"]["at_speed_limit_share"], figures["tracking"]["segment_angle_deg_mean"]
    out = []
    if limited > _OFTEN and angle > _OFF:
        out.append(
            f"segments are {angle:.1f} deg off, and in {100.0 * limited:.0f} % of the frames a joint is at its largest "
            "speed: slow down the clip, or check the speed limits in the robot's file"
        )
    out += _posture(figures)
    found = [(figures[group][name], most, text) for (group, name), (most, text) in _BOUNDS.items()]
    out += [
        f"a bound gave way: {text.format(value)}" for value, most, text in found if value is not None and value > most
    ]
    margin = figures["balance"]["com_margin_mm_min"]
    if balance is not None and margin is not None and margin < 0.0:
        out.append(f"a bound gave way: the centre of mass is {-margin:.1f} mm outside the feet")
    share = figures["feet"]["contact_share"]
    if share is not None and share < _LEAST_STANDING:
        out.append(
            f"feet stand in {100.0 * share:.0f} % of the frames, and nothing holds them elsewhere; where the person "
            "walks or stands, check the unit, the up axis and the contact labels of the clip"
        )
    return out


def _posture(figures: Mapping[str, Any]) -> list[str]:
    """Return notes on a trunk that leans, and on joints that rest at an end."""
    out, leans = [], figures["tracking"]["trunk_angle_deg"]["hips-shoulders"]
    if leans is not None and leans > _LEANS:
        out.append(
            f"the trunk leans {leans:.0f} deg away from the person's: check which joint of the clip is the chest, and "
            "the range of the waist"
        )
    share: Mapping[str, float] = figures["joints"]["at_end_share"]
    rests = sorted((name for name in share if share[name] > _RESTS), key=lambda name: -share[name])
    if rests:
        named = ", ".join(f"{name} ({100.0 * share[name]:.0f} % of the frames)" for name in rests[:_MOST_JOINTS])
        more = f" and {len(rests) - _MOST_JOINTS} more" if len(rests) > _MOST_JOINTS else ""
        out.append(f"joints rest at an end of their range: {named}{more}")
    return out

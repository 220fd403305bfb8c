"""Offline page of a retargeted motion: person and robot side by side, and a panel with contacts, limits and notes."""

from __future__ import annotations

import html
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from ._contact import stretches
from ._report import AT_SPEED, FIGURES, at_ends, joint_tracks, picked
from ._retargeted import Retargeted

_OFF, _MOST_JOINTS = 1e-3, 8
"""Distance from the plan that counts [rad or m], and number of joints that the panel lists."""
# On a narrow screen the scene keeps the ratio of 3:2 that its camera is placed for; its controls take 36 px.
_STYLE = """<style>
#root{position:fixed;left:0;top:0;bottom:0;width:calc(100% - 340px)}
#osik{position:fixed;right:0;top:0;bottom:0;width:340px;box-sizing:border-box;padding:14px 16px;overflow:auto;
font:13px/1.4 system-ui,sans-serif;color:#1f2933;background:#fff;border-left:1px solid #d9dfe7}
#osik h1{font-size:16px;margin:0 0 2px}#osik h2{font-size:13px;margin:14px 0 4px}#osik p,#osik ul{margin:2px 0}
#osik ul{padding-left:18px}#osik table{border-collapse:collapse;width:100%}#osik td{padding:1px 0}
#osik td+td{text-align:right;font-variant-numeric:tabular-nums}#osik .gave{color:#b3261e}
#osik svg{display:block;width:100%;height:12px;background:#eef1f5;margin-bottom:4px}
@media (max-width:800px){#root{width:100%;height:min(67vw + 36px,60%)}
#osik{width:100%;top:min(67vw + 36px,60%);border-left:0;border-top:1px solid #d9dfe7}}
#osik .lines{position:relative}#osik .now{position:absolute;top:0;bottom:0;width:1px;background:#1c6fb8}
</style>"""
_SCRIPT = """<script>
setInterval(()=>{const s=document.querySelector('#root [role=slider]');if(!s)return;
const now=Number(s.getAttribute('aria-valuenow'))/Math.max(Number(s.getAttribute('aria-valuemax')),1e-9);
document.querySelectorAll('#osik .now').forEach(e=>e.style.left=100*now+'%')},50)
</script>"""


def write_report(result: Retargeted, figures: Mapping[str, Any], motion: Path, out: Path) -> None:
    """Write one HTML file that shows a retargeted motion, saved to ``motion.npz`` before, without server or network."""
    from ..viewer.live._export import write_page
    from ..viewer.live._playback import read_motion

    panel = _STYLE + _panel(result, figures) + _SCRIPT
    title = str(figures.get("clip", motion.stem))
    write_page(result.robot, read_motion(motion, result.robot), out, title=title, beside=panel)


def _panel(result: Retargeted, figures: Mapping[str, Any]) -> str:
    """Return the panel: notes, contacts and limits over time, joints at their ends, and figures."""
    frames, fps = figures["frames"], figures["fps"]
    parts = [f"<aside id=osik><h1>{_text(figures.get('clip', ''))}</h1><p>{frames} frames, {fps:g} a second</p>"]
    notes = figures["notes"]
    parts.append("<h2>What gave way</h2>")
    items = "".join(f"<li>{_text(note)}" for note in notes)
    parts.append(f"<ul class=gave>{items}</ul>" if notes else "<p>nothing</p>")
    names = result.profile.standing
    parts.append("<h2>Contact</h2>")
    rows = {name.replace("_", " "): result.contact[:, k] for k, name in enumerate(names)}
    parts.append(_lines(rows, "#2a9d62") if names else "<p>the robot has no feet</p>")
    q, _, _, fastest = joint_tracks(result)
    speed = np.abs(np.diff(q, axis=0, prepend=q[:1])) * fps
    parts.append("<h2>Limits</h2>")
    strips = {
        "a joint at an end of its range": at_ends(result).any(1),
        "a joint at its speed limit": (speed > AT_SPEED * fastest).any(1),
        "limits keep it from the plan": np.asarray(result.off_plan > _OFF),
    }
    parts.append(_lines(strips, "#d97b1f"))
    share: Mapping[str, float] = figures["joints"]["at_end_share"]
    longest = sorted(share, key=lambda name: -share[name])[:_MOST_JOINTS]
    parts.append("<h2>Joints at an end of their range</h2>")
    parts.append(_table({name: f"{100.0 * share[name]:.0f} %" for name in longest}) if share else "<p>none</p>")
    parts.append("<h2>Figures</h2>")
    parts.append(_table(_largest(figures)))
    return "".join(parts) + "</aside>"


def _largest(figures: Mapping[str, Any]) -> dict[str, str]:
    """Return the figures of a report by what a page calls them."""
    values = {FIGURES[name][0]: _number(value) for name, value in picked(figures).items()}
    return {**values, "frames with a jump": _number(figures["joints"]["jump_frames"])}


def _lines(rows: Mapping[str, Any], color: str) -> str:
    """Return HTML with a strip for each row of flags (F,), coloured in frames where the flag is true.

    One mark across all strips shows the present time.
    """
    out = []
    for name, flags in rows.items():
        bars = "".join(f'<rect x="{a}" width="{b - a}" height="1" fill="{color}"/>' for a, b in stretches(flags))
        out.append(
            f'<p>{_text(name)}</p><svg viewBox="0 0 {len(flags)} 1" preserveAspectRatio="none" role=img '
            f'aria-label="{_text(name)}">{bars}</svg>'
        )
    return f"<div class=lines>{''.join(out)}<div class=now></div></div>"


def _table(rows: Mapping[str, str]) -> str:
    return "<table>" + "".join(f"<tr><td>{_text(a)}<td>{_text(b)}" for a, b in rows.items()) + "</table>"


def _number(value: float | None) -> str:
    """Return a number with two decimals, whole ones without."""
    return "-" if value is None else f"{value:.2f}".removesuffix(".00")


def _text(text: object) -> str:
    return html.escape("-" if text is None else str(text))

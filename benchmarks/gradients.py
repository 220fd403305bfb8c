"""What gradients cost, by ``benchmarks.rollouts`` in a process of its own for each row."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from .processes import ROOT
from .race import Race

LENGTHS = {"step": 1, "rollout": 100}
"""Steps of each."""
ROBOTS = 64


def rows(race: Race, schemes: Sequence[str], precisions: Sequence[str], *, quick: bool) -> Iterator[dict[str, Any]]:
    """A row for each scheme, precision and length: seconds of the value alone, and with its gradient.

    Args:
        race: whose robot it is; told what happens.
        schemes, precisions: which.
        quick: a tenth of the steps in a rollout.
    """
    for scheme in schemes:
        for precision in precisions:
            for name, steps in LENGTHS.items():
                steps = max(steps // 10, 1) if quick else steps
                race.report(f"gradient of a {name}, {scheme}, {precision}")
                label = dict(what=name, scheme=scheme, precision=precision, robots=ROBOTS, steps=steps)
                yield label | _measured(race.work.robot, label)


def _measured(robot: str, asked: dict[str, Any]) -> dict[str, Any]:
    options = {key: asked[key] for key in ("scheme", "precision", "robots", "steps")}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "rollouts.json"
        words = [str(word) for key, value in options.items() for word in (f"--{key}", value)]
        command = [sys.executable, "-m", "benchmarks.rollouts", str(path), "--robot", robot, *words]
        subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE)
        found = json.loads(path.read_text(encoding="utf-8"))
    forward, gradient = found["rows"]
    return dict(
        forward_seconds=forward["seconds"],
        gradient_seconds=gradient["seconds"],
        compile_seconds=gradient["compile_seconds"],
        finite=gradient["finite"],
        peak_bytes=found["peak_bytes"],
        device_peak_bytes=found["device_peak_bytes"],
    )

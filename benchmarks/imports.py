"""Time of ``import osik_jax`` beside what it cannot do without.

    python -m benchmarks.imports [--runs 20]

New processes in turns, with their bytecode cached, as pip leaves it; CPU seconds count, for other programs disturb them
less than they disturb the clock.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys

import numpy as np

STATEMENTS = ("import jax, mujoco", "import jax, mujoco, equinox, jaxlie", "import osik_jax")


def seconds(statement: str) -> float:
    """CPU time of a process that runs a statement."""
    before = os.times()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    subprocess.run([sys.executable, "-c", statement], check=True, stdout=subprocess.DEVNULL, env=environment)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def main() -> None:
    """Prints medians, and their ratios to the first."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.imports", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--runs", type=int, default=20)
    given = parser.parse_args()
    for statement in STATEMENTS:
        seconds(statement)  # writes what bytecode is missing
    found = np.array([[seconds(statement) for statement in STATEMENTS] for _ in range(given.runs)])
    medians = np.median(found, 0)
    for statement, median in zip(STATEMENTS, medians, strict=True):
        print(f"{median:6.2f} s  {median / medians[0]:5.2f}  {statement}")


if __name__ == "__main__":
    main()

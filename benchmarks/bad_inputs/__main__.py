"""Wrong inputs and the outcome of each: docs/dev/bad_inputs.csv.

    python -m benchmarks.bad_inputs [--write]

It runs every case. docs/dev/bad_inputs.md states the rules that the outcomes follow.
"""

from __future__ import annotations

import argparse

import jax

from benchmarks.data_file import write_csv
from osik_jax.runtime import configure_cpu

from ._table import HEAD, TABLE, cases, outcome, table


def main() -> None:
    """Run all cases; print the table, or write it."""
    parser = argparse.ArgumentParser(description="Wrong inputs and the outcome of each.")
    parser.add_argument("--write", action="store_true", help=f"write {TABLE.name}")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = table({case.given: outcome(case) for case in cases()})
    if arguments.write:
        write_csv(TABLE, HEAD, rows)
    else:
        for row in rows:
            print(" | ".join(row))


if __name__ == "__main__":
    configure_cpu()
    main()

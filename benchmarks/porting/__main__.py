"""The numbers on the page on porting: the same problem in pink or mink and here, and what makes the answers differ.

    python -m benchmarks.porting step          # one step of a G1 beside pink
    python -m benchmarks.porting squat         # pink's example humanoid_g1_com, from straight and from bent knees
    python -m benchmarks.porting mobile        # mink's example mobile_tidybot with its base held, target near and far

The models are the G1 of example-robot-data and a 7-joint arm on a planar base, written in ``mobile``. Costs, gains and
targets are those of the examples.
"""

from __future__ import annotations

import argparse
import logging

import jax

from osik_jax.runtime import configure_cpu

from . import mobile, squat, step

PARTS = {"step": step.report, "squat": squat.report, "mobile": mobile.report}


def main() -> None:
    """Prints the parts that are asked for."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.porting", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("part", choices=PARTS)
    jax.config.update("jax_enable_x64", True)
    logging.disable(logging.WARNING)  # pink and mink tell of every joint at a limit
    for line in PARTS[parser.parse_args().part]():
        print(line, flush=True)


if __name__ == "__main__":
    configure_cpu()
    main()

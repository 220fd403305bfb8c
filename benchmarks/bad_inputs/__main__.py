"""Wrong inputs and what each gets: the table in docs/dev/bad_inputs.md.

    python -m benchmarks.bad_inputs [--write]

Every case is run. What can be known outside a program raises an exception of ours that names what is wrong and what
there is instead; what is seen only while a program runs ends in a status, with finite numbers. Inputs that look wrong
and are not, or that nobody can tell from right ones, are in a table of their own.
"""

from __future__ import annotations

import argparse

import jax

from osik_jax.runtime import configure_cpu

from ._page import PAGE, cases, outcome, page


def main() -> None:
    """Runs all cases; prints the page, or writes it."""
    parser = argparse.ArgumentParser(description="Wrong inputs and what each gets.")
    parser.add_argument("--write", action="store_true", help=f"write {PAGE.name}")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    text = page({case.given: outcome(case) for case in cases()})
    if arguments.write:
        PAGE.parent.mkdir(exist_ok=True)
        PAGE.write_text(text, encoding="utf-8")
    else:
        print(text)


if __name__ == "__main__":
    configure_cpu()
    main()

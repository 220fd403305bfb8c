"""How many numbers the space of a kernel has: XLA is asked for as many, and the kernel divides them up.

Plain Python, so that who calls a kernel needs no Numba to know; kernels compile what they need of it.
"""

WIDTH = 8
"""Numbers of a block; vectors, rows and columns that are read in blocks are filled up to whole ones."""


def row_space_numbers(n, m):
    """Return the numbers of ``Work`` in ``_row_space_workspace.py``.

    Args:
        n: variables.
        m: rows of the longest level.
    """
    side = (max(n, m) + WIDTH - 1) // WIDTH * WIDTH + WIDTH
    return 15 * side * side + 17 * side


def saturation_numbers(n):
    """Return the numbers of ``Search`` in ``_saturation_search.py``, and a block that is read behind them."""
    return n * (2 * n + 10) + WIDTH

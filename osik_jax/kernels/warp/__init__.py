"""CUDA texts of the solvers, a folder for each: the body of one function, cut into functions that can be tested alone.

Warp compiles the body of a native function, and C++ has no functions inside of functions: each is a lambda that refers
to the variables before it. The files of a folder are put together in the order that its solver names, and numbers of
the problem's shape stand before them as constants. ``tests/emulated_warp.py`` runs all of them, or as many as lead to
the function that is tested, on a CPU.
"""

from importlib.resources import files


def text(folder: str, parts: tuple[str, ...]) -> str:
    """Return the files of a folder as one text.

    Args:
        folder: "qp" or "hqp".
        parts: names of the files, without their ending, in their order.
    """
    return "\n".join(files(__name__).joinpath(folder, f"{part}.cu").read_text() for part in parts)

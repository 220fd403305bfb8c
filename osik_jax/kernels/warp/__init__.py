"""CUDA texts of the solvers, a folder for each: the body of one function, cut into functions that can be tested alone.

Warp compiles the body of a native function, and C++ has no functions inside of functions: each is a lambda that refers
to the variables before it. The files of a folder are put together in the order that its solver names, and numbers of
the problem's shape stand before them as constants. ``tests/emulated_warp.py`` runs all of them, or as many as lead to
the function that is tested, on a CPU.
"""

import re
from importlib.resources import files


def text(folder: str, parts: tuple[str, ...]) -> str:
    """Return the files of a folder as one text.

    Args:
        folder: "qp", "hqp" or "null_space".
        parts: names of the files, without their ending, in their order; "hqp/reductions" is one of another folder.
    """
    paths = (f"{part if '/' in part else f'{folder}/{part}'}.cu".split("/") for part in parts)
    return "\n".join(files(__name__).joinpath(*path).read_text() for path in paths)


def rolled(text: str) -> str:
    """Return CUDA text whose loops stay loops, except for those that ask to be unrolled.

    With all loops unrolled the kernel is several times as long as the instruction caches, which then decide its speed.
    """
    lines = text.splitlines(keepends=True)
    is_plain_loop = [
        re.match(r"\s*(for|while) \(", line) and not before.startswith("#pragma")
        for before, line in zip(["", *lines], lines, strict=False)
    ]
    return "".join(
        "#pragma unroll 1\n" + line if plain else line for line, plain in zip(lines, is_plain_loop, strict=True)
    )

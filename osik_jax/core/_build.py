"""Build of the C++ core, run by the installation (``hatch_build.py``) and by ``python -m osik_jax.core._build``.

Only the standard library is imported, because nothing else is available during an installation.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
_FLAGS = ["-std=c++20", "-O3", "-pthread", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math", "-Wno-psabi"]
_V3 = ["-mavx", "-mavx2", "-mfma", "-mbmi", "-mbmi2", "-mf16c", "-mlzcnt", "-mmovbe"]  # x86-64-v3
_IS_X86 = platform.machine() in ("x86_64", "AMD64")


def levels() -> dict[str, list[str]]:
    """Return the instruction sets of this platform with their compiler flags, the most capable one first."""
    return {"x86_64_v3": _V3, "x86_64": []} if _IS_X86 else {platform.machine() or "unknown": []}


def library_path(level: str) -> Path:
    """Return the path of the library for an instruction set."""
    return FOLDER / f"_core_{level}.so"


def sources() -> list[Path]:
    """Return the C++ files of the library."""
    return sorted([*FOLDER.glob("*.hpp"), *FOLDER.glob("tasks/*.hpp"), *FOLDER.glob("*.cpp")])


def fingerprint() -> str:
    """Return a hash of the C++ files and compiler flags, which tells whether a library is current."""
    digest = hashlib.sha256(repr((_FLAGS, levels())).encode())
    for path in sources():
        digest.update(path.name.encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def build_if_changed() -> list[Path]:
    """Compile the library if it is missing, cannot be loaded here, or its sources have changed since it was built.

    Returns:
        Paths of the libraries.

    Raises:
        RuntimeError: as ``build``.
    """
    paths, mark = [library_path(level) for level in levels()], fingerprint()
    return paths if all(_is_current(path, mark) for path in paths) else build()


def _is_current(path: Path, mark: str) -> bool:
    """Return whether a library has this fingerprint and can be loaded here.

    A library of other sources is not loaded: this process would get it again in place of the one that replaces it.
    """
    try:
        return mark.encode() in path.read_bytes() and bool(ctypes.CDLL(str(path)))
    except OSError:  # missing, or of another platform
        return False


def build(flags: tuple[str, ...] = ()) -> list[Path]:
    """Compile the library for all instruction sets in parallel.

    Args:
        flags: more flags for the compiler, for example ``-fsanitize=address``.

    Returns:
        Paths of the libraries.

    Raises:
        RuntimeError: there is no C++20 compiler, or it failed; the message has its last words.
    """
    name = os.environ.get("CXX") or "c++"
    compiler = shutil.which(name)
    if sys.platform == "win32":
        raise RuntimeError("the core is not built on Windows")
    if compiler is None:
        raise RuntimeError(f"no C++ compiler {name!r} on the PATH")
    running = {}
    for level, own in levels().items():
        out = library_path(level)
        running[out] = subprocess.Popen(
            command(compiler, part(out), *own, *flags), stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True
        )
    said = {out: process.communicate()[1] for out, process in running.items()}
    for out, process in running.items():
        if process.returncode or not part(out).exists():
            raise RuntimeError(f"{name} failed with status {process.returncode}: {said[out][-800:]}")
        part(out).replace(out)  # at once, so that no process loads half a library
    return list(running)


def command(compiler: str | Path, out: Path, *flags: str) -> list[str]:
    """Return the command that compiles all sources into one library, with more flags for the compiler."""
    text = [str(path) for path in sources() if path.suffix == ".cpp"]
    mark = f'-DOSIK_SOURCES="{fingerprint()}"'
    return [str(compiler), *_FLAGS, mark, "-shared", "-fPIC", *flags, *text, "-o", str(out)]


def part(out: Path) -> Path:
    """Return the temporary path of a library that is being written."""
    return out.with_suffix(f".{os.getpid()}.part")


if __name__ == "__main__":
    for path in build(tuple(sys.argv[1:])):
        print(path)

"""Compiled CUDA texts on disk: a damaged one is none, and a full disk leaves none."""

import os
import shutil
import subprocess

import pytest
from small_files import files_of_at_most

from osik_jax.core import _build

COMPILER = shutil.which(os.environ.get("CXX") or "c++")
PROGRAM = """
#include "handlers_cuda.cpp"
#include <csignal>
int main(int, char** words) {  // "keep" or "cached", and the path
  std::signal(SIGXFSZ, SIG_IGN);
  if (words[1][0] == 'k') return keep(words[2], std::vector<char>(5000, 'x')), 0;
  std::printf("%zu", cached(words[2]).size());
}
"""


@pytest.mark.skipif(COMPILER is None, reason="THE CACHE OF KERNELS IS NOT TESTED: no C++ compiler")
def test_what_is_damaged_or_does_not_fit_is_compiled_again(tmp_path):
    (source := tmp_path / "program.cpp").write_text(PROGRAM)
    flags = ("-std=c++20", "-O0", f"-I{_build.FOLDER}", "-o", tmp_path / "program", source, "-ldl")
    subprocess.run([COMPILER or "c++", *flags], check=True)
    folder = tmp_path / "cache"
    path = folder / "kernel.cubin"

    def run(what: str) -> str:
        return subprocess.run([tmp_path / "program", what, path], capture_output=True, text=True, check=True).stdout

    run("keep")  # the folder is missing
    assert run("cached") == "0"
    folder.mkdir()
    with files_of_at_most(1000):
        run("keep")
    assert not list(folder.iterdir()) and run("cached") == "0"
    run("keep")
    whole = path.read_bytes()
    assert run("cached") == "5000" and [one.name for one in folder.iterdir()] == ["kernel.cubin"]
    for damaged in (b"", whole[:5], whole[:5000], whole[:-1], whole[:70] + b"y" + whole[71:]):
        path.write_bytes(damaged)
        assert run("cached") == "0"

"""C++20 core with the fast methods, and the code that builds, loads and calls it.

Plain JAX defines a method; one header of this folder makes it fast, on a CPU thread and on a CUDA warp. The headers
know no Python: ``team.hpp`` says who computes one problem, ``linear_algebra.hpp`` holds each factorisation once, and
each method has a file. ``handlers_cpu.cpp`` hands XLA's buffers to the methods. ``_build.py`` compiles, ``_library.py``
loads and calls.
"""

"""The C++20 text of the fast methods, and how it is built, loaded and called.

Plain JAX defines a method; one header of this folder makes it fast, on a CPU thread and on a CUDA warp. The headers
know no Python: ``team.hpp`` says who computes one problem, ``linear_algebra.hpp`` holds each factorisation once, and
each method has a file. ``handlers_cpu.cpp`` hands XLA's buffers to the methods. ``_build.py`` compiles, ``_library.py``
loads and calls.
"""

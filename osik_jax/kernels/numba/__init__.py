"""Kernels for CPUs, compiled by Numba and called by XLA. Modules but ``_target`` are imported when they are needed.

A kernel is a module with a function ``handle(frame)``, which XLA calls, and small functions under ``@compiled`` or
``@lean``. Everything inside is double precision; one compiled kernel serves every shape, every batch and both
precisions.
"""

"""Prioritised least squares by null-space projection, one method per file, without robots."""

from ._padding import NullSpaceSolution as NullSpaceSolution
from ._solve import solve_nullspace as solve_nullspace

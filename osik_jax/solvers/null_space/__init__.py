"""Prioritised least squares by projection on null spaces, one method a file: no robot inside."""

from ._problem import NullSpaceSolution as NullSpaceSolution
from ._solve import solve_nullspace as solve_nullspace

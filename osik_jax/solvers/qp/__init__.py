"""Quadratic programs on arrays, without robots."""

from ._problem import QPSolution as QPSolution
from ._solve import solve_least_squares_qp as solve_least_squares_qp
from ._solve import solve_qp as solve_qp

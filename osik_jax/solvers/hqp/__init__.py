"""Hierarchical quadratic programs on arrays, without robots."""

from .._level import Level as Level
from ._problem import HQPSolution as HQPSolution
from ._problem import Tolerances as Tolerances
from ._problem import WorkingSet as WorkingSet
from ._solve import solve_hqp as solve_hqp

"""Solvers on arrays, without robots: quadratic programs, hierarchies, null-space projection."""

from ._damping import Damping as Damping
from ._level import Level as Level
from ._status import Status as Status
from .hqp import Tolerances as Tolerances
from .hqp import solve_hqp as solve_hqp
from .null_space import solve_nullspace as solve_nullspace
from .qp import solve_least_squares_qp as solve_least_squares_qp
from .qp import solve_qp as solve_qp

"""Array-level solvers (no robot inside) and the three schemes built on them."""

from ._status import Status as Status
from ._status import raise_if_failed as raise_if_failed
from .qp import QPSolution as QPSolution
from .qp import solve_least_squares_qp as solve_least_squares_qp
from .qp import solve_qp as solve_qp

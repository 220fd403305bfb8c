"""One control step, and closed loops of many steps."""

from ._clutch import Clutch as Clutch
from ._controller import Controller as Controller
from ._rollout import rollout as rollout
from ._solution import Solution as Solution
from ._solution import Trajectory as Trajectory
from ._solution import load_trajectory as load_trajectory
from ._step import build_problem as build_problem
from ._step import solve as solve

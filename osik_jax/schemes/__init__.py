"""Schemes: three ways to decide between tasks that cannot all be met."""

from ._hierarchical import HierarchicalQP as HierarchicalQP
from ._null_space import NullSpace as NullSpace
from ._scheme import Scheme as Scheme
from ._scheme import SchemeAnswer as SchemeAnswer
from ._scheme import VelocityProblem as VelocityProblem
from ._weighted import WeightedQP as WeightedQP

"""Limits: hard bounds on the velocity, feasible by construction."""

from ._box import Limit as Limit
from ._box import limit_box as limit_box
from ._configuration import ConfigurationLimit as ConfigurationLimit
from ._velocity import VelocityLimit as VelocityLimit

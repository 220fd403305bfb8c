"""Placement: where to put a robot's base so that it reaches a set of poses; import it by name."""

from ._gradient import BaseGradient as BaseGradient
from ._place_base import place_base as place_base
from ._placement import Placement as Placement
from ._placement import compare_placements as compare_placements
from ._team import Team as Team
from ._team import place_robots as place_robots

"""Placement: where to put a robot's base so that it reaches a set of poses; import it by name."""

from ._gradient import BaseGradient as BaseGradient
from ._place_base import place_base as place_base
from ._placement import Placement as Placement

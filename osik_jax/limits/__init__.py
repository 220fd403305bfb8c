"""Limits: hard bounds on the velocity. Those of single joints form a box, which is never empty."""

from ._acceleration import AccelerationLimit as AccelerationLimit
from ._box import Limit as Limit
from ._box import LimitRows as LimitRows
from ._box import limit_box as limit_box
from ._box import limit_rows as limit_rows
from ._collision import CollisionAvoidanceLimit as CollisionAvoidanceLimit
from ._configuration import ConfigurationLimit as ConfigurationLimit
from ._own import Limits as Limits
from ._own import NoLimits as NoLimits
from ._own import keeps_own as keeps_own
from ._own import no_limits as no_limits
from ._own import with_own_limits as with_own_limits
from ._velocity import FloatingBaseVelocityLimit as FloatingBaseVelocityLimit
from ._velocity import VelocityLimit as VelocityLimit
from ._with_rows import LinearLimit as LinearLimit
from ._with_rows import PositionBarrier as PositionBarrier

"""Distances between the robot's own geoms, and between them and the world."""

from ._clearance import Clearance as Clearance
from ._clearance import clearance as clearance
from ._clearance import is_free as is_free
from ._scene import Scene as Scene
from ._shape import CollisionShape as CollisionShape

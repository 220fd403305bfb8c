"""Shapes of robots and scenes, and the distances between them."""

from ..robot.loading._srdf import Srdf as Srdf
from ..robot.loading._srdf import read_srdf as read_srdf
from ._clearance import Clearance as Clearance
from ._clearance import clearance as clearance
from ._clearance import is_free as is_free
from ._robot_shapes import covering_spheres as covering_spheres
from ._robot_shapes import robot_shapes as robot_shapes
from ._scene import Scene as Scene
from ._shape import CollisionShape as CollisionShape

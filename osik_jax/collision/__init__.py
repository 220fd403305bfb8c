"""Distances between the robot's own geoms, and between them and the world."""

from ._scene import Scene as Scene
from ._shape import CollisionShape as CollisionShape

"""Closed loop in MuJoCo with dynamics, a floor and position servos; import it by name."""

from ._loop import simulate as simulate
from ._servo import Servo as Servo
from ._simulation import Simulation as Simulation
from ._world import build_world as build_world

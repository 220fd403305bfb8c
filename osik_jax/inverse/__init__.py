"""Inverse kinematics: configurations that bring frames to poses, or meet tasks."""

from ._inverse_kinematics import inverse_kinematics as inverse_kinematics
from ._solution import InverseKinematicsSolution as InverseKinematicsSolution

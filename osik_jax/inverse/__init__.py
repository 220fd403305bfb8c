"""From where frames should be to configurations."""

from ._inverse_kinematics import inverse_kinematics as inverse_kinematics
from ._solution import InverseKinematicsSolution as InverseKinematicsSolution

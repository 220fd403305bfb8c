"""The command line."""

from ._calibrate import Calibrate as Calibrate
from ._demo import Demo as Demo
from ._ik import Ik as Ik
from ._info import Info as Info
from ._inputs import read_robot as read_robot
from ._main import main as main
from ._messages import CommandError as CommandError
from ._reach import Reach as Reach
from ._retarget import Retarget as Retarget
from ._view import View as View

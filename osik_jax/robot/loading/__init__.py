"""Readers of files and MuJoCo models, which return a ``RobotModel``. Host code, run once per robot."""

from ._mjcf import from_mjcf as from_mjcf
from ._mjmodel import from_mjmodel as from_mjmodel
from ._named import ELSEWHERE as ELSEWHERE
from ._named import EXAMPLES as EXAMPLES
from ._named import NAMES as NAMES
from ._named import ROBOTS as ROBOTS
from ._named import example_urdf as example_urdf
from ._named import named as named
from ._options import LoadOptions as LoadOptions
from ._options import LockedJoints as LockedJoints
from ._options import PositionLimits as PositionLimits
from ._source import is_mjcf as is_mjcf
from ._urdf import from_urdf as from_urdf
from ._write import to_mjcf as to_mjcf
from ._write_urdf import to_urdf as to_urdf

"""The demonstration behind ``osik demo``: motions, what is measured of them, and the report. Import it by name."""

from ._file import file_motion as file_motion
from ._file import guess_feet as guess_feet
from ._file import guess_moving_frame as guess_moving_frame
from ._measure import Measurement as Measurement
from ._measure import measure as measure
from ._motion import Goal as Goal
from ._motion import Motion as Motion
from ._motion import Stance as Stance
from ._nao import double_support as double_support
from ._nao import single_support as single_support
from ._physics import PhysicsMeasurement as PhysicsMeasurement
from ._physics import PhysicsRun as PhysicsRun
from ._physics import measure_physics as measure_physics
from ._physics import nao_world as nao_world
from ._physics import run_physics as run_physics
from ._references import Path as Path
from ._references import Stroke as Stroke
from ._references import minimum_jerk as minimum_jerk
from ._report import report as report
from ._report import table as table
from ._run import Run as Run
from ._run import draw_picture as draw_picture
from ._run import run_demo as run_demo
from ._run import run_scheme as run_scheme
from ._schemes import SCHEMES as SCHEMES
from ._schemes import make_scheme as make_scheme

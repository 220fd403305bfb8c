"""From poses to a timed motion: paths of joints, their least time, chunks and streams of poses."""

from ._chunk import Chunk as Chunk
from ._chunk import chunk as chunk
from ._connect import Way as Way
from ._connect import connect as connect
from ._follow import Followed as Followed
from ._follow import follow as follow
from ._motion import Motion as Motion
from ._motion import load_motion as load_motion
from ._move import Move as Move
from ._move import move as move
from ._pictures import draw_motion as draw_motion
from ._pictures import film_motion as film_motion
from ._pose_filter import PoseFilter as PoseFilter
from ._retime import retime as retime
from ._stream import Stream as Stream
from ._timing import SlowPart as SlowPart
from ._timing import Timing as Timing

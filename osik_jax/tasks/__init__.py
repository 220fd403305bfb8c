"""Tasks: errors, Jacobians and wanted velocities."""

from ._com import ComTask as ComTask
from ._frame import FrameTask as FrameTask
from ._gain import AdaptiveGain as AdaptiveGain
from ._polygon import SupportPolygon as SupportPolygon
from ._polygon import support_polygon as support_polygon
from ._posture import PostureTask as PostureTask
from ._task import Task as Task
from ._task import TaskRows as TaskRows
from ._task import task_rows as task_rows

"""Differentiable, batched operational-space inverse kinematics for redundant robots, in JAX."""

from . import _runtime as _runtime  # first: it sets up XLA's CPU client
from ._batches import batch_axes as batch_axes
from ._batches import batched as batched
from ._batches import stack as stack
from .control import Solution as Solution
from .control import Trajectory as Trajectory
from .control import rollout as rollout
from .control import solve as solve
from .kinematics import Kinematics as Kinematics
from .kinematics import center_of_mass as center_of_mass
from .kinematics import com_jacobian as com_jacobian
from .kinematics import difference as difference
from .kinematics import forward_kinematics as forward_kinematics
from .kinematics import frame_jacobian as frame_jacobian
from .kinematics import frame_jacobians as frame_jacobians
from .kinematics import integrate as integrate
from .limits import ConfigurationLimit as ConfigurationLimit
from .limits import Limit as Limit
from .limits import VelocityLimit as VelocityLimit
from .limits import limit_box as limit_box
from .robot import Robot as Robot
from .robot import load_robot as load_robot
from .schemes import HierarchicalQP as HierarchicalQP
from .schemes import NullSpace as NullSpace
from .schemes import Scheme as Scheme
from .schemes import WeightedQP as WeightedQP
from .solvers import Status as Status
from .tasks import AdaptiveGain as AdaptiveGain
from .tasks import ComTask as ComTask
from .tasks import FrameTask as FrameTask
from .tasks import PostureTask as PostureTask
from .tasks import SupportPolygon as SupportPolygon
from .tasks import Task as Task
from .tasks import TaskRows as TaskRows
from .tasks import support_polygon as support_polygon
from .tasks import task_rows as task_rows

"""Pictures of robots and motions. Needs no display and no GL library; loads matplotlib, so import it by name."""

from ._animate import Curves as Curves
from ._animate import animate as animate
from ._figures import Panel as Panel
from ._figures import compare_figure as compare_figure
from ._figures import hero_picture as hero_picture
from ._look import Look as Look
from ._look import read_look as read_look
from ._mujoco import mujoco_frame_pose as mujoco_frame_pose
from ._mujoco import mujoco_poses as mujoco_poses
from ._mujoco import robot_com as robot_com
from ._opengl import RendererName as RendererName
from ._opengl import check_opengl as check_opengl
from ._outline import Outline as Outline
from ._outline import robot_outline as robot_outline
from ._scene import Surface as Surface
from ._scene import draw_com as draw_com
from ._scene import draw_ground as draw_ground
from ._scene import draw_polygon as draw_polygon
from ._scene import draw_robot as draw_robot
from ._scene import draw_robot_with_com as draw_robot_with_com
from ._scene import draw_target as draw_target
from ._scene import draw_trail as draw_trail
from ._scene import scene_axes as scene_axes

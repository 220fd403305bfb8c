"""Motion retargeting: a recorded human motion becomes a motion of a legged robot."""

from ._goals import Weights as Weights
from ._guess import describe_profile as describe_profile
from ._guess import guess_profile as guess_profile
from ._live import LiveRetargeter as LiveRetargeter
from ._load import load_motion as load_motion
from ._motion import HumanMotion as HumanMotion
from ._profile import Profile as Profile
from ._profile_file import load_profile as load_profile
from ._profile_file import save_profile as save_profile
from ._report import report as report
from ._retarget import Retargeter as Retargeter
from ._retarget import retarget as retarget
from ._retargeted import Retargeted as Retargeted
from ._robot_motion import RobotMotion as RobotMotion
from ._source_motion import SourceMotion as SourceMotion

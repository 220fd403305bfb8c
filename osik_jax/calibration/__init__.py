"""Calibration: measurements give a robot's numbers with their uncertainty; import it by name."""

from ._calibrate import calibrate as calibrate
from ._calibration import Calibration as Calibration
from ._files import read_measurements as read_measurements
from ._measurements import Distances as Distances
from ._measurements import Measurement as Measurement
from ._measurements import Pixels as Pixels
from ._measurements import PlaneContacts as PlaneContacts
from ._measurements import Points as Points
from ._measurements import Poses as Poses
from ._next_poses import next_poses as next_poses
from ._residuals import Combination as Combination
from ._residuals import Residuals as Residuals
from ._setup import FixedFrame as FixedFrame
from ._unknowns import Unknown as Unknown

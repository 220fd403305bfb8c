"""Maps of the poses that a frame can reach; import it by name."""

from ._grid import grid_around as grid_around
from ._map import ReachabilityMap as ReachabilityMap
from ._map import load_map as load_map
from ._reachability_map import reachability_map as reachability_map
from ._rotations import spread_rotations as spread_rotations

"""Maps of the poses that a frame can reach; import it by name."""

from ._map import load_map as load_map
from ._reachability_map import reachability_map as reachability_map

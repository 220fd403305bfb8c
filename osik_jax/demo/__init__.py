"""The demonstration behind ``osik demo``: NAO's two motions, and their runs in physics. Import it by name."""

from ._nao import double_support as double_support
from ._nao import single_support as single_support
from ._physics import run_physics as run_physics

"""Controllers as files."""

from ._controller import load_controller as load_controller
from ._controller import save_controller as save_controller

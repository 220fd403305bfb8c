"""Wrong inputs and the outcome of each: docs/dev/bad_inputs.csv, written by ``python -m benchmarks.bad_inputs``."""

from ._table import HEAD as HEAD
from ._table import TABLE as TABLE
from ._table import Case as Case
from ._table import cases as cases
from ._table import outcome as outcome
from ._table import table as table

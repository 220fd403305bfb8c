"""Wrong inputs and what each gets: the table in docs/dev/bad_inputs.md, made by ``python -m benchmarks.bad_inputs``."""

from ._page import PAGE as PAGE
from ._page import Case as Case
from ._page import cases as cases
from ._page import outcome as outcome
from ._page import page as page

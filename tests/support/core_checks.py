"""Marks for tests of the compiled core."""

import pytest

from osik_jax.core._library import core

needs_core = pytest.mark.skipif(core().library is None, reason=core().reason)
